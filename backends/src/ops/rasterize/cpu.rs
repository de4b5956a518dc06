//! Rasterization on the CPU's devices: tiles, or the reference on the host.

use super::{Method, PARENTS, RasterBackward, RasterOps, RasterSettings, Rasterized, Refusal, Saved, SavedInputs};
use crate::cpu::raster::{self, GradientRequest, SplatArrays, Workspace};
use crate::cpu::tensor::CpuBackend;
use crate::rasterizers::reference::blend::Item;
use crate::rasterizers::reference::{self, ReferenceInput};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Flex, NdArray, TensorMetadata};
use cc4dgs_core::RenderWork;
use std::borrow::Cow;
use std::sync::Mutex;

/// The inputs as slices.
fn arrays<B: CpuBackend>(inputs: &SavedInputs<B>) -> [Cow<'_, [f32]>; 7] {
    std::array::from_fn(|k| B::floats(&inputs[k]))
}

fn splats<'a>([means, scales, quaternions, opacities, colors, sh_rest, background]: &'a [Cow<'_, [f32]>; 7]) -> SplatArrays<'a> {
    let background = std::array::from_fn(|k| background.get(k).copied().unwrap_or(0.0));
    SplatArrays { means, scales, quaternions, opacities, colors, sh_rest, background }
}

fn rasterize_on_cpu<B: CpuBackend>(inputs: &SavedInputs<B>, settings: &RasterSettings, method: Method) -> Rasterized<B> {
    let arrays = arrays::<B>(inputs);
    let splats = splats(&arrays);
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
        let arrays = arrays::<B>(&inputs);
        let splats = splats(&arrays);
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
