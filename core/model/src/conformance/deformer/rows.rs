//! What offsets depend on: the features alone, and those of a Gaussian on its own row alone.

use super::{CENTRES, Suite, all_near, flat};
use crate::Result;

/// The first Gaussians, which are asked about without the others.
const FEW: usize = 17;
/// Largest difference of the offsets of a Gaussian with and without others, as a share of the largest offset: kernels for few rows may add in another order.
const ALONE_TOLERANCE: f32 = 1e-2;
/// Times of the offsets that are compared, and of those that are asked for in between.
const TIME: f32 = 0.37;
const BETWEEN: f32 = 0.81;

impl Suite<'_> {
    /// Playback keeps features for a whole sequence, and several players may share a deformer.
    pub(super) fn features_carry_everything(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        let (all, few) = (self.input(built.as_ref(), CENTRES, self.device), self.input(built.as_ref(), FEW, self.device));
        let features = built.spatial(&all)?.values;
        let before = flat(built.deform(features.clone(), TIME)?)?;
        built.deform(built.spatial(&few)?.values, BETWEEN)?;
        let after = flat(built.deform(features, TIME)?)?;
        Ok((before != after).then(|| "the same features give other offsets after those of other Gaussians were asked for".into()))
    }
    /// Training, playback and baking ask about different Gaussians at a time.
    pub(super) fn rows_do_not_depend_on_others(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        let all = self.input(built.as_ref(), CENTRES, self.device);
        let alone = flat(self.offsets(built.as_ref(), &all.first(FEW), TIME)?)?;
        let among = flat(self.offsets(built.as_ref(), &all, TIME)?.first(FEW))?;
        let size = among.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        let found = || format!("{FEW} Gaussians have other offsets alone than among {CENTRES}, by more than {ALONE_TOLERANCE} of the largest, {size}");
        Ok((!all_near(&alone, &among, ALONE_TOLERANCE * size)).then(found))
    }
}
