//! Rasterization as one operation with a hand-written derivative.

mod autodiff;
pub mod camera;
mod cpu;
mod settings;

use super::limits::{check_binding, over_binding, unread};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, DispatchDevice, ExtensionType, backend_extension};
use burn::tensor::{Device, Int, Tensor};
use cc4dgs_core::{Error, RenderOutput, RenderStats, RenderWork, Result};
use std::any::Any;
use std::fmt;
use std::sync::Arc;

pub use settings::*;

/// Which implementation of a device draws.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// Tiles.
    #[default]
    Tiles,
    /// The reference, on the host.
    Reference(crate::rasterizers::reference::Precision),
}

/// What a device saves between the forward and the backward pass. Only the device that made it can read it.
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

/// Why a device refuses to draw.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// More (Gaussian, tile) pairs than the limit.
    Pairs {
        /// Number of pairs.
        found: u64,
        /// Upper bound on pairs.
        limit: u64,
    },
    /// An array with a row per Gaussian is larger than a kernel of the device may read.
    Gaussians {
        /// Number of Gaussians.
        found: u64,
        /// Upper bound on Gaussians.
        limit: u64,
    },
    /// The device did not give the number of pairs back, for the reason it states: it is lost, or out of memory.
    Unread(String),
}

impl Refusal {
    fn error(self) -> Error {
        match self {
            Self::Pairs { found, limit } => {
                Error::limit("render", found, limit, "The value counts (Gaussian, tile) pairs. Prune huge Gaussians or render a smaller image")
            }
            Self::Gaussians { found, limit } => over_binding("render", "Gaussians", found, limit),
            Self::Unread(error) => unread("render, number of (Gaussian, tile) pairs", error),
        }
    }
}

/// Planes of a render: the largest arrays with a number per pixel.
const PLANES: usize = 5;

/// What the forward pass of a device returns.
#[derive(ExtensionType)]
pub struct Rasterized<B: Backend> {
    /// Red, green, blue, alpha, depth `[5,H,W]`.
    pub planes: FloatTensor<B>,
    /// Screen radii in pixels `[N]`.
    pub radii: IntTensor<B>,
    /// Largest blending weights `[N]`; `[0]` unless asked for.
    pub max_weights: FloatTensor<B>,
    /// Counts of work.
    pub work: RenderWork,
    /// Pairs of Gaussians and tiles `[1]`.
    pub pair_count: IntTensor<B>,
    /// Why nothing was drawn, if so; the planes are empty then.
    pub refused: Option<Refusal>,
    /// For the backward pass.
    pub saved: Saved,
}

/// The Gaussians of one render, and what is behind them. Every field is a differentiable input.
#[derive(Clone, Debug, ExtensionType)]
pub struct SplatTensors<B: Backend> {
    /// Centres in world units `[N,3]`.
    pub means: FloatTensor<B>,
    /// Log-scales or scales `[N,3]`.
    pub scales: FloatTensor<B>,
    /// Raw quaternions (w,x,y,z) `[N,4]`.
    pub quaternions: FloatTensor<B>,
    /// Logits or opacities `[N]`.
    pub opacities: FloatTensor<B>,
    /// Degree-0 coefficients, or colours `[N,3]`.
    pub colors: FloatTensor<B>,
    /// Higher coefficients `[N,K,3]`.
    pub sh_rest: FloatTensor<B>,
    /// Colour behind everything `[3]`.
    pub background: FloatTensor<B>,
}

/// Inputs that are never read: they are there to receive gradients.
#[derive(Clone, Debug, ExtensionType)]
pub struct Probes<B: Backend> {
    /// Receives d loss / d projected centre `[N,2]`.
    pub screen: FloatTensor<B>,
    /// Receives the sums over pixels of the absolute values of what adds up to the gradient of `screen` `[N,2]`.
    pub absolute_screen: FloatTensor<B>,
    /// Receives d loss / d world_to_camera `[4,4]`.
    pub camera: FloatTensor<B>,
}

/// Gradients of [`SplatTensors`] and [`Probes`], shaped like them; those asked for.
#[derive(Clone, Debug, Default)]
pub struct RasterGradients<B: Backend> {
    /// `[N,3]`
    pub means: Option<FloatTensor<B>>,
    /// `[N,3]`
    pub scales: Option<FloatTensor<B>>,
    /// `[N,4]`
    pub quaternions: Option<FloatTensor<B>>,
    /// `[N]`
    pub opacities: Option<FloatTensor<B>>,
    /// `[N,3]`
    pub colors: Option<FloatTensor<B>>,
    /// `[N,K,3]`
    pub sh_rest: Option<FloatTensor<B>>,
    /// `[3]`
    pub background: Option<FloatTensor<B>>,
    /// `[N,2]`
    pub screen: Option<FloatTensor<B>>,
    /// `[N,2]`
    pub absolute_screen: Option<FloatTensor<B>>,
    /// `[4,4]`
    pub camera: Option<FloatTensor<B>>,
}

/// Rasterization per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait RasterOps: Backend {
    /// Renders Gaussians.
    fn rasterize(
        #[extension_type] splats: SplatTensors<Self>,
        #[extension_type] probes: Probes<Self>,
        settings: RasterSettings,
        method: Method,
    ) -> Rasterized<Self>;
}

/// The derivative per device.
pub trait RasterBackward: Backend {
    /// Gradients for `upstream` = d loss / d planes `[5,H,W]`; only those in `request`.
    fn rasterize_backward(
        splats: SplatTensors<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        request: GradientRequest,
    ) -> RasterGradients<Self>;
}

/// The tensors of one render; absent ones are constants without gradient.
pub struct RasterInputs {
    /// Centres in world units `[N,3]`.
    pub means: Tensor<2>,
    /// Log-scales or scales `[N,3]`.
    pub scales: Tensor<2>,
    /// Raw quaternions (w,x,y,z) `[N,4]`.
    pub quaternions: Tensor<2>,
    /// Logits or opacities `[N]`.
    pub opacities: Tensor<1>,
    /// Degree-0 coefficients, or colours `[N,3]`.
    pub colors: Tensor<2>,
    /// Higher coefficients `[N,K,3]`.
    pub sh_rest: Option<Tensor<3>>,
    /// Receives d loss / d projected centre `[N,2]`.
    pub screen_probe: Option<Tensor<2>>,
    /// Receives the sums over pixels of the absolute values of what adds up to the gradient of `screen_probe` `[N,2]`.
    pub absolute_screen_probe: Option<Tensor<2>>,
    /// Receives d loss / d world_to_camera `[4,4]`.
    pub camera_probe: Option<Tensor<2>>,
    /// Colour behind everything `[3]`; black if absent.
    pub background: Option<Tensor<1>>,
}

/// An error for a device without the operation, or without the method or shortcuts that are asked for.
fn check_device(device: &Device, method: Method, shortcuts: Shortcuts) -> Result<()> {
    match (device.clone().without_autodiff().as_dispatch(), method, shortcuts == Shortcuts::default()) {
        (DispatchDevice::Flex(_), ..) => Ok(()),
        #[cfg(feature = "ndarray")]
        (DispatchDevice::NdArray(_), ..) => Ok(()),
        #[cfg(feature = "cube")]
        (DispatchDevice::Cube(_), Method::Tiles, true) => Ok(()),
        #[cfg(feature = "cube")]
        (DispatchDevice::Cube(_), Method::Tiles, false) => Err(Error::unsupported(
            format!("rasterizer tile with opacity_shortcut = {}, transmittance_shortcut = {} on {device:?}", shortcuts.opacity, shortcuts.transmittance),
            "its kernels for GPUs always take both shortcuts",
            "Leave both settings at true, or use --device flex or ndarray",
        )),
        #[cfg(feature = "cube")]
        (DispatchDevice::Cube(_), Method::Reference(_), _) => Err(Error::unsupported(
            format!("rasterizer reference on {device:?}"),
            "it computes in float64 on the processor",
            "Use --device flex, or the rasterizer tile",
        )),
        _ => Err(Error::unsupported(format!("rasterize on {device:?}"), "this device has no rasterizer yet", "Use --device flex or ndarray")),
    }
}

/// Renders; shapes must agree with `settings` (the rasterizer plug-ins check them).
pub fn rasterize(inputs: RasterInputs, settings: RasterSettings, method: Method) -> Result<RenderOutput> {
    let device = inputs.means.device();
    check_device(&device, method, settings.shortcuts)?;
    check_binding(&device, "render", "pixels", settings.width * settings.height, PLANES * size_of::<f32>())?;
    // Absent inputs need a tensor, too: probes are never read, and an absent background is black.
    let absent = || Tensor::<1>::empty([3], &device).into_dispatch();
    let black = || Tensor::<1>::zeros([3], &device).into_dispatch();
    let wants_weights = settings.max_weights;
    let settings = RasterSettings { absolute_centers: inputs.absolute_screen_probe.is_some(), ..settings };
    let splats = SplatTensors::<Dispatch> {
        means: inputs.means.into_dispatch(),
        scales: inputs.scales.into_dispatch(),
        quaternions: inputs.quaternions.into_dispatch(),
        opacities: inputs.opacities.into_dispatch(),
        colors: inputs.colors.into_dispatch(),
        sh_rest: inputs.sh_rest.map_or_else(absent, Tensor::into_dispatch),
        background: inputs.background.map_or_else(black, Tensor::into_dispatch),
    };
    let probes = Probes::<Dispatch> {
        screen: inputs.screen_probe.map_or_else(absent, Tensor::into_dispatch),
        absolute_screen: inputs.absolute_screen_probe.map_or_else(absent, Tensor::into_dispatch),
        camera: inputs.camera_probe.map_or_else(absent, Tensor::into_dispatch),
    };
    let out = <Dispatch as RasterOps>::rasterize(splats, probes, settings, method);
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
