//! Removal of lens distortion: images of distorted cameras become pinhole images.

use cc4dgs_core::{Distortion, Error, Image8, Result};
use rayon::prelude::*;

/// The plan that turns images of one distorted camera into pinhole images of the same focal length: the largest upright rectangle around
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
    /// Plans for images of `size` pixels with the given focal lengths and principal point in pixels; `object` names the camera in errors.
    pub fn plan(object: &str, distortion: &Distortion, size: [u32; 2], focal: [f64; 2], principal: [f64; 2]) -> Result<Self> {
        let bad = |problem: String| Error::data(object, problem, "Check the distortion coefficients, or undistort the images first");
        let coefficients = distortion.coefficients();
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
    /// The principal point of the pinhole image, in pixels.
    pub fn principal_point(&self) -> [f64; 2] {
        [self.principal[0] - f64::from(self.origin[0]), self.principal[1] - f64::from(self.origin[1])]
    }
    /// Where the source shows what the pinhole image has at (u, v), in pixels of each.
    pub fn source(&self, u: f64, v: f64) -> (f64, f64) {
        let x = (u + f64::from(self.origin[0]) - self.principal[0]) / self.focal[0];
        let y = (v + f64::from(self.origin[1]) - self.principal[1]) / self.focal[1];
        let (x, y) = self.distortion.distort(x, y);
        (x * self.focal[0] + self.principal[0], y * self.focal[1] + self.principal[1])
    }
    /// Resamples one image, bilinearly and weighted by alpha.
    pub fn apply(&self, image: &Image8) -> Image8 {
        let c = image.channels as usize;
        let [width, height] = self.size;
        let mut data = vec![0u8; width as usize * height as usize * c];
        data.par_chunks_mut(width as usize * c).enumerate().for_each(|(row, line)| {
            for (column, px) in line.chunks_exact_mut(c).enumerate() {
                let (u, v) = self.source(column as f64 + 0.5, row as f64 + 0.5);
                sample(image, u - 0.5, v - 0.5, px);
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

    const LENSES: [Distortion; 10] = [
        Distortion::Brown { radial: [0.0578421, -0.0805099, 0.0, 0.0], tangential: [-0.000980296, 0.00015575] },
        Distortion::Brown { radial: [-0.28, 0.07, 0.0, 0.0], tangential: [0.001, -0.0005] },
        Distortion::Fisheye { radial: [0.02, -0.01, 0.003, -0.0005] },
        Distortion::Rational { numerator: [0.52, -2.71, 1.55], denominator: [0.41, -2.53, 1.48], tangential: [0.0006, -0.0003] },
        Distortion::ThinPrismFisheye { radial: [0.02, -0.01, 0.003, -0.0005], tangential: [0.001, -0.0005], prism: [0.002, -0.003] },
        Distortion::FieldOfView { omega: 0.6 },
        Distortion::RadTanThinPrismFisheye {
            radial: [0.02, -0.01, 0.003, -0.0005, 0.0002, -0.0001],
            tangential: [0.001, -0.0005],
            prism: [0.002, -0.0004, -0.003, 0.0006],
        },
        Distortion::Division { k: -0.2 },
        Distortion::Division { k: 0.1 },
        Distortion::EnhancedUnified { alpha: 0.6, beta: 1.2 },
    ];

    /// An image whose colours are the ideal coordinates, as the lens would take it, comes back with colours equal to its pinhole coordinates.
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
        let bent = |omega: f64| Undistort::plan("t", &Distortion::FieldOfView { omega }, [64, 64], [50.0; 2], [32.0; 2]);
        assert!(bent(std::f64::consts::PI).is_err() && bent(5.0).is_err() && bent(0.8).is_ok());
        // Folds at r = 0.58, inside the image.
        if let Ok(plan) = Undistort::plan("t", &Distortion::Brown { radial: [-1.0, 0.0, 0.0, 0.0], tangential: [0.0; 2] }, [64, 64], [50.0; 2], [32.0; 2]) {
            let half = f64::from(plan.size[0]) / 2.0 / 50.0;
            assert!(half * 2f64.sqrt() < 0.6, "kept {:?}", plan.size);
        }
    }
}
