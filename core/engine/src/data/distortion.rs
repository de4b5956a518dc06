//! Lens distortion and its removal. Scenes hold pinhole cameras only; the readers resample their pictures.

use cc4dgs_core::{Error, Image8, Result};
use rayon::prelude::*;

/// How a lens bends normalised image coordinates (x/z, y/z).
#[derive(Clone, Debug, PartialEq)]
pub enum Distortion {
    /// A pinhole.
    None,
    /// Brown-Conrady as in OpenCV: radial polynomial in r^2 .. r^8 and tangential terms.
    Brown {
        /// k1..k4.
        radial: [f64; 4],
        /// p1, p2.
        tangential: [f64; 2],
    },
    /// Equidistant fisheye as in OpenCV: polynomial in the angle.
    Fisheye {
        /// k1..k4.
        radial: [f64; 4],
    },
}

impl Distortion {
    /// Whether nothing is bent.
    pub fn is_identity(&self) -> bool {
        match self {
            Self::None => true,
            Self::Brown { radial, tangential } => radial.iter().chain(tangential).all(|&k| k == 0.0),
            Self::Fisheye { .. } => false,
        }
    }
    /// Where the lens puts the ideal point (x, y).
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        match self {
            Self::None => (x, y),
            Self::Brown { radial: [k1, k2, k3, k4], tangential: [p1, p2] } => {
                let r2 = x * x + y * y;
                let f = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
                (x * f + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * f + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
            }
            Self::Fisheye { radial: [k1, k2, k3, k4] } => {
                let r = x.hypot(y);
                if r < 1e-12 {
                    return (x, y);
                }
                let t = r.atan();
                let t2 = t * t;
                let f = t * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r;
                (x * f, y * f)
            }
        }
    }
    /// The ideal point the lens puts at (x, y), by Newton's method; `None` where there is none.
    pub fn undistort(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        if let Self::Fisheye { .. } = self {
            // An angle of 90 degrees or more has no place in a pinhole picture.
            if x.hypot(y) >= 0.5 * std::f64::consts::PI * 1.5 {
                return None;
            }
        }
        let (mut u, mut v) = (x, y);
        for _ in 0..50 {
            let h = 1e-6 * (1.0 + u.abs().max(v.abs()));
            let (fx, fy) = self.distort(u, v);
            let (ax, ay) = self.distort(u + h, v);
            let (bx, by) = self.distort(u, v + h);
            let (ex, ey) = (fx - x, fy - y);
            if ex.abs().max(ey.abs()) < 1e-10 {
                return Some((u, v));
            }
            let (a, b, c, d) = ((ax - fx) / h, (bx - fx) / h, (ay - fy) / h, (by - fy) / h);
            let det = a * d - b * c;
            if !(det.is_finite() && det > 1e-9) {
                return None;
            }
            u -= (d * ex - b * ey) / det;
            v -= (a * ey - c * ex) / det;
        }
        let (fx, fy) = self.distort(u, v);
        ((fx - x).abs().max((fy - y).abs()) < 1e-6).then_some((u, v))
    }
    /// The ideal radius up to which the radial mapping grows; beyond, the polynomial folds back and means nothing.
    fn fold_radius(&self, largest: f64) -> f64 {
        const STEPS: usize = 512;
        let mut before = 0.0;
        for i in 1..=STEPS {
            let r = largest * i as f64 / STEPS as f64;
            let image = match self {
                Self::Brown { radial, .. } => Self::Brown { radial: *radial, tangential: [0.0; 2] }.distort(r, 0.0).0,
                other => other.distort(r, 0.0).0,
            };
            if image <= before {
                return largest * (i - 1) as f64 / STEPS as f64;
            }
            before = image;
        }
        largest
    }
}

/// The plan that turns pictures of one distorted camera into pinhole pictures of the same focal length: the largest upright rectangle around
/// the principal point that has data everywhere.
#[derive(Clone, Debug, PartialEq)]
pub struct Undistort {
    distortion: Distortion,
    focal: [f64; 2],
    /// Principal point of the source.
    principal: [f64; 2],
    /// First column and row of the source frame that is kept.
    pub origin: [u32; 2],
    /// Width and height that are kept.
    pub size: [u32; 2],
}

impl Undistort {
    /// Plans for pictures of `size` pixels with the given focal lengths and principal point in pixels; `object` names the camera in errors.
    pub fn plan(object: &str, distortion: &Distortion, size: [u32; 2], focal: [f64; 2], principal: [f64; 2]) -> Result<Self> {
        let bad = |problem: String| Error::data(object, problem, "Check the distortion coefficients, or undistort the pictures first");
        let coefficients: Vec<f64> = match distortion {
            Distortion::None => vec![],
            Distortion::Brown { radial, tangential } => radial.iter().chain(tangential).copied().collect(),
            Distortion::Fisheye { radial } => radial.to_vec(),
        };
        if coefficients.iter().any(|k| !k.is_finite() || k.abs() > 1e4) {
            return Err(bad(format!("distortion coefficients {coefficients:?} are not plausible")));
        }
        let [w, h] = size.map(f64::from);
        let to_norm = |u: f64, v: f64| ((u - principal[0]) / focal[0], (v - principal[1]) / focal[1]);
        let ideal = |u: f64, v: f64| {
            let (x, y) = to_norm(u, v);
            distortion.undistort(x, y).map(|(x, y)| (x * focal[0] + principal[0], y * focal[1] + principal[1]))
        };
        // [left, top, right, bottom] of what the source's border encloses.
        let mut rect = [0.0, 0.0, w, h];
        const SAMPLES: usize = 64;
        for i in 0..=SAMPLES {
            let t = i as f64 / SAMPLES as f64;
            if let Some((u, _)) = ideal(0.0, t * h) {
                rect[0] = rect[0].max(u);
            }
            if let Some((_, v)) = ideal(t * w, 0.0) {
                rect[1] = rect[1].max(v);
            }
            if let Some((u, _)) = ideal(w, t * h) {
                rect[2] = rect[2].min(u);
            }
            if let Some((_, v)) = ideal(t * w, h) {
                rect[3] = rect[3].min(v);
            }
        }
        let corner = |r: &[f64; 4]| {
            [(r[0], r[1]), (r[2], r[1]), (r[0], r[3]), (r[2], r[3])].iter().map(|&(u, v)| to_norm(u, v)).fold(0.0f64, |a, (x, y)| a.max(x.hypot(y)))
        };
        let fold = distortion.fold_radius(corner(&rect));
        for _ in 0..200 {
            if corner(&rect) <= fold {
                break;
            }
            for (k, side) in rect.iter_mut().enumerate() {
                *side += 0.02 * (principal[k % 2] - *side);
            }
        }
        // A sliver of a pixel at the border is worth less than an untouched size.
        let (left, top) = ((rect[0] - 0.05).ceil().max(0.0), (rect[1] - 0.05).ceil().max(0.0));
        let (right, bottom) = ((rect[2] + 0.05).floor().min(w), (rect[3] + 0.05).floor().min(h));
        let usable = right - left >= 0.25 * w && bottom - top >= 0.25 * h;
        if !usable {
            return Err(bad(format!("undistorting leaves {}x{} of {w}x{h} pixels", right - left, bottom - top)));
        }
        Ok(Self { distortion: distortion.clone(), focal, principal, origin: [left as u32, top as u32], size: [(right - left) as u32, (bottom - top) as u32] })
    }
    /// The principal point of the pinhole picture, in pixels.
    pub fn principal_point(&self) -> [f64; 2] {
        [self.principal[0] - f64::from(self.origin[0]), self.principal[1] - f64::from(self.origin[1])]
    }
    /// Resamples one picture, bilinearly and weighted by alpha.
    pub fn apply(&self, image: &Image8) -> Image8 {
        let c = image.channels as usize;
        let [width, height] = self.size;
        let mut data = vec![0u8; width as usize * height as usize * c];
        data.par_chunks_mut(width as usize * c).enumerate().for_each(|(row, line)| {
            let y = (row as f64 + 0.5 + f64::from(self.origin[1]) - self.principal[1]) / self.focal[1];
            for (column, px) in line.chunks_exact_mut(c).enumerate() {
                let x = (column as f64 + 0.5 + f64::from(self.origin[0]) - self.principal[0]) / self.focal[0];
                let (xd, yd) = self.distortion.distort(x, y);
                sample(image, xd * self.focal[0] + self.principal[0] - 0.5, yd * self.focal[1] + self.principal[1] - 0.5, px);
            }
        });
        Image8 { width, height, channels: image.channels, data }
    }
}

/// Bilinear sample at pixel-index coordinates, clamped to the border.
fn sample(image: &Image8, u: f64, v: f64, px: &mut [u8]) {
    let (u, v) = (u.clamp(0.0, f64::from(image.width - 1)), v.clamp(0.0, f64::from(image.height - 1)));
    let (x0, y0) = (u as usize, v as usize);
    let (x1, y1) = ((x0 + 1).min(image.width as usize - 1), (y0 + 1).min(image.height as usize - 1));
    let (a, b) = ((u - x0 as f64) as f32, (v - y0 as f64) as f32);
    let c = px.len();
    let at = |x: usize, y: usize| &image.data[(y * image.width as usize + x) * c..][..c];
    let corners = [(at(x0, y0), (1.0 - a) * (1.0 - b)), (at(x1, y0), a * (1.0 - b)), (at(x0, y1), (1.0 - a) * b), (at(x1, y1), a * b)];
    let mut sum = [0.0f32; 4];
    for (p, w) in corners {
        let alpha = if c == 4 { f32::from(p[3]) / 255.0 } else { 1.0 };
        for k in 0..3 {
            sum[k] += w * alpha * f32::from(p[k]);
        }
        sum[3] += w * alpha;
    }
    let scale = if sum[3] > 0.0 { 1.0 / sum[3] } else { 0.0 };
    for k in 0..3 {
        px[k] = (sum[k] * scale + 0.5) as u8;
    }
    if c == 4 {
        px[3] = (sum[3] * 255.0 + 0.5) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [Distortion; 3] = [
        Distortion::Brown { radial: [0.0578421, -0.0805099, 0.0, 0.0], tangential: [-0.000980296, 0.00015575] },
        Distortion::Brown { radial: [-0.28, 0.07, 0.0, 0.0], tangential: [0.001, -0.0005] },
        Distortion::Fisheye { radial: [0.02, -0.01, 0.003, -0.0005] },
    ];

    #[test]
    fn the_inverse_undoes_the_lens() {
        for lens in &LENSES {
            for (x, y) in [(0.0, 0.0), (0.3, -0.2), (-0.6, 0.5), (0.0, 0.7)] {
                let (xd, yd) = lens.distort(x, y);
                let (u, v) = lens.undistort(xd, yd).unwrap();
                assert!((u - x).abs() < 1e-8 && (v - y).abs() < 1e-8, "{lens:?} at ({x}, {y}): ({u}, {v})");
            }
        }
    }

    /// A picture whose colours are the ideal coordinates, as the lens would take it, comes back with colours equal to its pinhole coordinates.
    #[test]
    fn straight_gradients_come_back() {
        let (w, h, f) = (160u32, 120u32, 110.0);
        let (cx, cy) = (83.0, 57.0);
        for lens in &LENSES {
            let mut data = Vec::new();
            for row in 0..h {
                for column in 0..w {
                    let (x, y) = lens.undistort((f64::from(column) + 0.5 - cx) / f, (f64::from(row) + 0.5 - cy) / f).unwrap();
                    data.extend([(128.0 + 100.0 * x).round() as u8, (128.0 + 100.0 * y).round() as u8, 0]);
                }
            }
            let plan = Undistort::plan("t", lens, [w, h], [f, f], [cx, cy]).unwrap();
            let out = plan.apply(&Image8 { width: w, height: h, channels: 3, data });
            let [px, py] = plan.principal_point();
            let mut worst = 0.0f64;
            for (i, p) in out.data.chunks_exact(3).enumerate() {
                let (x, y) = (((i as u32 % out.width) as f64 + 0.5 - px) / f, ((i as u32 / out.width) as f64 + 0.5 - py) / f);
                worst = worst.max((128.0 + 100.0 * x - f64::from(p[0])).abs()).max((128.0 + 100.0 * y - f64::from(p[1])).abs());
            }
            assert!(worst < 1.6, "{lens:?}: colours off by {worst} of 255, size {}x{}", out.width, out.height);
        }
    }

    #[test]
    fn hostile_coefficients_are_refused_or_cropped() {
        for k in [f64::NAN, f64::INFINITY, 1e300, -1e5] {
            assert!(Undistort::plan("t", &Distortion::Brown { radial: [k, 0.0, 0.0, 0.0], tangential: [0.0; 2] }, [64, 64], [50.0; 2], [32.0; 2]).is_err());
        }
        // Folds at r = 0.58, inside the picture.
        if let Ok(plan) = Undistort::plan("t", &Distortion::Brown { radial: [-1.0, 0.0, 0.0, 0.0], tangential: [0.0; 2] }, [64, 64], [50.0; 2], [32.0; 2]) {
            let half = f64::from(plan.size[0]) / 2.0 / 50.0;
            assert!(half * 2f64.sqrt() < 0.6, "kept {:?}", plan.size);
        }
    }
}
