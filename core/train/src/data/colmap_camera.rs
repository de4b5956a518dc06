//! COLMAP's camera models, and the cameras that follow from their numbers.

use cc4dgs_core::{Distortion, Error, Result};

/// A camera record: name of its model, size in pixels, parameters (none where COLMAP has no model of this name).
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapCamera {
    pub model: String,
    pub size: [u64; 2],
    pub parameters: Vec<f64>,
}

/// A camera model of COLMAP.
pub(crate) struct Model {
    number: i32,
    pub name: &'static str,
    /// How many numbers it has.
    pub parameters: usize,
    is_read: bool,
}

/// Panoramas have no focal length, and `image_undistorter` needs one.
const PANORAMA: &str = "EQUIRECTANGULAR";

/// COLMAP's table (`src/colmap/sensor/models`).
static MODELS: [Model; 18] = [
    Model::read(0, "SIMPLE_PINHOLE", 3),
    Model::read(1, "PINHOLE", 4),
    Model::read(2, "SIMPLE_RADIAL", 4),
    Model::read(3, "RADIAL", 5),
    Model::read(4, "OPENCV", 8),
    Model::read(5, "OPENCV_FISHEYE", 8),
    Model::read(6, "FULL_OPENCV", 12),
    Model::read(7, "FOV", 5),
    Model::read(8, "SIMPLE_RADIAL_FISHEYE", 4),
    Model::read(9, "RADIAL_FISHEYE", 5),
    Model::read(10, "THIN_PRISM_FISHEYE", 12),
    Model::read(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    Model::read(12, "SIMPLE_DIVISION", 4),
    Model::read(13, "DIVISION", 5),
    Model::read(14, "SIMPLE_FISHEYE", 3),
    Model::read(15, "FISHEYE", 4),
    Model::read(16, "EUCM", 6),
    Model::not_read(17, PANORAMA, 2),
];

impl Model {
    const fn read(number: i32, name: &'static str, parameters: usize) -> Self {
        Self { number, name, parameters, is_read: true }
    }
    const fn not_read(number: i32, name: &'static str, parameters: usize) -> Self {
        Self { number, name, parameters, is_read: false }
    }
    /// By COLMAP's number. Errors: [`Error::Unsupported`] for other numbers, about the camera `object`: without the length of its record, those that follow it
    /// cannot be read.
    pub(crate) fn from_number(number: i32, object: &str) -> Result<&'static Self> {
        MODELS.iter().find(|model| model.number == number).ok_or_else(|| unsupported(object, &format!("number {number}")))
    }
    /// By COLMAP's name.
    pub(crate) fn from_name(name: &str) -> Option<&'static Self> {
        MODELS.iter().find(|model| model.name == name)
    }
}

/// The error of a camera whose model is not read.
fn unsupported(object: &str, model: &str) -> Error {
    if model == PANORAMA {
        return Error::unsupported(
            object,
            format!("camera model {model}"),
            "Cut perspective images out of the panoramas (COLMAP's panorama_sfm.py), and use these",
        );
    }
    let known = MODELS.iter().filter(|model| model.is_read).map(|model| model.name).collect::<Vec<_>>().join(", ");
    Error::unsupported(object, format!("camera model {model}"), format!("Undistort with COLMAP (colmap image_undistorter), or use one of {known}"))
}

impl ColmapCamera {
    /// Focal lengths and principal point in pixels, lens. Errors, about the camera `object`: [`Error::Unsupported`] for models that are not read,
    /// [`Error::Data`] for numbers that `EUCM` cannot have.
    pub(crate) fn intrinsics(&self, object: &str) -> Result<([f64; 2], [f64; 2], Distortion)> {
        let brown = |k1: f64, k2: f64, p1: f64, p2: f64| Distortion::Brown { radial: [k1, k2, 0.0, 0.0], tangential: [p1, p2] };
        let fisheye = |radial: [f64; 4]| Distortion::Fisheye { radial };
        Ok(match (self.model.as_str(), self.parameters.as_slice()) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f; 2], [cx, cy], Distortion::None),
            ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Distortion::None),
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f; 2], [cx, cy], brown(k, 0.0, 0.0, 0.0)),
            ("RADIAL", &[f, cx, cy, k1, k2]) => ([f; 2], [cx, cy], brown(k1, k2, 0.0, 0.0)),
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], brown(k1, k2, p1, p2)),
            ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => ([fx, fy], [cx, cy], fisheye([k1, k2, k3, k4])),
            ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
                ([fx, fy], [cx, cy], Distortion::Rational { numerator: [k1, k2, k3], denominator: [k4, k5, k6], tangential: [p1, p2] })
            }
            ("FOV", &[fx, fy, cx, cy, omega]) => ([fx, fy], [cx, cy], Distortion::FieldOfView { omega }),
            ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => ([f; 2], [cx, cy], fisheye([k, 0.0, 0.0, 0.0])),
            ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => ([f; 2], [cx, cy], fisheye([k1, k2, 0.0, 0.0])),
            ("THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1]) => {
                ([fx, fy], [cx, cy], Distortion::ThinPrismFisheye { radial: [k1, k2, k3, k4], tangential: [p1, p2], prism: [sx1, sy1] })
            }
            ("RAD_TAN_THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => {
                let (radial, tangential, prism) = ([k0, k1, k2, k3, k4, k5], [p0, p1], [s0, s1, s2, s3]);
                ([fx, fy], [cx, cy], Distortion::RadTanThinPrismFisheye { radial, tangential, prism })
            }
            ("SIMPLE_DIVISION", &[f, cx, cy, k]) => ([f; 2], [cx, cy], Distortion::Division { k }),
            ("DIVISION", &[fx, fy, cx, cy, k]) => ([fx, fy], [cx, cy], Distortion::Division { k }),
            ("EUCM", &[fx, fy, cx, cy, alpha, beta]) => {
                if !(0.0..=1.0).contains(&alpha) || !(f64::MIN_POSITIVE..=f64::MAX).contains(&beta) {
                    let problem = format!("camera model EUCM with alpha = {alpha} and beta = {beta}; alpha is from 0 to 1, beta over 0");
                    return Err(Error::data(object, problem, "The file is damaged; export the model again"));
                }
                ([fx, fy], [cx, cy], Distortion::EnhancedUnified { alpha, beta })
            }
            ("SIMPLE_FISHEYE", &[f, cx, cy]) => ([f; 2], [cx, cy], fisheye([0.0; 4])),
            ("FISHEYE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], fisheye([0.0; 4])),
            (model, _) => return Err(unsupported(object, model)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_that_are_read_have_intrinsics_and_others_are_named() {
        for model in &MODELS {
            let camera = ColmapCamera { model: model.name.into(), size: [64, 48], parameters: vec![0.5; model.parameters] };
            assert_eq!(camera.intrinsics("t").is_ok(), model.is_read, "{}", model.name);
        }
        let message = |model: &str, parameters: &[f64]| {
            let camera = ColmapCamera { model: model.into(), size: [64, 48], parameters: parameters.to_vec() };
            camera.intrinsics("t: camera 7").unwrap_err().to_string()
        };
        let other = message("OTHER", &[]);
        assert!(other.contains("t: camera 7") && other.contains("camera model OTHER") && other.contains("image_undistorter), or use one of"), "{other}");
        let panorama = message("EQUIRECTANGULAR", &[64.0, 48.0]);
        assert!(panorama.contains("camera model EQUIRECTANGULAR") && panorama.contains("panorama_sfm.py"), "{panorama}");
        for [alpha, beta] in [[-0.1, 1.0], [1.1, 1.0], [f64::NAN, 1.0], [0.5, 0.0], [0.5, f64::NAN], [0.5, f64::INFINITY]] {
            let message = message("EUCM", &[60.0, 61.0, 32.0, 24.0, alpha, beta]);
            assert!(message.contains("camera model EUCM") && message.contains("alpha is from 0 to 1"), "{message}");
        }
    }

    #[test]
    fn coefficients_are_in_the_order_of_colmap() {
        let lens = |model: &str, parameters: &[f64]| {
            let (focal, principal, lens) = ColmapCamera { model: model.into(), size: [64, 48], parameters: parameters.to_vec() }.intrinsics("t").unwrap();
            assert_eq!((focal, principal), ([60.0, 61.0], [32.0, 24.0]));
            lens
        };
        let twelve = [60.0, 61.0, 32.0, 24.0, 0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6];
        let rational = Distortion::Rational { numerator: [0.1, 0.2, 0.3], denominator: [0.4, 0.5, 0.6], tangential: [0.01, 0.02] };
        assert_eq!(lens("FULL_OPENCV", &twelve), rational);
        let prism = Distortion::ThinPrismFisheye { radial: [0.1, 0.2, 0.3, 0.4], tangential: [0.01, 0.02], prism: [0.5, 0.6] };
        assert_eq!(lens("THIN_PRISM_FISHEYE", &twelve), prism);
        let long: Vec<f64> = [60.0, 61.0, 32.0, 24.0].into_iter().chain((1..=12).map(|k| f64::from(k) / 16.0)).collect();
        let rad_tan = Distortion::RadTanThinPrismFisheye {
            radial: [0.0625, 0.125, 0.1875, 0.25, 0.3125, 0.375],
            tangential: [0.4375, 0.5],
            prism: [0.5625, 0.625, 0.6875, 0.75],
        };
        assert_eq!(lens("RAD_TAN_THIN_PRISM_FISHEYE", &long), rad_tan);
        assert_eq!(lens("DIVISION", &[60.0, 61.0, 32.0, 24.0, -0.2]), Distortion::Division { k: -0.2 });
        assert_eq!(lens("EUCM", &[60.0, 61.0, 32.0, 24.0, 0.6, 1.2]), Distortion::EnhancedUnified { alpha: 0.6, beta: 1.2 });
        assert_eq!(lens("FOV", &[60.0, 61.0, 32.0, 24.0, 0.9]), Distortion::FieldOfView { omega: 0.9 });
    }
}
