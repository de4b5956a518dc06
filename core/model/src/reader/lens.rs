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
    /// OpenCV's rational model (COLMAP's `FULL_OPENCV`): quotient of two radial polynomials in r^2 .. r^6, and tangential terms.
    Rational {
        /// k1..k3.
        numerator: [f64; 3],
        /// k4..k6.
        denominator: [f64; 3],
        /// p1, p2.
        tangential: [f64; 2],
    },
    /// Equidistant fisheye as in OpenCV: polynomial in the angle.
    Fisheye {
        /// k1..k4.
        radial: [f64; 4],
    },
    /// COLMAP's `THIN_PRISM_FISHEYE`: the polynomial of [`Self::Fisheye`], with tangential and thin-prism terms of the equidistant point.
    ThinPrismFisheye {
        /// k1..k4.
        radial: [f64; 4],
        /// p1, p2.
        tangential: [f64; 2],
        /// sx1, sy1.
        prism: [f64; 2],
    },
    /// COLMAP's `RAD_TAN_THIN_PRISM_FISHEYE` (Fisheye624 of Project Aria): a longer polynomial in the angle, and tangential and thin-prism terms of the point
    /// that it scaled.
    RadTanThinPrismFisheye {
        /// k0..k5.
        radial: [f64; 6],
        /// p0, p1: p0 is the p2 of [`Self::ThinPrismFisheye`].
        tangential: [f64; 2],
        /// s0..s3: of r^2 and r^4 along x, then along y.
        prism: [f64; 4],
    },
    /// COLMAP's `FOV` (Devernay and Faugeras 2001): the distorted radius is atan(2 r tan(omega / 2)) / omega.
    FieldOfView {
        /// Field of view of the ideal lens in radians, from -pi to pi. 0 is no distortion.
        omega: f64,
    },
    /// COLMAP's `DIVISION` and `SIMPLE_DIVISION` (Fitzgibbon 2001): the undistorted point is the distorted one over 1 + k r^2.
    Division {
        /// k; negative for barrel distortion.
        k: f64,
    },
    /// COLMAP's `EUCM`, the enhanced unified camera model (Khomutenko, Garcia and Martinet 2016): the undistorted point over
    /// alpha sqrt(beta r^2 + 1) + 1 - alpha.
    EnhancedUnified {
        /// From 0, no distortion, to 1.
        alpha: f64,
        /// Over 0.
        beta: f64,
    },
}

/// Smallest |omega| of [`Distortion::FieldOfView`] in radians whose distortion is computed. It changes radii by a share of about omega^2 / 3 of r^2.
const LEAST_OMEGA: f64 = 1e-6;

/// The radially scaled point (x, y) with Brown's tangential terms.
fn brown(x: f64, y: f64, scale: f64, [p1, p2]: [f64; 2]) -> (f64, f64) {
    let r2 = x * x + y * y;
    (x * scale + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * scale + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
}

impl Distortion {
    /// All coefficients of the model.
    pub fn coefficients(&self) -> Vec<f64> {
        match self {
            Self::None => Vec::new(),
            Self::Brown { radial, tangential } => [&radial[..], tangential].concat(),
            Self::Rational { numerator, denominator, tangential } => [&numerator[..], denominator, tangential].concat(),
            Self::Fisheye { radial } => radial.to_vec(),
            Self::ThinPrismFisheye { radial, tangential, prism } => [&radial[..], tangential, prism].concat(),
            Self::RadTanThinPrismFisheye { radial, tangential, prism } => [&radial[..], tangential, prism].concat(),
            Self::FieldOfView { omega } => vec![*omega],
            Self::Division { k } => vec![*k],
            Self::EnhancedUnified { alpha, beta } => vec![*alpha, *beta],
        }
    }
    /// Whether there is no distortion.
    pub fn is_identity(&self) -> bool {
        if let Self::EnhancedUnified { alpha, .. } = self {
            return *alpha == 0.0;
        }
        !self.is_fisheye() && self.coefficients().iter().all(|&k| k == 0.0)
    }
    /// Whether the model is a polynomial in the angle. Without coefficients it is no pinhole.
    fn is_fisheye(&self) -> bool {
        matches!(self, Self::Fisheye { .. } | Self::ThinPrismFisheye { .. } | Self::RadTanThinPrismFisheye { .. })
    }
    /// The distorted point of the undistorted point (x, y).
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        match self {
            Self::None => (x, y),
            Self::Brown { radial: [k1, k2, k3, k4], tangential } => {
                let r2 = x * x + y * y;
                brown(x, y, 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))), *tangential)
            }
            Self::Rational { numerator: [k1, k2, k3], denominator: [k4, k5, k6], tangential } => {
                let r2 = x * x + y * y;
                brown(x, y, (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))), *tangential)
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
            Self::ThinPrismFisheye { radial, tangential, prism: [sx1, sy1] } => {
                let (x, y) = Self::Fisheye { radial: [0.0; 4] }.distort(x, y);
                let (u, v) = Self::Brown { radial: *radial, tangential: *tangential }.distort(x, y);
                let r2 = x * x + y * y;
                (u + sx1 * r2, v + sy1 * r2)
            }
            Self::RadTanThinPrismFisheye { radial, tangential: [p0, p1], prism: [s0, s1, s2, s3] } => {
                let (x, y) = Self::Fisheye { radial: [0.0; 4] }.distort(x, y);
                let t2 = x * x + y * y;
                let scale = 1.0 + radial.iter().rev().fold(0.0f64, |sum, k| (sum + k) * t2);
                let (x, y) = (x * scale, y * scale);
                let r2 = x * x + y * y;
                let (u, v) = brown(x, y, 1.0, [*p1, *p0]);
                (u + r2 * (s0 + r2 * s1), v + r2 * (s2 + r2 * s3))
            }
            &Self::Division { k } => {
                let r2 = x * x + y * y;
                let root = 1.0 - 4.0 * k * r2;
                // Beyond the largest radius that the lens shows, radii fall again.
                let f = if root >= 0.0 { 2.0 / (1.0 + root.sqrt()) } else { 0.5 / (k * r2) };
                (x * f, y * f)
            }
            &Self::EnhancedUnified { alpha, beta } => {
                let f = 1.0 / (alpha * (beta * (x * x + y * y) + 1.0).sqrt() + 1.0 - alpha);
                (x * f, y * f)
            }
            &Self::FieldOfView { omega } => {
                let r = x.hypot(y);
                if omega.abs() < LEAST_OMEGA || r < 1e-12 {
                    return (x, y);
                }
                let f = (2.0 * r * (0.5 * omega).tan()).atan() / (r * omega);
                (x * f, y * f)
            }
        }
    }
    /// The undistorted point of the distorted point (x, y), by Newton's method where there is no closed form; `None` if there is none.
    pub fn undistort(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        // A pinhole image cannot contain angles of 90 degrees or more.
        if self.is_fisheye() && x.hypot(y) >= 0.5 * std::f64::consts::PI * 1.5 {
            return None;
        }
        if let Self::FieldOfView { omega } = *self {
            let r = x.hypot(y);
            if omega.abs() < LEAST_OMEGA || r < 1e-12 {
                return Some((x, y));
            }
            let angle = r * omega;
            let f = angle.tan() / (2.0 * r * (0.5 * omega).tan());
            return (angle.abs() < 0.5 * std::f64::consts::PI).then_some((x * f, y * f));
        }
        if let Self::Division { k } = *self {
            let share = k * (x * x + y * y);
            return (share.abs() < 1.0).then_some((x / (1.0 + share), y / (1.0 + share)));
        }
        if let Self::EnhancedUnified { alpha, beta } = *self {
            let b2 = beta * (x * x + y * y);
            let depth = (1.0 - alpha * alpha * b2) / (alpha * (1.0 - (2.0 * alpha - 1.0) * b2).sqrt() + 1.0 - alpha);
            // Not a number where the lens shows nothing.
            return (depth > 1e-12).then_some((x / depth, y / depth));
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
    /// The undistorted radius, at most `largest`, up to which the radial mapping increases. Beyond it the mapping folds back or has a pole, and is not valid.
    pub fn fold_radius(&self, largest: f64) -> f64 {
        const STEPS: usize = 512;
        let radial = self.radial_part();
        let mut before = 0.0;
        for i in 1..=STEPS {
            let r = largest * i as f64 / STEPS as f64;
            let image = radial.distort(r, 0.0).0;
            if image <= before || image.is_nan() {
                return largest * (i - 1) as f64 / STEPS as f64;
            }
            before = image;
        }
        largest
    }
    /// The model without its tangential and thin-prism terms.
    fn radial_part(&self) -> Self {
        match self {
            Self::Brown { radial, .. } => Self::Brown { radial: *radial, tangential: [0.0; 2] },
            Self::Rational { numerator, denominator, .. } => Self::Rational { numerator: *numerator, denominator: *denominator, tangential: [0.0; 2] },
            Self::ThinPrismFisheye { radial, .. } => Self::Fisheye { radial: *radial },
            Self::RadTanThinPrismFisheye { radial, .. } => Self::RadTanThinPrismFisheye { radial: *radial, tangential: [0.0; 2], prism: [0.0; 4] },
            other => other.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATIONAL: Distortion = Distortion::Rational { numerator: [0.52, -2.71, 1.55], denominator: [0.41, -2.53, 1.48], tangential: [0.0006, -0.0003] };
    const PRISM: Distortion = Distortion::ThinPrismFisheye { radial: [0.02, -0.01, 0.003, -0.0005], tangential: [0.001, -0.0005], prism: [0.002, -0.003] };
    const RAD_TAN: Distortion = Distortion::RadTanThinPrismFisheye {
        radial: [0.02, -0.01, 0.003, -0.0005, 0.0002, -0.0001],
        tangential: [0.001, -0.0005],
        prism: [0.002, -0.0004, -0.003, 0.0006],
    };
    const UNIFIED: Distortion = Distortion::EnhancedUnified { alpha: 0.6, beta: 1.2 };
    const LENSES: [Distortion; 11] = [
        Distortion::Brown { radial: [0.0578421, -0.0805099, 0.0, 0.0], tangential: [-0.000980296, 0.00015575] },
        Distortion::Brown { radial: [-0.28, 0.07, 0.0, 0.0], tangential: [0.001, -0.0005] },
        Distortion::Fisheye { radial: [0.02, -0.01, 0.003, -0.0005] },
        RATIONAL,
        PRISM,
        Distortion::FieldOfView { omega: 0.9 },
        Distortion::FieldOfView { omega: 1e-9 },
        RAD_TAN,
        UNIFIED,
        Distortion::Division { k: -0.2 },
        Distortion::Division { k: 0.1 },
    ];

    #[test]
    fn the_inverse_undoes_the_lens() {
        for lens in &LENSES {
            for (x, y) in [(0.0, 0.0), (0.3, -0.2), (-0.6, 0.5), (0.0, 0.7), (0.73, 0.52), (-0.75, -0.52)] {
                let (xd, yd) = lens.distort(x, y);
                let (u, v) = lens.undistort(xd, yd).unwrap();
                assert!((u - x).abs() < 1e-8 && (v - y).abs() < 1e-8, "{lens:?} at ({x}, {y}): ({u}, {v})");
            }
        }
    }

    /// References: the formulas of COLMAP's `models/opencv.h`, `thin_prism.h`, `fov.h`, `division.h` and `eucm.h`, evaluated with Python.
    #[test]
    fn points_are_where_colmap_has_them() {
        for (lens, near, far) in [
            (RATIONAL, (0.30321195341352003, -0.20208930227568006), (-0.6564624237121528, 0.4925868177841146)),
            (PRISM, (0.2885643790276967, -0.192496001163509), (-0.543775730082858, 0.40743343164041984)),
            (Distortion::FieldOfView { omega: 0.9 }, (0.30988475430807605, -0.20658983620538407), (-0.5848793773892991, 0.43865953304197425)),
            (RAD_TAN, (0.28915535129567527, -0.19294584532052958), (-0.5416183359860672, 0.40570033944415773)),
            (UNIFIED, (0.28705259526196447, -0.19136839684130966), (-0.5343142601108715, 0.40073569508315354)),
            (Distortion::Division { k: -0.2 }, (0.29258101687555255, -0.19505401125036836), (-0.5740852297878795, 0.4305639223409096)),
            (Distortion::Division { k: 0.1 }, (0.30400482033407533, -0.2026698802227169), (-0.6872282694304351, 0.5154212020728264)),
        ] {
            for ((x, y), (u, v)) in [((0.3, -0.2), near), ((-0.64, 0.48), far)] {
                let (a, b) = lens.distort(x, y);
                assert!((a - u).abs() < 1e-12 && (b - v).abs() < 1e-12, "{lens:?} at ({x}, {y}): ({a}, {b}), not ({u}, {v})");
            }
        }
    }

    #[test]
    fn lenses_that_fold_or_have_a_pole_end_there() {
        let rational = |numerator: [f64; 3], denominator: [f64; 3]| Distortion::Rational { numerator, denominator, tangential: [0.1; 2] };
        // r (1 - r^2) is largest at r = 1 / sqrt(3); r / (1 - 4 r^2) has a pole at r = 1/2.
        for (lens, end) in [
            (rational([-1.0, 0.0, 0.0], [0.0; 3]), 1.0 / 3f64.sqrt()),
            (rational([0.0; 3], [-4.0, 0.0, 0.0]), 0.5),
            (Distortion::ThinPrismFisheye { radial: [-1.0, 0.0, 0.0, 0.0], tangential: [0.1; 2], prism: [0.1; 2] }, (1.0 / 3f64.sqrt()).tan()),
            (Distortion::RadTanThinPrismFisheye { radial: [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0], tangential: [0.1; 2], prism: [0.1; 4] }, (1.0 / 3f64.sqrt()).tan()),
            // The distorted radius is largest, 1 / sqrt(k), at 1 / (2 sqrt(k)).
            (Distortion::Division { k: 1.0 }, 0.5),
        ] {
            let found = lens.fold_radius(1.0);
            assert!((found - end).abs() < 0.005, "{lens:?} ends at {found}, not {end}");
        }
        assert_eq!(Distortion::FieldOfView { omega: 0.9 }.fold_radius(1.0), 1.0);
        // A distorted radius of 90 degrees or more over omega shows nothing in front of the camera.
        assert_eq!(Distortion::FieldOfView { omega: 1.0 }.undistort(1.6, 0.0), None);
        for k in [1.0, -1.0] {
            assert!(Distortion::Division { k }.undistort(1.1, 0.0).is_none() && Distortion::Division { k }.undistort(0.9, 0.0).is_some());
        }
        // At 1 / (alpha sqrt(beta)) rays come from the side; from 1 / sqrt((2 alpha - 1) beta) on there are none.
        assert!([1.53, 1.8, 2.1].map(|r| UNIFIED.undistort(r, 0.0)).iter().all(Option::is_none) && UNIFIED.undistort(1.5, 0.0).is_some());
        assert_eq!(UNIFIED.fold_radius(10.0), 10.0);
        assert_eq!(Distortion::EnhancedUnified { alpha: 1.0, beta: -1e4 }.fold_radius(1.0), 1.0 / 512.0 * 5.0);
    }

    #[test]
    fn lenses_without_coefficients_are_pinholes_unless_they_are_fisheyes() {
        assert!(Distortion::Rational { numerator: [0.0; 3], denominator: [0.0; 3], tangential: [0.0; 2] }.is_identity());
        assert!(Distortion::FieldOfView { omega: 0.0 }.is_identity() && Distortion::None.is_identity());
        assert!(Distortion::Division { k: 0.0 }.is_identity() && Distortion::EnhancedUnified { alpha: 0.0, beta: 1.0 }.is_identity());
        assert!(!UNIFIED.is_identity() && !Distortion::RadTanThinPrismFisheye { radial: [0.0; 6], tangential: [0.0; 2], prism: [0.0; 4] }.is_identity());
        assert!(!Distortion::ThinPrismFisheye { radial: [0.0; 4], tangential: [0.0; 2], prism: [0.0; 2] }.is_identity());
        assert!(!Distortion::Rational { numerator: [0.0; 3], denominator: [0.0, 0.0, 0.1], tangential: [0.0; 2] }.is_identity());
    }
}
