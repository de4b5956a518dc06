//! Rasterization as one operation with a hand-written derivative.

use crate::cpu::raster::{self, GradientRequest, SplatArrays, Workspace};
use crate::cpu::tensor::CpuBackend;
use crate::rasterizers::reference::blend::Item;
use crate::rasterizers::reference::{self, ReferenceInput};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, DispatchDevice, ExtensionType, Flex, NdArray, TensorMetadata, backend_extension};
use burn::tensor::{Device, Int, Tensor};
use cc4dgs_core::{Error, RenderOutput, RenderStats, RenderWork, Result};
use std::any::Any;
use std::fmt;
use std::sync::{Arc, Mutex};

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

fn background_of<B: CpuBackend>(tensor: &FloatTensor<B>) -> [f32; 3] {
    let values = B::floats(tensor);
    std::array::from_fn(|k| values.get(k).copied().unwrap_or(0.0))
}

fn rasterize_on_cpu<B: CpuBackend>(inputs: &SavedInputs<B>, settings: &RasterSettings, method: Method) -> Rasterized<B> {
    let [means, scales, quaternions, opacities, colors, sh_rest] = std::array::from_fn(|k| B::floats(&inputs[k]));
    let splats = SplatArrays {
        means: &means,
        scales: &scales,
        quaternions: &quaternions,
        opacities: &opacities,
        colors: &colors,
        sh_rest: &sh_rest,
        background: background_of::<B>(&inputs[6]),
    };
    if method == Method::Reference {
        return reference_forward::<B>(&splats, settings);
    }
    match raster::forward(&splats, settings) {
        Ok(out) => {
            let weights = out.max_weights.len();
            Rasterized {
                planes: B::from_floats(out.planes, [5, settings.height, settings.width]),
                radii: B::from_ints(out.radii, [splats.len()]),
                max_weights: B::from_floats(out.max_weights, [weights]),
                pair_count: B::from_ints(vec![out.work.tile_pairs as i64], [1]),
                work: out.work,
                refused: None,
                saved: Saved::new(Mutex::new(out.workspace)),
            }
        }
        Err(raster::TooManyPairs(pairs)) => Rasterized {
            planes: B::from_floats(Vec::new(), [0, 0, 0]),
            radii: B::from_ints(Vec::new(), [0]),
            max_weights: B::from_floats(Vec::new(), [0]),
            work: RenderWork::default(),
            pair_count: B::from_ints(vec![pairs as i64], [1]),
            refused: Some(Refusal::Pairs { found: pairs, limit: raster::MAX_TILE_PAIRS }),
            saved: Saved::new(()),
        },
    }
}

fn narrow(values: Vec<f64>) -> Vec<f32> {
    values.into_iter().map(|v| v as f32).collect()
}

fn reference_forward<B: CpuBackend>(splats: &SplatArrays, settings: &RasterSettings) -> Rasterized<B> {
    let out = reference::forward(&ReferenceInput::widen(splats), settings);
    let n = splats.len();
    let weights = if settings.max_weights { narrow(out.max_weights) } else { Vec::new() };
    let weights_len = weights.len();
    Rasterized {
        planes: B::from_floats(narrow(out.planes), [5, settings.height, settings.width]),
        radii: B::from_ints(out.radii, [n]),
        max_weights: B::from_floats(weights, [weights_len]),
        work: RenderWork { visible: out.items.len() as u64, tile_pairs: 0, pixel_pairs: out.pairs },
        pair_count: B::from_ints(vec![0], [1]),
        refused: None,
        saved: Saved::new(out.items),
    }
}

fn reference_backward(splats: &SplatArrays, settings: &RasterSettings, items: &[Item], upstream: &[f32]) -> raster::Gradients {
    let upstream: Vec<f64> = upstream.iter().map(|&v| f64::from(v)).collect();
    let g = reference::backward(&ReferenceInput::widen(splats), settings, items, &upstream);
    raster::Gradients {
        means: narrow(g.means),
        scales: narrow(g.scales),
        quaternions: narrow(g.quaternions),
        opacities: narrow(g.opacities),
        colors: narrow(g.colors),
        sh_rest: narrow(g.sh_rest),
        screen: narrow(g.screen),
        camera: narrow(g.camera),
        background: narrow(g.background),
    }
}

impl<B: CpuBackend> RasterBackward for B {
    fn rasterize_backward(
        inputs: SavedInputs<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        wanted: [bool; PARENTS],
    ) -> [Option<FloatTensor<Self>>; PARENTS] {
        let shapes: [_; 7] = std::array::from_fn(|k| inputs[k].shape());
        let [means, scales, quaternions, opacities, colors, sh_rest] = std::array::from_fn(|k| B::floats(&inputs[k]));
        let splats = SplatArrays {
            means: &means,
            scales: &scales,
            quaternions: &quaternions,
            opacities: &opacities,
            colors: &colors,
            sh_rest: &sh_rest,
            background: background_of::<B>(&inputs[6]),
        };
        let [w_means, w_scales, w_quaternions, w_opacities, w_colors, w_rest, w_screen, w_camera, w_background] = wanted;
        let request = GradientRequest {
            means: w_means,
            scales: w_scales,
            quaternions: w_quaternions,
            opacities: w_opacities,
            colors: w_colors,
            sh_rest: w_rest,
            screen: w_screen,
            camera: w_camera,
            background: w_background,
        };
        let upstream = B::floats(&upstream);
        let g = if let Some(items) = saved.get::<Vec<Item>>() {
            reference_backward(&splats, settings, items, &upstream)
        } else if let Some(workspace) = saved.get::<Mutex<Workspace>>() {
            // A panic of an earlier backward pass leaves leftovers at worst, and every buffer is written before it is read.
            let mut workspace = workspace.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            raster::backward(&splats, settings, &mut workspace, &upstream, &request)
        } else {
            // Nothing was drawn (too many pairs), so nothing flows back.
            return std::array::from_fn(|_| None);
        };
        let n = splats.len();
        let [s_means, s_scales, s_quaternions, s_opacities, s_colors, s_rest, s_background] = shapes;
        let values = [g.means, g.scales, g.quaternions, g.opacities, g.colors, g.sh_rest, g.screen, g.camera, g.background];
        let shapes = [s_means, s_scales, s_quaternions, s_opacities, s_colors, s_rest, [n, 2].into(), [4, 4].into(), s_background];
        let mut parts = values.into_iter().zip(shapes).zip(wanted);
        std::array::from_fn(|_| parts.next().and_then(|((values, shape), wanted)| wanted.then(|| B::from_floats(values, shape))))
    }
}

macro_rules! on_cpu {
    ($backend:ty) => {
        impl RasterOps for $backend {
            fn rasterize(
                means: FloatTensor<Self>,
                scales: FloatTensor<Self>,
                quaternions: FloatTensor<Self>,
                opacities: FloatTensor<Self>,
                colors: FloatTensor<Self>,
                sh_rest: FloatTensor<Self>,
                _screen_probe: FloatTensor<Self>,
                _camera_probe: FloatTensor<Self>,
                background: FloatTensor<Self>,
                settings: RasterSettings,
                method: Method,
            ) -> Rasterized<Self> {
                rasterize_on_cpu::<Self>(&[means, scales, quaternions, opacities, colors, sh_rest, background], &settings, method)
            }
        }
    };
}
on_cpu!(Flex);
on_cpu!(NdArray);

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
    // A stand-in for what is absent; never read.
    let absent = || Tensor::<1>::zeros([3], &device);
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
        inputs.background.map_or_else(|| absent().into_dispatch(), Tensor::into_dispatch),
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
