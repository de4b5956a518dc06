//! How a player shows an archive: its clock and its cameras.

use crate::{Camera, Error, Result};
use serde::{Deserialize, Serialize};

/// Most capture cameras that an archive may list: its header must stay small, because players fetch it first.
pub const MAX_CAMERAS: usize = 64;

/// How a player shows an archive. All coordinates are those of the model. What is unknown is absent; archives written before these keys existed have none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Presentation {
    /// Frames per second of the recording.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames_per_second: Option<f32>,
    /// Duration of normalised time 0 to 1, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f32>,
    /// Unit vector that points up.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<[f32; 3]>,
    /// The point that orbiting cameras look at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<[f32; 3]>,
    /// The camera to start from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub home: Option<Camera>,
    /// Cameras of the recording, at most [`MAX_CAMERAS`].
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<Camera>,
}

impl Presentation {
    /// Seconds from normalised time 0 to 1 of a sequence of `frame_count` frames: as stated, else from the frame rate, else at 30 frames per second.
    pub fn seconds_of(&self, frame_count: usize) -> f32 {
        let rate = self.frames_per_second.unwrap_or(30.0);
        self.seconds.unwrap_or(frame_count.saturating_sub(1) as f32 / rate)
    }
    /// Refuses numbers that are not finite or not positive, cameras that are not rigid, and too many cameras; `object` names the file in errors.
    ///
    /// # Errors
    /// [`Error::Data`], [`Error::Limit`].
    pub fn validate(&self, object: &str) -> Result<()> {
        let bad = |problem: String| Err(Error::data(object, problem, "The file is damaged; fetch or write it again"));
        for (name, value) in [("frames_per_second", self.frames_per_second), ("seconds", self.seconds)] {
            if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0 && *v < 1e6)) {
                return bad(format!("{name} is {value}"));
            }
        }
        for (name, vector) in [("up", self.up), ("target", self.target)] {
            if let Some(vector) = vector.filter(|v| v.iter().any(|c| !c.is_finite())) {
                return bad(format!("{name} is {vector:?}"));
            }
        }
        if let Some(up) = self.up.filter(|up| (up.iter().map(|c| c * c).sum::<f32>() - 1.0).abs() > 1e-3) {
            return bad(format!("up is {up:?}, not a unit vector"));
        }
        if self.cameras.len() > MAX_CAMERAS {
            return Err(Error::limit(object, self.cameras.len() as u64, MAX_CAMERAS as u64, "Store fewer capture cameras"));
        }
        match self.home.iter().chain(&self.cameras).find_map(|camera| Some((camera, camera.problem()?))) {
            Some((camera, problem)) => bad(format!("camera {}: {problem}", camera.name)),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_camera_is_an_error_of_the_file() {
        let camera = Camera::look_at("c1", (8, 8), 1.0, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]);
        let of = |fx: f64| Presentation { cameras: vec![Camera { fx, ..camera.clone() }], ..Presentation::default() }.validate("manifest of a.cc4d");
        assert!(of(camera.fx).is_ok());
        let error = of(-1.0).unwrap_err().to_string();
        assert!(error.starts_with("manifest of a.cc4d: camera c1: focal length (-1") && error.contains("The file is damaged"), "{error}");
        assert!(!error.contains("calibration"), "{error}");
    }
}
