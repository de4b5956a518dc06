//! Sweeps: a grid of scenes, methods, settings, codecs and seeds, its results, and their tables.
//!
//! A grid ([`Grid`]) is expanded into a plan ([`Plan`]) of trainings and cells; [`run_training`] runs a training with its cells, in any process and any number
//! of times; [`collect`] checks that every cell is there and makes the tables. `docs/sweeps.md` is the manual, `docs/results.md` the form of a result.

mod cell;
mod collect;
mod columns;
mod emit;
mod facts;
mod folder;
mod grid;
mod hash;
mod lines;
mod location;
mod lock;
mod mixture;
mod overruled;
mod plan;
mod read;
mod result;
mod run;
mod settings;
mod table;
mod trained;
mod training;
mod views;

pub use collect::{Collection, Missing, Tables, collect, select, write_tables};
pub use emit::{EmitOptions, INTERRUPTED, Scheduler, emit};
pub use facts::{PeakMemory, device_facts, fingerprint};
pub use folder::{Failure, SweepFolder};
pub use grid::{Axis, CodecAxis, Grid, MethodAxis, MethodKeys, SceneAxis, SceneKeys, ScoredViews, SettingAxis, SettingKeys};
pub use lock::TrainingLock;
pub(crate) use mixture::{kept_out, notes as mixture_notes};
#[cfg(test)]
pub(crate) use plan::tests::example as example_plan;
pub use plan::{PLAN, Plan, PlannedCell, PlannedTraining};
pub use read::{RESULTS, check_comparable, read_results};
pub use result::{
    Axes, Blocks, CellResult, CodecChoice, Cost, Curve, DataFingerprint, DeviceFacts, FrameMs, ImageResult, KIND, Outcome, ResultProvenance, SCHEMA, Score,
    Storage, StreamBytes, TrainingDevice, ValidationCurve,
};
pub use run::{Busy, TrainingState, run_training, summary};
pub(crate) use table::csv_field;
pub use table::{Spread, csv, markdown};
pub(crate) use trained::{TrainingDevices, interrupted, trained_on};
pub use training::Worker;
