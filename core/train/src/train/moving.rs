//! What may move in a run.

use crate::config::{Dynamic, TrainConfig};
use crate::schedule::StageLengths;
use cc4dgs_core::{Error, Result, Scene, Split, Stage};
use cc4dgs_play::Moving;
use std::collections::BTreeMap;

/// Whether everything, nothing, or what the dynamic scores say may move.
///
/// # Errors
/// [`Error::Parameter`] where scores are asked for and no iteration fits them.
pub(super) fn decide_moving(train: &TrainConfig, scene: &Scene) -> Result<Moving> {
    let mut frames_of_camera: BTreeMap<usize, usize> = BTreeMap::new();
    for view in scene.split(Split::Train) {
        *frames_of_camera.entry(scene.views[view].camera).or_default() += 1;
    }
    let several_frames = frames_of_camera.values().any(|&frames| frames >= 2);
    let fits_scores = StageLengths::new(train, true, scene.extent()).length(Stage::Score) > 0;
    Ok(match train.dynamic {
        _ if scene.frame_count <= 1 => Moving::Nothing,
        Dynamic::None => Moving::Nothing,
        Dynamic::All => Moving::Everything,
        Dynamic::Score if !fits_scores => {
            let problem = format!("{:?} leave the score stage no iteration of {}, and train.dynamic = \"score\" needs it", train.shares, train.iterations);
            return Err(Error::parameter("train.shares", problem, "Give the score stage a share, or set train.dynamic = \"all\" or \"none\""));
        }
        Dynamic::Score => Moving::Scored { zeta: train.zeta },
        Dynamic::Auto if several_frames && fits_scores => Moving::Scored { zeta: train.zeta },
        Dynamic::Auto => Moving::Everything,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, NoImages, View};
    use std::sync::Arc;

    /// Two cameras that stand still.
    fn scene(frames: usize) -> Scene {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (8, 8), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |i: usize| View { camera: i % 2, frame: i / 2, time_norm: 0.0, split: Split::Train };
        Scene::new("s", (0..2).map(camera).collect(), (0..2 * frames).map(view).collect(), Arc::new(NoImages), 0).unwrap()
    }

    #[test]
    fn without_a_score_stage_all_gaussians_may_move() {
        let decided = |dynamic, shares, iterations, frames| {
            let train = TrainConfig { dynamic, shares, iterations, zeta: 3.0, ..Default::default() };
            decide_moving(&train, &scene(frames)).map_err(|e| e.to_string())
        };
        let (with, without) = ([5.0, 3.0, 20.0], [5.0, 0.0, 20.0]);
        let scored = Ok(Moving::Scored { zeta: 3.0 });
        assert_eq!((decided(Dynamic::Auto, with, 280, 3), decided(Dynamic::Score, with, 280, 3)), (scored.clone(), scored));
        // No share, or so short a run that none of its iterations is left.
        for (shares, iterations) in [(without, 280), (with, 4)] {
            assert_eq!(decided(Dynamic::Auto, shares, iterations, 3), Ok(Moving::Everything));
            let refused = decided(Dynamic::Score, shares, iterations, 3).unwrap_err();
            assert!(refused.contains("train.shares") && refused.contains("score stage"), "{refused}");
            for dynamic in [Dynamic::Auto, Dynamic::Score, Dynamic::All] {
                assert_eq!(decided(dynamic, shares, iterations, 1), Ok(Moving::Nothing), "a static scene stays static");
            }
        }
        assert_eq!((decided(Dynamic::None, without, 280, 3), decided(Dynamic::All, with, 280, 3)), (Ok(Moving::Nothing), Ok(Moving::Everything)));
    }
}
