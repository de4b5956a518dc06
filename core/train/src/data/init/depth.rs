//! Depth maps of training views, where several views agree on them.

use super::choose::{Arrangement, Choice};
use super::views::WorkSet;
use super::{fuse, sweep};
use cc4dgs_core::{Result, Scene};
use rayon::prelude::*;

/// Depth of one view on which other views agree.
pub(crate) struct AgreedDepth {
    /// Index of the view in the scene.
    pub view: usize,
    /// Size in pixels: that of the image, or smaller.
    pub width: usize,
    pub height: usize,
    /// Inverse depth in the scene's units per pixel, row by row; 0 where views do not agree.
    pub inverse: Vec<f32>,
}

/// Depth of up to 40 training views, of one time where that has several cameras; none where all images are from one position.
///
/// # Errors
/// Whatever decoding the images meets.
pub(crate) fn agreed_depths(scene: &Scene) -> Result<Vec<AgreedDepth>> {
    let choice = Choice::new(scene);
    if choice.arrangement == Arrangement::OnePose {
        return Ok(Vec::new());
    }
    let views = choice.views[..choice.keys].to_vec();
    let set = WorkSet::load(scene, choice)?;
    let maps = sweep::depth_maps(&set);
    let depth = |(index, view): (usize, usize)| {
        let (width, height) = (set.views[index].fine().width, set.views[index].fine().height);
        let inverse = fuse::agreed(&set, &maps, index).0.into_iter().map(|v| if v.is_finite() { v } else { 0.0 }).collect();
        AgreedDepth { view, width, height, inverse }
    };
    Ok(views.into_par_iter().enumerate().map(depth).collect())
}
