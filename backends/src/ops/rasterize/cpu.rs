//! Rasterization on the CPU's devices: tiles, or the reference on the host.

use super::{GradientRequest, Method, Probes, RasterBackward, RasterGradients, RasterOps, RasterSettings, Rasterized, Refusal, Saved, SplatTensors};
use crate::cpu::raster::{self, SplatArrays, Workspace};
use crate::cpu::tensor::CpuBackend;
use crate::rasterizers::reference::blend::Item;
use crate::rasterizers::reference::{self, Precision, ReferenceInput};
use burn::backend::TensorMetadata;
use burn::backend::tensor::FloatTensor;
use burn::tensor::Shape;
use cc4dgs_core::RenderWork;
use std::borrow::Cow;
use std::sync::Mutex;

/// The inputs as slices.
struct Borrowed<'a> {
    means: Cow<'a, [f32]>,
    scales: Cow<'a, [f32]>,
    quaternions: Cow<'a, [f32]>,
    opacities: Cow<'a, [f32]>,
    colors: Cow<'a, [f32]>,
    sh_rest: Cow<'a, [f32]>,
    background: Cow<'a, [f32]>,
}

impl<'a> Borrowed<'a> {
    fn new<B: CpuBackend>(splats: &'a SplatTensors<B>) -> Self {
        Self {
            means: B::floats(&splats.means),
            scales: B::floats(&splats.scales),
            quaternions: B::floats(&splats.quaternions),
            opacities: B::floats(&splats.opacities),
            colors: B::floats(&splats.colors),
            sh_rest: B::floats(&splats.sh_rest),
            background: B::floats(&splats.background),
        }
    }
    fn arrays(&self) -> SplatArrays<'_> {
        SplatArrays {
            means: &self.means,
            scales: &self.scales,
            quaternions: &self.quaternions,
            opacities: &self.opacities,
            colors: &self.colors,
            sh_rest: &self.sh_rest,
            background: std::array::from_fn(|k| self.background.get(k).copied().unwrap_or(0.0)),
        }
    }
}

impl<B: CpuBackend> RasterOps for B {
    fn rasterize(splats: SplatTensors<Self>, _: Probes<Self>, settings: RasterSettings, method: Method) -> Rasterized<Self> {
        let borrowed = Borrowed::new(&splats);
        let splats = borrowed.arrays();
        if let Method::Reference(precision) = method {
            return reference_forward::<B>(&splats, &settings, precision);
        }
        match raster::forward(&splats, &settings) {
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
                refused: Some(Refusal::Pairs { found: pairs, limit: super::MAX_TILE_PAIRS }),
                saved: Saved::new(()),
            },
        }
    }
}

fn narrow(values: Vec<f64>) -> Vec<f32> {
    values.into_iter().map(|v| v as f32).collect()
}

/// What the backward pass of the reference needs from its forward pass.
struct Drawn {
    precision: Precision,
    items: Vec<Item>,
}

fn reference_forward<B: CpuBackend>(splats: &SplatArrays, settings: &RasterSettings, precision: Precision) -> Rasterized<B> {
    let out = reference::forward_in(precision, &ReferenceInput::widen(splats), settings);
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
        saved: Saved::new(Drawn { precision, items: out.items }),
    }
}

fn reference_backward(splats: &SplatArrays, settings: &RasterSettings, drawn: &Drawn, upstream: &[f32]) -> raster::Gradients {
    let upstream: Vec<f64> = upstream.iter().map(|&v| f64::from(v)).collect();
    let g = reference::backward_in(drawn.precision, &ReferenceInput::widen(splats), settings, &drawn.items, &upstream);
    raster::Gradients {
        means: narrow(g.means),
        scales: narrow(g.scales),
        quaternions: narrow(g.quaternions),
        opacities: narrow(g.opacities),
        colors: narrow(g.colors),
        sh_rest: narrow(g.sh_rest),
        screen: narrow(g.screen),
        absolute_screen: narrow(g.absolute_screen),
        camera: narrow(g.camera),
        background: narrow(g.background),
    }
}

impl<B: CpuBackend> RasterBackward for B {
    fn rasterize_backward(
        splats: SplatTensors<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        request: GradientRequest,
    ) -> RasterGradients<Self> {
        let borrowed = Borrowed::new(&splats);
        let arrays = borrowed.arrays();
        let upstream = B::floats(&upstream);
        let g = if let Some(drawn) = saved.get::<Drawn>() {
            reference_backward(&arrays, settings, drawn, &upstream)
        } else if let Some(workspace) = saved.get::<Mutex<Workspace>>() {
            // A panic in an earlier backward pass leaves old values behind at worst, and every buffer is written before it is read.
            let mut workspace = workspace.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            raster::backward(&arrays, settings, &mut workspace, &upstream, &request)
        } else {
            // Nothing was drawn (too many pairs), so no gradient flows back.
            return RasterGradients::default();
        };
        let n = arrays.len();
        let tensor = |wanted: bool, values: Vec<f32>, shape: Shape| wanted.then(|| B::from_floats(values, shape));
        RasterGradients {
            means: tensor(request.means, g.means, splats.means.shape()),
            scales: tensor(request.scales, g.scales, splats.scales.shape()),
            quaternions: tensor(request.quaternions, g.quaternions, splats.quaternions.shape()),
            opacities: tensor(request.opacities, g.opacities, splats.opacities.shape()),
            colors: tensor(request.colors, g.colors, splats.colors.shape()),
            sh_rest: tensor(request.sh_rest, g.sh_rest, splats.sh_rest.shape()),
            background: tensor(request.background, g.background, splats.background.shape()),
            screen: tensor(request.screen, g.screen, [n, 2].into()),
            absolute_screen: tensor(request.absolute_screen, g.absolute_screen, [n, 2].into()),
            camera: tensor(request.camera, g.camera, [4, 4].into()),
        }
    }
}
