//! What a JSON says of a lens, of all images or of one, and the cameras that follow from it.

use super::nerfstudio::plain;
use cc4dgs_core::reader::pose::{from_opengl_camera_to_world, matrix4};
use cc4dgs_core::{Distortion, Error, RawCamera, Result};
use serde::Deserialize;

/// The model of fisheye lenses.
const FISHEYE: &str = "OPENCV_FISHEYE";
/// The model whose k4, k5 and k6 are those of a denominator.
const RATIONAL: &str = "FULL_OPENCV";

/// What a file says of a lens: of all images, or of one.
#[derive(Clone, Default, Deserialize)]
pub(crate) struct Intrinsics {
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    /// nerfstudio's list of k1, k2, k3, k4, p1, p2, which counts in place of those that stand beside it. An empty one states a lens without distortion.
    distortion_params: Option<Vec<f64>>,
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
}

impl Intrinsics {
    /// Own values first, then the shared ones.
    pub(crate) fn over(&self, shared: &Self) -> Self {
        let (own, mut shared) = (self.with_names(), shared.with_names());
        // A focal length and the kind of a lens may be stated in two ways: what is stated in one way displaces what is shared in the other.
        if own.camera_angle_x.or(own.camera_angle_y).is_some() {
            [shared.fl_x, shared.fl_y, shared.camera_angle_x, shared.camera_angle_y] = [None; 4];
        }
        if own.fl_x.or(own.fl_y).is_some() {
            [shared.camera_angle_x, shared.camera_angle_y] = [None; 2];
        }
        if own.camera_model.is_some() {
            shared.is_fisheye = None;
        }
        if own.is_fisheye.is_some() {
            shared.camera_model = shared.camera_model.filter(|model| model != FISHEYE);
        }
        macro_rules! first {
            ($($field:ident),*) => { Self { $($field: own.$field.or(shared.$field)),* } };
        }
        first!(camera_angle_x, camera_angle_y, fl_x, fl_y, cx, cy, w, h, k1, k2, k3, k4, k5, k6, p1, p2, distortion_params, camera_model, is_fisheye)
    }
    /// With the coefficients of the list by their names. A list of another length stays as it is, and [`Self::distortion`] refuses it.
    fn with_names(&self) -> Self {
        let list = match self.distortion_params.as_deref() {
            Some([]) => [0.0; 6],
            Some(&[k1, k2, k3, k4, p1, p2]) => [k1, k2, k3, k4, p1, p2],
            _ => return self.clone(),
        };
        let [k1, k2, k3, k4, p1, p2] = list.map(Some);
        let [k5, k6] = if self.distortion_params.as_ref().is_some_and(Vec::is_empty) { [Some(0.0); 2] } else { [self.k5, self.k6] };
        Self { k1, k2, k3, k4, k5, k6, p1, p2, ..self.clone() }
    }
    fn distortion(&self) -> Result<Distortion, String> {
        let radial = [self.k1, self.k2, self.k3, self.k4].map(|k| k.unwrap_or(0.0));
        let tangential = [self.p1.unwrap_or(0.0), self.p2.unwrap_or(0.0)];
        let ([k1, k2, k3, k4], [k5, k6]) = (radial, [self.k5, self.k6].map(|k| k.unwrap_or(0.0)));
        let distortion = match self.camera_model.as_deref().unwrap_or("OPENCV") {
            FISHEYE => Distortion::Fisheye { radial },
            _ if self.is_fisheye == Some(true) => Distortion::Fisheye { radial },
            RATIONAL => Distortion::Rational { numerator: [k1, k2, k3], denominator: [k4, k5, k6], tangential },
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE" => Distortion::Brown { radial, tangential },
            other => {
                return Err(format!(
                    "camera model {other:?} is not supported; known are OPENCV, {RATIONAL}, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, {FISHEYE}"
                ));
            }
        };
        if !matches!(distortion, Distortion::Rational { .. }) && (k5 != 0.0 || k6 != 0.0) {
            return Err(format!(
                "k5 is {k5} and k6 is {k6}, which only {RATIONAL} has: state this camera_model if k4, k5 and k6 are those of the denominator, as in OpenCV, \
                 or else undistort the images"
            ));
        }
        match self.distortion_params.as_ref().map(Vec::len).filter(|count| !matches!(count, 0 | 6)) {
            Some(count) => Err(format!("distortion_params has {count} numbers, not the six k1, k2, k3, k4, p1, p2")),
            None => Ok(distortion),
        }
    }
    /// Focal lengths from pixels, or from the angles of view.
    fn focal(&self, w: f64, h: f64) -> Result<[f64; 2], String> {
        if let Some(angle) = [self.camera_angle_x, self.camera_angle_y].into_iter().flatten().find(|a| !(*a > 0.0 && *a < std::f64::consts::PI)) {
            return Err(format!("camera_angle_x or camera_angle_y is {angle}, not an angle below pi in radians"));
        }
        let from_angle = |size: f64, angle: f64| 0.5 * size / (0.5 * angle).tan();
        let fx = self.fl_x.or_else(|| self.camera_angle_x.map(|a| from_angle(w, a))).or(self.fl_y);
        let fx = fx.or_else(|| self.camera_angle_y.map(|a| from_angle(h, a))).ok_or("it has neither fl_x nor camera_angle_x")?;
        Ok([fx, self.fl_y.or_else(|| self.camera_angle_y.map(|a| from_angle(h, a))).unwrap_or(fx)])
    }
}

/// The camera of the image `name`: its pose is a camera-to-world matrix with OpenGL axes. `image_size` is asked where the file says none.
pub(crate) fn camera(
    name: &str,
    pose: &[Vec<f64>],
    intrinsics: &Intrinsics,
    image_size: &dyn Fn() -> Result<(u32, u32)>,
    bad: &dyn Fn(String) -> Error,
) -> Result<RawCamera> {
    let (w, h) = match (intrinsics.w, intrinsics.h) {
        (Some(w), Some(h)) if w >= 1.0 && h >= 1.0 && w <= 1e6 && h <= 1e6 => (w, h),
        (None, None) => {
            let (w, h) = image_size()?;
            (f64::from(w), f64::from(h))
        }
        sides => {
            let [w, h] = [sides.0, sides.1].map(|side| side.map_or_else(|| "missing".to_string(), |v| v.to_string()));
            return Err(bad(format!("w is {w} and h is {h}; both must be from 1 to 1000000 pixels, or both left out")));
        }
    };
    let world_to_camera = matrix4(pose).and_then(|m| from_opengl_camera_to_world(&m)).map_err(bad)?;
    Ok(RawCamera {
        name: plain(name).to_string(),
        size: [w as u32, h as u32],
        focal: intrinsics.focal(w, h).map_err(bad)?,
        principal: [intrinsics.cx.unwrap_or(0.5 * w), intrinsics.cy.unwrap_or(0.5 * h)],
        distortion: intrinsics.distortion().map_err(bad)?,
        world_to_camera,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn merged(own: &str, shared: &str) -> Intrinsics {
        let read = |text: &str| serde_json::from_str::<Intrinsics>(text).unwrap();
        read(own).over(&read(shared))
    }

    #[test]
    fn a_list_of_coefficients_counts_as_if_they_were_named() {
        let lens = |own: &str, shared: &str| merged(own, shared).distortion();
        let brown = |radial: [f64; 4], tangential: [f64; 2]| Ok(Distortion::Brown { radial, tangential });
        let list = r#"{"k1": 9, "distortion_params": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]}"#;
        assert_eq!(lens("{}", list), brown([0.1, 0.2, 0.3, 0.4], [0.5, 0.6]));
        assert_eq!(lens(list, r#"{"k1": 7, "p2": 7, "distortion_params": [7, 7, 7, 7, 7, 7]}"#), brown([0.1, 0.2, 0.3, 0.4], [0.5, 0.6]));
        assert_eq!(lens(r#"{"k2": 7}"#, list), brown([0.1, 7.0, 0.3, 0.4], [0.5, 0.6]));
        assert_eq!(lens(r#"{"distortion_params": []}"#, list), brown([0.0; 4], [0.0; 2]));
        assert_eq!(lens(r#"{"camera_model": "OPENCV_FISHEYE"}"#, list), Ok(Distortion::Fisheye { radial: [0.1, 0.2, 0.3, 0.4] }));
        let four = r#"{"distortion_params": [0.1, 0.2, 0.3, 0.4]}"#;
        assert_eq!(lens(list, four), brown([0.1, 0.2, 0.3, 0.4], [0.5, 0.6]), "a list of its own");
        let problem = lens("{}", four).unwrap_err();
        assert!(problem.contains("4 numbers") && problem.contains("k1, k2, k3, k4, p1, p2"), "{problem}");
        assert!(lens(r#"{"camera_model": "FISHEYE624"}"#, four).unwrap_err().contains("FISHEYE624"));
    }

    #[test]
    fn the_rational_lens_has_six_radial_coefficients() {
        let named = r#""k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "k5": 0.5, "k6": 0.6, "p1": 0.01, "p2": 0.02"#;
        let lens = |own: &str, shared: &str| merged(own, shared).distortion();
        let rational = Distortion::Rational { numerator: [0.1, 0.2, 0.3], denominator: [0.4, 0.5, 0.6], tangential: [0.01, 0.02] };
        let model = |name: &str| format!(r#"{{"camera_model": "{name}"}}"#);
        assert_eq!(lens(&model("FULL_OPENCV"), &format!("{{{named}}}")), Ok(rational));
        for name in ["OPENCV", FISHEYE] {
            let problem = lens(&model(name), &format!("{{{named}}}")).unwrap_err();
            assert!(problem.contains("k5 is 0.5 and k6 is 0.6") && problem.contains("FULL_OPENCV"), "{problem}");
        }
        assert!(lens(r#"{"k5": 0.0, "k6": 0.0}"#, &format!("{{{named}}}")).is_ok(), "zeros of its own");
        assert!(lens(r#"{"distortion_params": []}"#, &format!("{{{named}}}")).is_ok(), "a lens without distortion");
    }

    #[test]
    fn what_an_image_states_in_one_way_displaces_what_is_shared_in_the_other() {
        let focal = |own: &str, shared: &str| merged(own, shared).focal(100.0, 60.0).unwrap().map(|f| (1e6 * f).round() / 1e6);
        let (right_angle, pixels) = (r#"{"camera_angle_x": 1.5707963267948966}"#, r#"{"fl_x": 70, "fl_y": 71}"#);
        assert_eq!(focal(right_angle, pixels), [50.0; 2]);
        assert_eq!(focal(r#"{"camera_angle_y": 1.5707963267948966}"#, pixels), [30.0; 2]);
        assert_eq!(focal(pixels, right_angle), [70.0, 71.0]);
        assert_eq!(focal(r#"{"fl_x": 80}"#, r#"{"camera_angle_x": 1.5, "camera_angle_y": 1.5}"#), [80.0; 2]);
        assert_eq!(focal(r#"{"fl_x": 80}"#, pixels), [80.0, 71.0]);
        assert_eq!(focal("{}", pixels), [70.0, 71.0]);
        let is_fisheye = |own: &str, shared: &str| matches!(merged(own, shared).distortion().unwrap(), Distortion::Fisheye { .. });
        let model = |name: &str| format!(r#"{{"camera_model": "{name}"}}"#);
        let flag = |is_fisheye: bool| format!(r#"{{"is_fisheye": {is_fisheye}}}"#);
        assert!(!is_fisheye(&model("OPENCV"), &flag(true)) && is_fisheye(&model(FISHEYE), &flag(false)));
        assert!(!is_fisheye(&flag(false), &model(FISHEYE)) && is_fisheye(&flag(true), &model("OPENCV")));
    }
}
