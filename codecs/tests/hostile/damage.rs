//! Damages to streams.

use cc4dgs_format::Stream;
use proptest::prelude::*;
use serde::{Deserialize, Serialize};

/// A damage to one stream. Positions are fractions of its length.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Damage {
    Flip(f64, u8),
    Set(f64, Vec<u8>),
    Cut(f64),
    Insert(f64, Vec<u8>),
    Remove(f64, usize),
    /// Copies bytes from another stream.
    Splice(f64, usize, usize),
    Swap(usize),
    Drop,
}

/// Any damage.
pub fn damage() -> impl Strategy<Value = Damage> {
    // Numbers that are often special: zero, largest, sign bits, infinities.
    let bytes = prop_oneof![
        prop::collection::vec(any::<u8>(), 1..9),
        prop::sample::select(vec![vec![0; 4], vec![255; 4], vec![0, 0, 128, 127], vec![255, 255, 255, 127], vec![0, 0, 0, 128], vec![255; 8]]),
    ];
    // Half of the damages hit the first bytes, where counts are.
    let share = || prop_oneof![0.0..1.0f64, (0.0..1.0f64).prop_map(|v| 0.05 * v * v)];
    prop_oneof![
        4 => (share(), 0..8u8).prop_map(|(at, bit)| Damage::Flip(at, bit)),
        4 => (share(), bytes.clone()).prop_map(|(at, bytes)| Damage::Set(at, bytes)),
        1 => share().prop_map(Damage::Cut),
        1 => (share(), bytes).prop_map(|(at, bytes)| Damage::Insert(at, bytes)),
        1 => (share(), 1..64usize).prop_map(|(at, count)| Damage::Remove(at, count)),
        1 => (share(), 0..16usize, 1..64usize).prop_map(|(at, other, count)| Damage::Splice(at, other, count)),
        1 => (0..16usize).prop_map(Damage::Swap),
        1 => Just(Damage::Drop),
    ]
}

/// Does `damage` to the stream at `which`, counted round.
pub fn harm(streams: &mut Vec<Stream>, which: usize, damage: &Damage) {
    if streams.is_empty() {
        return;
    }
    let (which, count) = (which % streams.len(), streams.len());
    let other = |k: usize| streams[k % count].bytes.clone();
    let index = |at: &f64, len: usize| ((at * len as f64) as usize).min(len.saturating_sub(1));
    match damage {
        Damage::Splice(at, k, length) => {
            let from = other(*k);
            let bytes = &mut streams[which].bytes;
            let at = index(at, bytes.len());
            bytes.iter_mut().skip(at).take(*length).zip(from).for_each(|(to, from)| *to = from);
        }
        Damage::Swap(k) => {
            let (a, b) = (streams[which].bytes.clone(), other(*k));
            streams[which].bytes = b;
            streams[k % count].bytes = a;
        }
        Damage::Drop => drop(streams.remove(which)),
        _ => {
            let bytes = &mut streams[which].bytes;
            match damage {
                Damage::Flip(at, bit) if !bytes.is_empty() => {
                    let at = index(at, bytes.len());
                    bytes[at] ^= 1 << bit;
                }
                Damage::Set(at, new) => {
                    let at = index(at, bytes.len());
                    bytes.iter_mut().skip(at).zip(new).for_each(|(to, from)| *to = *from);
                }
                Damage::Cut(at) => bytes.truncate(index(at, bytes.len())),
                Damage::Insert(at, new) => {
                    let at = index(at, bytes.len());
                    bytes.splice(at..at, new.iter().copied());
                }
                Damage::Remove(at, length) => {
                    let at = index(at, bytes.len());
                    bytes.drain(at..(at + length).min(bytes.len()));
                }
                _ => {}
            }
        }
    }
}
