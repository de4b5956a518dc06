//! Fine-tuning that encodes the same weights once, whoever asks for them.

use cc4dgs_core::{EncodedWeights, HostGaussians, Result, TuneModel, TunedModel, Tuning, WeightArray};
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use xxhash_rust::xxh3::Xxh3;

/// A tuner that keeps what it has encoded: codecs ask for the size of weights, then for that of the file that has them, and the archive stores those that were
/// adopted.
pub(crate) struct EncodedOnce<'a> {
    tuner: &'a dyn TuneModel,
    /// By [`key`].
    known: RefCell<BTreeMap<u128, EncodedWeights>>,
    /// The key of the weights that were adopted.
    adopted: Cell<Option<u128>>,
}

impl<'a> EncodedOnce<'a> {
    pub fn new(tuner: &'a dyn TuneModel) -> Self {
        Self { tuner, known: RefCell::default(), adopted: Cell::new(None) }
    }
    fn known(&self, key: u128) -> Option<EncodedWeights> {
        self.known.borrow().get(&key).cloned()
    }
}

/// A hash of weights and of the steps in which they are encoded.
fn key(weights: &[WeightArray], weight_steps: f64) -> u128 {
    let mut hash = Xxh3::new();
    hash.update(&weight_steps.to_le_bytes());
    for WeightArray { name, shape, values } in weights {
        // Lengths first, so that no two lists of arrays are the same bytes.
        let lengths = [name.len(), shape.len(), values.len()];
        lengths.iter().chain(shape).for_each(|&length| hash.update(&(length as u64).to_le_bytes()));
        hash.update(name.as_bytes());
        hash.update(bytemuck::cast_slice(values));
    }
    hash.digest128()
}

impl TuneModel for EncodedOnce<'_> {
    fn caution(&self) -> Result<Option<String>> {
        self.tuner.caution()
    }
    fn start(&self, gaussians: &HostGaussians) -> Result<TunedModel> {
        self.tuner.start(gaussians)
    }
    fn tune(&self, from: &TunedModel, tuning: &Tuning) -> Result<TunedModel> {
        self.tuner.tune(from, tuning)
    }
    fn psnr(&self, gaussians: &HostGaussians, weights: &[WeightArray], weight_steps: Option<f64>) -> Result<f64> {
        self.tuner.psnr(gaussians, weights, weight_steps)
    }
    fn encoded_weights(&self, weights: &[WeightArray], weight_steps: f64) -> Result<EncodedWeights> {
        let key = key(weights, weight_steps);
        if let Some(known) = self.known(key) {
            return Ok(known);
        }
        let found = self.tuner.encoded_weights(weights, weight_steps)?;
        self.known.borrow_mut().insert(key, found.clone());
        Ok(found)
    }
    fn adopt(&self, weights: Vec<WeightArray>, weight_steps: f64) {
        self.adopted.set(Some(key(&weights, weight_steps)));
        self.tuner.adopt(weights, weight_steps);
    }
    fn adopted(&self) -> Result<Option<EncodedWeights>> {
        match self.adopted.get().and_then(|key| self.known(key)) {
            Some(known) => Ok(Some(known)),
            None => self.tuner.adopted(),
        }
    }
}
