//! Capacities for (Gaussian, tile) pairs, so that an iteration need not wait for the device before it draws.
//!
//! How many pairs a view has is known on the device alone. Reading the number back in the middle of every view leaves a graphics card idle while the launches
//! behind it are prepared. So a view is drawn with a capacity: as many pairs as its camera had before, and a quarter more. The numbers of all views are read
//! after the backward pass was launched. If a view had more pairs than its capacity, the iteration is repeated, and pairs are counted before views are drawn.
//! So what is learned never depends on capacities, and checkpoints do not keep them.

use burn::tensor::{Int, Tensor};
use cc4dgs_core::{Error, RenderOutput, Result};
use std::collections::BTreeMap;

/// Capacity as a multiple of the pairs that a camera had when it was last drawn.
const SPARE: f64 = 1.25;
/// A capacity that is larger than needed falls by this part of itself (one over it) whenever its camera is drawn, and not at once: pairs change with the time
/// of a view. [`rounded_up`] adds less than that.
const FALL: usize = 8;

/// The camera of a view, and the width and height of its image in pixels.
pub(crate) type Key = (usize, u32, u32);

/// Capacities by camera.
#[derive(Clone, Debug, Default)]
pub(crate) struct PairCapacities {
    of: BTreeMap<Key, usize>,
}

/// A view that was drawn.
pub(crate) struct Drawn {
    key: Key,
    /// Its pairs, where the host knows them.
    known: Option<usize>,
    /// Its capacity and its pairs, still on the device.
    asked: Option<(usize, Tensor<1, Int>)>,
}

impl Drawn {
    /// What `output` was drawn with.
    pub(crate) fn new(key: Key, capacity: Option<usize>, output: &RenderOutput) -> Self {
        let known = output.stats.work.tile_pairs as usize;
        let asked = capacity.filter(|_| known == 0).zip(output.stats.pair_count.clone());
        Self { key, known: (known > 0).then_some(known), asked }
    }
}

impl PairCapacities {
    /// The capacity for a view; none before its camera was drawn for the first time, when the device is to count.
    pub(crate) fn of(&self, key: Key) -> Option<usize> {
        self.of.get(&key).copied()
    }

    /// Learns from the views of an iteration, and waits for those whose pairs the device alone knows. Returns whether all pairs of all of them were drawn.
    ///
    /// # Errors
    /// [`Error::Backend`] if the device fails.
    pub(crate) fn sufficed(&mut self, views: &[Drawn]) -> Result<bool> {
        let counts: Vec<Tensor<1, Int>> = views.iter().filter_map(|view| Some(view.asked.as_ref()?.1.clone())).collect();
        let counts: Vec<usize> = match counts.len() {
            0 => Vec::new(),
            _ => {
                let failed =
                    |e| Error::backend("number of (Gaussian, tile) pairs", format!("reading it back failed: {e:?}"), "Try another device (--device flex)");
                Tensor::cat(counts, 0).try_into_data().map_err(failed)?.iter::<i64>().map(|count| count as u32 as usize).collect()
            }
        };
        let mut counts = counts.into_iter();
        let mut sufficed = true;
        // Several views may be of one camera.
        let mut most: BTreeMap<Key, usize> = BTreeMap::new();
        for view in views {
            let pairs = match &view.asked {
                Some((capacity, _)) => {
                    let pairs = counts.next().unwrap_or(0);
                    sufficed &= pairs <= *capacity;
                    pairs
                }
                None => match view.known {
                    Some(pairs) => pairs,
                    None => continue,
                },
            };
            let of_camera = most.entry(view.key).or_default();
            *of_camera = pairs.max(*of_camera);
        }
        for (key, pairs) in most {
            let before = self.of.get(&key).map_or(0, |before| before - before / FALL);
            self.of.insert(key, rounded_up(((pairs as f64 * SPARE) as usize + 1024).max(before)));
        }
        Ok(sufficed)
    }
}

/// `capacity`, or up to an eighth more: few different sizes let the device use the same memory again.
fn rounded_up(capacity: usize) -> usize {
    capacity.next_multiple_of((capacity.next_power_of_two() / 16).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    fn asked(key: Key, capacity: usize, pairs: i64) -> Drawn {
        Drawn { key, known: None, asked: Some((capacity, Tensor::from_data(TensorData::new(vec![pairs], [1]), &Device::default()))) }
    }

    #[test]
    fn capacities_follow_what_was_drawn_and_say_where_they_did_not_suffice() {
        let (one, other) = ((0, 80, 60), (1, 80, 60));
        let mut capacities = PairCapacities::default();
        assert_eq!(capacities.of(one), None);
        let counted = Drawn { key: one, known: Some(100_000), asked: None };
        assert!(capacities.sufficed(&[counted]).unwrap());
        let room = capacities.of(one).unwrap();
        assert!((126_024..=142_000).contains(&room), "{room}");
        assert_eq!((capacities.of((0, 40, 30)), capacities.of(other)), (None, None), "smaller images and other cameras are counted first");

        assert!(capacities.sufficed(&[asked(one, room, room as i64)]).unwrap(), "as many as there is room for");
        let more = capacities.of(one).unwrap();
        assert!(!capacities.sufficed(&[asked(one, room, 90_000), asked(other, 50_000, 50_001)]).unwrap(), "one too many in the second view");
        assert!(capacities.of(other).unwrap() > 50_001, "the repeated iteration has room");
        assert!(capacities.of(one).unwrap() < more, "less is needed now");

        let two_times = || [asked(one, room, 400_000), asked(one, room, 100_000)];
        assert!(!capacities.sufficed(&two_times()).unwrap());
        assert!(capacities.of(one).unwrap() > 400_000, "the most of two views of a camera");
        // A device has 32 bits, of which burn makes a signed number.
        assert!(!capacities.sufficed(&[asked(one, room, -5)]).unwrap());
    }

    #[test]
    fn sizes_are_few_and_never_too_small() {
        let mut sizes: Vec<usize> = (1..20_000).map(rounded_up).collect();
        assert!(sizes.iter().zip(1..).all(|(&size, capacity)| size >= capacity && size <= capacity + capacity / 8 + 1));
        sizes.dedup();
        assert!(sizes.len() < 200, "{} sizes", sizes.len());
    }
}
