//! The node that rasterization leaves in the graph.

use super::{GradientRequest, Method, Probes, RasterBackward, RasterGradients, RasterOps, RasterSettings, Rasterized, Saved, SplatTensors};
use crate::ops::autodiff::{differentiate, record_beside};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Backend};

/// Parents of the operation: the tensors of [`SplatTensors`], then those of [`Probes`], in the order of their fields.
const PARENTS: usize = 10;

fn request([means, scales, quaternions, opacities, colors, sh_rest, background, screen, absolute_screen, camera]: [bool; PARENTS]) -> GradientRequest {
    GradientRequest { means, scales, quaternions, opacities, colors, sh_rest, background, screen, absolute_screen, camera }
}

fn by_parent<B: Backend>(g: RasterGradients<B>) -> [Option<FloatTensor<B>>; PARENTS] {
    [g.means, g.scales, g.quaternions, g.opacities, g.colors, g.sh_rest, g.background, g.screen, g.absolute_screen, g.camera]
}

#[derive(Debug)]
struct Rasterize;

impl<B: RasterBackward> Backward<B, PARENTS> for Rasterize {
    type State = (SplatTensors<B>, RasterSettings, Saved);

    fn backward(self, ops: Ops<Self::State, PARENTS>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, PARENTS>(ops, grads, |(splats, settings, saved), upstream, wanted| {
            by_parent(B::rasterize_backward(splats, &settings, &saved, upstream, request(wanted)))
        });
    }
}

impl<B: RasterOps + RasterBackward, C: CheckpointStrategy> RasterOps for Autodiff<B, C> {
    fn rasterize(splats: SplatTensors<Self>, probes: Probes<Self>, settings: RasterSettings, method: Method) -> Rasterized<Self> {
        let (means, of_means) = splats.means.into_parts();
        let (scales, of_scales) = splats.scales.into_parts();
        let (quaternions, of_quaternions) = splats.quaternions.into_parts();
        let (opacities, of_opacities) = splats.opacities.into_parts();
        let (colors, of_colors) = splats.colors.into_parts();
        let (sh_rest, of_rest) = splats.sh_rest.into_parts();
        let (background, of_background) = splats.background.into_parts();
        let (screen, of_screen) = probes.screen.into_parts();
        let (absolute_screen, of_absolute) = probes.absolute_screen.into_parts();
        let (camera, of_camera) = probes.camera.into_parts();
        let parents = [of_means, of_scales, of_quaternions, of_opacities, of_colors, of_rest, of_background, of_screen, of_absolute, of_camera];
        let splats = SplatTensors { means, scales, quaternions, opacities, colors, sh_rest, background };
        let probes = Probes { screen, absolute_screen, camera };
        let (planes, (radii, max_weights, work, pair_count, refused, saved)) = record_beside::<B, C, _, _, PARENTS>(Rasterize, parents, |_| {
            let out = B::rasterize(splats.clone(), probes, settings.clone(), method);
            let state = (splats, settings, out.saved.clone());
            (out.planes, state, (out.radii, out.max_weights, out.work, out.pair_count, out.refused, out.saved))
        });
        Rasterized { planes, radii, max_weights: Self::from_inner(max_weights), work, pair_count, refused, saved }
    }
}
