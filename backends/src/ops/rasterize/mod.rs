//! Rasterization as one operation with a hand-written derivative.

mod cpu;

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, DispatchDevice, ExtensionType, backend_extension};
use burn::tensor::{Device, Int, Tensor};
use cc4dgs_core::{Error, RenderOutput, RenderStats, RenderWork, Result};
use std::any::Any;
use std::fmt;
use std::sync::Arc;

pub use crate::cpu::raster::RasterSettings;

/// Which implementation of a device draws.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// Tiles.
    #[default]
    Tiles,
    /// The float64 reference, on the host.
    Reference,
}

/// What a device keeps between the forward and the backward pass. Only the device that made it can read it.
#[derive(Clone)]
pub struct Saved(Arc<dyn Any + Send + Sync>);

impl Saved {
    /// Wraps a device's own state.
    pub fn new<T: Send + Sync + 'static>(state: T) -> Self {
        Self(Arc::new(state))
    }
    /// The state, if it is of type `T`.
    pub fn get<T: 'static>(&self) -> Option<&T> {
        self.0.downcast_ref()
    }
}

impl fmt::Debug for Saved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Saved")
    }
}

/// Why a device does not draw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// More (Gaussian, tile) pairs than there may be.
    Pairs {
        /// Pairs there are.
        found: u64,
        /// Pairs there may be.
        limit: u64,
    },
    /// An array of so many Gaussians is larger than a kernel of the device may read.
    Gaussians {
        /// Gaussians there are.
        found: u64,
        /// Gaussians that fit.
        limit: u64,
    },
}

impl Refusal {
    fn error(self) -> Error {
        match self {
            Self::Pairs { found, limit } => {
                Error::limit("render", found, limit, "The value counts (Gaussian, tile) pairs: prune huge Gaussians or render a smaller image")
            }
            Self::Gaussians { found, limit } => Error::limit(
                "render",
                found,
                limit,
                "The value counts Gaussians; the limit is what the adapter lets a kernel read at once. Use a device with larger bindings (cc4dgs doctor), or fewer Gaussians",
            ),
        }
    }
}

/// What the forward pass of a device returns.
#[derive(ExtensionType)]
pub struct Rasterized<B: Backend> {
    /// Red, green, blue, alpha, depth [5,H,W].
    pub planes: FloatTensor<B>,
    /// Screen radii in pixels [N].
    pub radii: IntTensor<B>,
    /// Largest blending weights [N]; [0] unless asked for.
    pub max_weights: FloatTensor<B>,
    /// Counts of work.
    pub work: RenderWork,
    /// Pairs of Gaussians and tiles [1].
    pub pair_count: IntTensor<B>,
    /// Why nothing was drawn, if so; the planes are empty then.
    pub refused: Option<Refusal>,
    /// For the backward pass.
    pub saved: Saved,
}

/// Rasterization per device. The screen and camera probes are not read; they are there to receive gradients.
#[backend_extension(Flex, NdArray, Cube, Autodiff)]
pub trait RasterOps: Backend {
    /// Renders Gaussians: `means` [N,3], `scales` [N,3], `quaternions` [N,4], `opacities` [N], `colors` [N,3], `sh_rest` [N,K,3],
    /// `screen_probe` [N,2], `camera_probe` [4,4], `background` [3].
    fn rasterize(
        means: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        quaternions: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        sh_rest: FloatTensor<Self>,
        screen_probe: FloatTensor<Self>,
        camera_probe: FloatTensor<Self>,
        background: FloatTensor<Self>,
        settings: RasterSettings,
        method: Method,
    ) -> Rasterized<Self>;
}

/// The parents of the operation, as the backward pass reads them: means, scales, quaternions, opacities, colors, sh_rest, background.
pub type SavedInputs<B> = [FloatTensor<B>; 7];

/// Number of parents: those of [`SavedInputs`], the screen probe and the camera probe.
pub const PARENTS: usize = 9;

/// The derivative per device.
pub trait RasterBackward: Backend {
    /// Gradients of the parents in the order of the arguments of [`RasterOps::rasterize`]; only those wanted.
    fn rasterize_backward(
        inputs: SavedInputs<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        wanted: [bool; PARENTS],
    ) -> [Option<FloatTensor<Self>>; PARENTS];
}

/// The node in the graph.
#[derive(Debug)]
struct RasterNode;

/// What the node remembers: inputs, settings, the device's state.
type NodeState<B> = (SavedInputs<B>, RasterSettings, Saved);

impl<B: RasterBackward> Backward<B, PARENTS> for RasterNode {
    type State = NodeState<B>;

    fn backward(self, ops: Ops<Self::State, PARENTS>, grads: &mut Gradients, _: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let (inputs, settings, saved) = ops.state;
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let gradients = B::rasterize_backward(inputs, &settings, &saved, upstream, wanted);
        for (parent, gradient) in ops.parents.into_iter().zip(gradients) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                grads.register::<B>(parent.id, gradient);
            }
        }
    }
}

impl<B: RasterOps + RasterBackward, C: CheckpointStrategy> RasterOps for Autodiff<B, C> {
    fn rasterize(
        means: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        quaternions: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        sh_rest: FloatTensor<Self>,
        screen_probe: FloatTensor<Self>,
        camera_probe: FloatTensor<Self>,
        background: FloatTensor<Self>,
        settings: RasterSettings,
        method: Method,
    ) -> Rasterized<Self> {
        let (means, n0) = means.into_parts();
        let (scales, n1) = scales.into_parts();
        let (quaternions, n2) = quaternions.into_parts();
        let (opacities, n3) = opacities.into_parts();
        let (colors, n4) = colors.into_parts();
        let (sh_rest, n5) = sh_rest.into_parts();
        let (screen_probe, n6) = screen_probe.into_parts();
        let (camera_probe, n7) = camera_probe.into_parts();
        let (background, n8) = background.into_parts();
        let inputs = [means, scales, quaternions, opacities, colors, sh_rest, background];
        let [means, scales, quaternions, opacities, colors, sh_rest, background] = inputs.clone();
        let prep = RasterNode.prepare::<C>([n0, n1, n2, n3, n4, n5, n6, n7, n8]).compute_bound().stateful();
        let out = B::rasterize(means, scales, quaternions, opacities, colors, sh_rest, screen_probe, camera_probe, background, settings.clone(), method);
        let Rasterized { planes, radii, max_weights, work, pair_count, refused, saved } = out;
        let planes = match prep {
            OpsKind::Tracked(prep) => prep.finish((inputs, settings, saved.clone()), planes),
            OpsKind::UnTracked(prep) => prep.finish(planes),
        };
        Rasterized { planes, radii, max_weights: Self::from_inner(max_weights), work, pair_count, refused, saved }
    }
}

/// The tensors of one render; what is absent is a constant without gradient.
pub struct RasterInputs {
    /// Centres in world units [N,3].
    pub means: Tensor<2>,
    /// Log-scales or scales [N,3].
    pub scales: Tensor<2>,
    /// Raw quaternions (w,x,y,z) [N,4].
    pub quaternions: Tensor<2>,
    /// Logits or opacities [N].
    pub opacities: Tensor<1>,
    /// Degree-0 coefficients, or colours [N,3].
    pub colors: Tensor<2>,
    /// Higher coefficients [N,K,3].
    pub sh_rest: Option<Tensor<3>>,
    /// Receives d loss / d projected centre [N,2].
    pub screen_probe: Option<Tensor<2>>,
    /// Receives d loss / d world_to_camera [4,4].
    pub camera_probe: Option<Tensor<2>>,
    /// Colour behind everything [3]; black if absent.
    pub background: Option<Tensor<1>>,
}

/// Refuses a device that lacks the operation.
fn check_device(device: &Device, method: Method) -> Result<()> {
    match device.clone().without_autodiff().as_dispatch() {
        DispatchDevice::Flex(_) | DispatchDevice::NdArray(_) => Ok(()),
        DispatchDevice::Cube(_) if method == Method::Tiles => Ok(()),
        DispatchDevice::Cube(_) => Err(Error::unsupported(
            format!("rasterizer reference on {device:?}"),
            "it computes in float64, on the host",
            "Use --device flex, or the rasterizer tile",
        )),
        _ => Err(Error::unsupported(format!("rasterize on {device:?}"), "this device has no rasterizer yet", "Use --device flex or ndarray")),
    }
}

/// Renders; shapes must agree with `settings` (the rasterizer plug-ins check them).
pub fn rasterize(inputs: RasterInputs, settings: RasterSettings, method: Method) -> Result<RenderOutput> {
    let device = inputs.means.device();
    check_device(&device, method)?;
    // Stand-ins for what is absent: probes are never read, no background is black.
    let absent = || Tensor::<1>::empty([3], &device);
    let black = || Tensor::<1>::zeros([3], &device);
    let wants_weights = settings.max_weights;
    let out = <Dispatch as RasterOps>::rasterize(
        inputs.means.into_dispatch(),
        inputs.scales.into_dispatch(),
        inputs.quaternions.into_dispatch(),
        inputs.opacities.into_dispatch(),
        inputs.colors.into_dispatch(),
        inputs.sh_rest.map_or_else(|| absent().into_dispatch(), Tensor::into_dispatch),
        inputs.screen_probe.map_or_else(|| absent().into_dispatch(), Tensor::into_dispatch),
        inputs.camera_probe.map_or_else(|| absent().into_dispatch(), Tensor::into_dispatch),
        inputs.background.map_or_else(|| black().into_dispatch(), Tensor::into_dispatch),
        settings,
        method,
    );
    if let Some(refusal) = out.refused {
        return Err(refusal.error());
    }
    Ok(RenderOutput {
        planes: Tensor::from_dispatch(out.planes),
        stats: RenderStats {
            radii: Tensor::<1, Int>::from_dispatch(out.radii),
            max_weights: wants_weights.then(|| Tensor::from_dispatch(out.max_weights)),
            pair_count: Some(Tensor::from_dispatch(out.pair_count)),
            work: out.work,
        },
    })
}
