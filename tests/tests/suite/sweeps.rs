//! Trainings of a sweep.

use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::{Error, Registry, Silent};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::sweep::{Busy, CellResult, Cost, Grid, Plan, SweepFolder, TrainingState, Worker, run_training};
use std::sync::atomic::AtomicBool;

#[test]
fn a_scene_with_too_few_views_is_refused_when_the_grid_is_planned() {
    let registry = Registry::collect().unwrap();
    let plan = |top: &str| {
        let grid = format!(
            "name = 'few'\nsplit = 'validation'\niterations = 40\n{top}\n\
             [[scene]]\nname = 'four'\npath = 'procedural:tiny'\nfamily = 'demo'\nset = ['scene.max_views=4']\n\
             [[method]]\nname = 'still'\npreset = '+none'\n\
             [[codec]]\nname = 'raw'\ncodec = 'raw'\n"
        );
        Plan::expand(&Grid::parse("grid", &grid).unwrap(), &registry, &|_: &RunConfig| Ok(())).map(|plan| plan.cells.len()).map_err(|error| error.to_string())
    };
    let said = plan("").unwrap_err();
    assert!(["'four still base seed 0'", "12 of 4 training views", "validation = 1"].iter().all(|part| said.contains(part)), "{said}");
    assert_eq!(plan("validation = 1"), Ok(1));
}

#[test]
fn results_of_a_sweep_do_not_state_the_limits_of_a_machine() {
    let grid = "name = 'small'\niterations = 40\nimages = 0\nmax_views = 1\nset = ['limits.max_depth=50']\n\
                [[scene]]\nname = 'tiny'\npath = 'procedural:tiny'\nfamily = 'demo'\n\
                [[method]]\nname = 'still'\npreset = '+none'\n\
                [[codec]]\nname = 'raw'\ncodec = 'raw'\n";
    let (registry, folder, never) = (Registry::collect().unwrap(), tempfile::tempdir().unwrap(), AtomicBool::new(false));
    let plan = Plan::expand(&Grid::parse("grid", grid).unwrap(), &registry, &|_: &RunConfig| Ok(())).unwrap();
    let result = |name: &str, limits: &[&str]| -> cc4dgs_core::Result<CellResult> {
        let limits: Vec<String> = limits.iter().map(ToString::to_string).collect();
        let worker = Worker { registry: &registry, events: &Silent, stop: &never, limits: &limits, processes: 1 };
        match run_training(&worker, &SweepFolder::new(folder.path().join(name)), &plan, 0, None, Busy::Wait)? {
            TrainingState::Finished(mut results) => Ok(CellResult { cost: Cost::default(), ..results.remove(0) }),
            TrainingState::Busy => panic!("no other process works on it"),
        }
    };
    let plain = result("plain", &[]).unwrap();
    assert_eq!(result("limited", &["max_depth=40", "max_gaussians=100000"]).unwrap(), plain);
    assert_eq!(plain.provenance.configuration["limits"]["max_depth"], 50);
    assert!(matches!(result("refused", &["max_pixels=10"]), Err(Error::Limit { .. })), "they decide what is refused");
}
