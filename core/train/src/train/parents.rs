//! Parents of the Gaussians that key frames and recovery add. A new Gaussian has from its parent what is not set explicitly: the attributes of plug-ins, such
//! as learned vectors, and a share of the optimizer's second moment.

use crate::knn::KdTree;
use cc4dgs_core::{DensityPlan, HostGaussians};
use cc4dgs_play::Moving;

/// The Gaussians that can be parents.
pub(super) struct Parents {
    rows: Vec<usize>,
    tree: KdTree,
}

impl Parents {
    /// The finite Gaussians of `host` that move, because the deformer's attributes of the others are never trained; all finite ones where none of them moves.
    pub fn new(host: &HostGaussians, moving: Moving) -> Self {
        let finite = |row: &usize| host.is_finite(*row);
        let mut rows: Vec<usize> = moving.rows(&host.dynamic_scores).unwrap_or_else(|| (0..host.len()).collect());
        rows.retain(finite);
        if rows.is_empty() {
            rows = (0..host.len()).filter(finite).collect();
        }
        let means: Vec<[f32; 3]> = rows.iter().map(|&row| std::array::from_fn(|k| host.means[3 * row + k])).collect();
        Self { rows, tree: KdTree::new(&means) }
    }
    /// Adds a Gaussian with the centre `mean` to `plan`, as a copy of the nearest parent; returns its new row.
    pub fn copy(&self, plan: &mut DensityPlan, mean: [f32; 3]) -> usize {
        let [nearest] = self.tree.nearest::<1>(&mean, None);
        let row = plan.copy(self.rows.get(nearest.index as usize).copied().unwrap_or(0));
        plan.set(row, "means", &mean);
        row
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_core::{ExtraAttribute, Gaussians};

    /// Four Gaussians on the x axis, with two attributes of plug-ins: one that stands still at 0, one that moves at 1, one that is not finite at 2, one that
    /// moves at 10.
    fn four() -> HostGaussians {
        let mut host = HostGaussians {
            means: [0.0, 1.0, 2.0, 10.0].iter().flat_map(|&x| [x, 0.0, 0.0]).collect(),
            log_scales: vec![0.0; 12],
            quaternions: vec![1.0; 16],
            opacity_logits: vec![0.0; 4],
            sh_dc: vec![0.0; 12],
            dynamic_scores: vec![0.0, 1.0, 1.0, 1.0],
            ..Default::default()
        };
        host.extra.insert("embedding".into(), ExtraAttribute::exact(2, vec![0.0, 0.0, 1.0, -1.0, 2.0, f32::NAN, 3.0, -3.0]));
        host.extra.insert("life_center".into(), ExtraAttribute::exact(1, vec![0.1, 0.2, 0.3, 0.4]));
        host
    }

    #[test]
    fn new_gaussians_have_the_attributes_of_the_nearest_that_moves() {
        let host = four();
        let parents = Parents::new(&host, Moving::Scored { zeta: 0.5 });
        let mut plan = DensityPlan::unchanged(host.len());
        for mean in [[0.1, 0.0, 0.0], [1.9, 0.0, 0.0], [7.0, 0.0, 0.0]] {
            let row = parents.copy(&mut plan, mean);
            if row == 6 {
                plan.set(row, "life_center", &[0.9]);
            }
        }
        assert_eq!(plan.parents(), [0, 1, 2, 3, 1, 1, 3]);
        assert_eq!(plan.fresh(), [false, false, false, false, true, true, true]);
        let after = plan.apply(&Gaussians::from_host(&host, &Device::flex())).unwrap().to_host().unwrap();
        assert_eq!(after.means[12..], [0.1, 0.0, 0.0, 1.9, 0.0, 0.0, 7.0, 0.0, 0.0]);
        assert_eq!(after.extra["embedding"].values[8..], [1.0, -1.0, 1.0, -1.0, 3.0, -3.0]);
        assert_eq!(after.extra["life_center"].values[4..], [0.2, 0.2, 0.9], "what is set explicitly comes last");
    }

    #[test]
    fn where_nothing_moves_any_finite_gaussian_is_a_parent() {
        let host = four();
        for moving in [Moving::Everything, Moving::Nothing, Moving::Scored { zeta: 5.0 }] {
            let (parents, mut plan) = (Parents::new(&host, moving), DensityPlan::unchanged(host.len()));
            for mean in [[0.1, 0.0, 0.0], [2.1, 0.0, 0.0], [1e30, 0.0, 0.0]] {
                parents.copy(&mut plan, mean);
            }
            assert_eq!(plan.parents()[4..6], [0, 1], "{moving:?}");
            assert_eq!(plan.parents()[6], 0, "{moving:?}: farther than float32 can say");
        }
        assert_eq!(Parents::new(&HostGaussians::default(), Moving::Everything).copy(&mut DensityPlan::new(), [0.0; 3]), 0);
    }
}
