//! Refuses trainings whose scene has too few views for their grid: to keep some out of training, or to score any.

use super::grid::Grid;
use super::location::locate;
use super::plan::{PlannedTraining, at};
use crate::config::RunConfig;
use crate::data;
use cc4dgs_core::{Error, Registry, Result, SceneOptions, Split, SyncMode};

/// Refuses `trainings` of `grid` that would fail by the views of their scene, as the trainings themselves would: where too few training views are left beside
/// those that are kept out ([`data::hold_out`]), and where the scored side of the split has no view.
///
/// # Errors
/// [`Error::Parameter`] that names training, counts and remedy.
pub(super) fn refuse_too_few(grid: &Grid, trainings: &[PlannedTraining], registry: &Registry) -> Result<()> {
    // Most trainings of a scene open the same views.
    let mut checked: Vec<(&str, SceneOptions, usize)> = Vec::new();
    for training in trainings {
        let config = training.layers(registry)?.config()?;
        let views = (training.data.path.as_str(), config.scene.clone(), config.train.validation);
        if !checked.contains(&views) {
            check(grid, &training.data.path, &config, registry).map_err(|error| at(training, error))?;
            checked.push(views);
        }
    }
    Ok(())
}

fn check(grid: &Grid, path: &str, config: &RunConfig, registry: &Registry) -> Result<()> {
    // Offsets between videos are not looked for: that decodes them, and offsets add no views.
    let options = SceneOptions { sync: SyncMode::Off, ..config.scene.clone() };
    // A dataset that cannot be opened here is left to its training, which may have other limits, and ffmpeg.
    let Ok(scene) = data::open(&locate(path)?, &options, registry, &config.limits) else { return Ok(()) };
    let most = scene.split(Split::Train).len().saturating_sub(2);
    let rest = data::hold_out(&scene, config.train.validation).map_err(|error| of_grid(grid, most, error))?;
    if rest.split(grid.split.into()).is_empty() {
        let split = format!("{:?}", grid.split).to_lowercase();
        let remedy = "Hold cameras out (scene.test_cameras in `set` of the scene), or score validation views (split = \"validation\")";
        return Err(Error::parameter("split", format!("the scene has no {split} view that could be scored"), remedy));
    }
    Ok(())
}

/// `error` of too many views that are kept out, with the key of the grid where that asks for them; the scene can spare `most`.
fn of_grid(grid: &Grid, most: usize, error: Error) -> Error {
    match error {
        Error::Parameter { problem, .. } if grid.validation_views() > 0 => {
            let remedy = match most {
                0 => "Remove this scene from the grid, or score test views and keep none out (split = \"test\" without `validation`)".to_string(),
                _ => format!("State validation = 1 at the top of the grid; for this scene at most {most}"),
            };
            Error::parameter("validation", problem, remedy)
        }
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::super::plan::tests::example;
    use super::*;

    /// What a grid with these keys at its top refuses a training of `procedural:tiny` with these settings for.
    fn refused(top: &str, sets: &[&str]) -> Option<String> {
        let axes = "[[scene]]\nname = 'tiny'\npath = 'procedural:tiny'\n[[method]]\nname = 'own'\npreset = 'demo'\n[[codec]]\nname = 'c'\ncodec = 'raw'\n";
        let grid = Grid::parse("g.toml", &format!("name = 'g'\n{top}\n{axes}")).unwrap();
        let mut training = example().trainings.remove(0);
        training.sets = sets.iter().map(ToString::to_string).collect();
        refuse_too_few(&grid, &[training], &Registry::collect().unwrap()).err().map(|error| error.to_string())
    }

    #[test]
    fn views_that_cannot_be_spared_are_named_with_the_scene_and_the_remedy() {
        let of = |views: usize, kept_out: usize| {
            let sets = [format!("scene.max_views={views}"), format!("train.validation={kept_out}")];
            refused(&format!("split = 'validation'\nvalidation = {kept_out}"), &sets.each_ref().map(String::as_str))
        };
        let said = of(4, 12).unwrap();
        let parts = ["training 'tiny own base seed 0'", "validation: 12 of 4 training views", "validation = 1", "at most 2"];
        assert!(parts.iter().all(|part| said.contains(part)), "{said}");
        assert_eq!((of(4, 1), of(4, 2), of(0, 12)), (None, None, None));
        assert!(of(2, 1).unwrap().contains("Remove this scene"), "no number of views can be spared");
        // Asked for by a setting, with a grid that scores test views.
        let said = refused("", &["scene.max_views=4", "train.validation=9"]).unwrap();
        assert!(said.contains("train.validation: 9 of 4") && said.contains("Choose at most 2"), "{said}");
    }

    #[test]
    fn a_scene_without_views_to_score_is_refused() {
        assert_eq!(refused("", &[]), None);
        let said = refused("", &["scene.test_cameras=[]"]).unwrap();
        assert!(said.contains("tiny own base seed 0") && said.contains("no test view") && said.contains("scene.test_cameras"), "{said}");
        assert_eq!(refused("split = 'validation'", &["scene.test_cameras=[]", "train.validation=12"]), None);
        // The training says what is wrong with a scene that cannot be opened.
        assert_eq!(refused("", &["scene.test_cameras=['none']"]), None);
    }
}
