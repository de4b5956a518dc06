//! `cc4dgs bench`: timings on workloads that are made from a seed.

mod agree;
mod field;
mod frame;
mod lookup;
mod parts;
mod step;

pub use agree::agree;
pub use field::field;
pub use frame::frame;
pub use lookup::lookup;
pub use parts::{loss, sort};
pub use step::step;

use cc4dgs_backends::bench::{ROOM_CASES, RoomCase, shrunk};
use cc4dgs_core::{Result, unknown_name};
use std::time::Instant;

/// Runs that are not counted: caches fill and kernels compile.
const WARM_UP: usize = 2;

/// Times of `repeats` runs of what ends with a read-back.
pub fn timed(repeats: usize, mut run: impl FnMut() -> Result<()>) -> Result<Spread> {
    let mut times = Vec::with_capacity(repeats);
    for round in 0..WARM_UP + repeats {
        let began = Instant::now();
        run()?;
        if round >= WARM_UP {
            times.push(began.elapsed().as_secs_f64() * 1e3);
        }
    }
    Ok(Spread::of(times))
}

/// The rooms of these names (all if there are none), shrunk to a share of their pixels and Gaussians.
pub fn rooms(names: &[String], share: f64) -> Result<Vec<RoomCase>> {
    if let Some(unknown) = names.iter().find(|name| !ROOM_CASES.iter().any(|c| c.name == name.as_str())) {
        return Err(unknown_name("--case", unknown, ROOM_CASES.iter().map(|c| c.name.as_ref())));
    }
    let wanted = |case: &&RoomCase| names.is_empty() || names.iter().any(|name| case.name == name.as_str());
    Ok(ROOM_CASES.iter().filter(wanted).map(|case| shrunk(case, share)).collect())
}

/// Middle and spread of some times.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Spread {
    /// Half of the times are shorter.
    pub median_ms: f64,
    /// The shortest.
    pub min_ms: f64,
    /// A tenth of the times are longer.
    pub p90_ms: f64,
}

impl Spread {
    /// Of `times` in milliseconds; zeros if there are none.
    pub fn of(mut times: Vec<f64>) -> Self {
        times.sort_by(f64::total_cmp);
        let at = |share: f64| times.get((share * times.len() as f64) as usize).or(times.last()).copied().unwrap_or(0.0);
        Self { median_ms: at(0.5), min_ms: at(0.0), p90_ms: at(0.9) }
    }
}

#[cfg(test)]
mod tests {
    use super::Spread;

    #[test]
    fn the_spread_is_of_the_sorted_times() {
        let spread = Spread::of((0..10).rev().map(f64::from).collect());
        assert_eq!(spread, Spread { median_ms: 5.0, min_ms: 0.0, p90_ms: 9.0 });
        assert_eq!(Spread::of(Vec::new()).median_ms, 0.0);
    }
}
