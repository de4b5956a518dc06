//! All suites of the workspace in one program, so that burn is linked only once. `cargo test --release --workspace --test suite NAME` runs a part.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests: a failed helper is a failed test, and skipped ones say so")]

mod auto;
mod baselines;
mod basis;
mod blur;
mod cdf;
mod checkpoints;
mod checks;
mod codec_context;
mod codec_services;
mod codecs;
mod colors;
mod columns;
mod conformance;
mod end_to_end;
mod fresh_cases;
mod golden_codec;
mod golden_geometry;
mod golden_metrics;
mod golden_raster;
mod golden_training;
mod guard;
mod image;
mod links;
mod lives;
mod lookup;
mod manifests;
mod observer;
mod orbit;
mod planted;
mod raster;
mod raster_edges;
mod raster_fixtures;
mod raster_probes;
mod readers;
mod regrowth;
mod session;
mod shortcuts;
mod sort;
mod sums;
mod sweeps;
mod tuning;
mod view_sums;
mod views_per_iteration;
mod watchdog;
