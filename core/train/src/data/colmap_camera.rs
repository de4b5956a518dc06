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
    Model::not_read(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    Model::not_read(12, "SIMPLE_DIVISION", 4),
    Model::not_read(13, "DIVISION", 5),
    Model::read(14, "SIMPLE_FISHEYE", 3),
    Model::read(15, "FISHEYE", 4),
    Model::not_read(16, "EUCM", 6),
    Model::not_read(17, "EQUIRECTANGULAR", 2),
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
    let known = MODELS.iter().filter(|model| model.is_read).map(|model| model.name).collect::<Vec<_>>().join(", ");
    Error::unsupported(object, format!("camera model {model}"), format!("Undistort with COLMAP (colmap image_undistorter), or use one of {known}"))
}

impl ColmapCamera {
    /// Focal lengths and principal point in pixels, lens. Errors: [`Error::Unsupported`] for models that are not read, about the camera `object`.
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
        let camera = ColmapCamera { model: "EUCM".into(), size: [64, 48], parameters: vec![0.5; 6] };
        let message = camera.intrinsics("t: camera 7").unwrap_err().to_string();
        assert!(message.contains("t: camera 7") && message.contains("camera model EUCM") && message.contains("THIN_PRISM_FISHEYE"), "{message}");
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
        assert_eq!(lens("FOV", &[60.0, 61.0, 32.0, 24.0, 0.9]), Distortion::FieldOfView { omega: 0.9 });
    }
}
