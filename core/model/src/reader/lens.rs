//! Lens distortion. Scenes hold pinhole cameras only; images of distorted cameras are resampled when they are loaded.

/// A model of lens distortion of normalised image coordinates (x/z, y/z).
#[derive(Clone, Debug, PartialEq)]
pub enum Distortion {
    /// No distortion (pinhole).
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
    /// Whether there is no distortion.
    pub fn is_identity(&self) -> bool {
        match self {
            Self::None => true,
            Self::Brown { radial, tangential } => radial.iter().chain(tangential).all(|&k| k == 0.0),
            Self::Fisheye { .. } => false,
        }
    }
    /// The distorted point of the undistorted point (x, y).
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
    /// The undistorted point of the distorted point (x, y), by Newton's method; `None` if there is none.
    pub fn undistort(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        if let Self::Fisheye { .. } = self {
            // A pinhole image cannot contain angles of 90 degrees or more.
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
    /// The undistorted radius, at most `largest`, up to which the radial mapping increases. Beyond it the polynomial folds back and is not valid.
    pub fn fold_radius(&self, largest: f64) -> f64 {
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
}
