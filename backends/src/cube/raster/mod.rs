//! The tile rasterizer on the device.
//!
//! Gaussians are projected, sorted by depth, and appended to the lists of the tiles they meet in that order; sorting the pairs by tile alone then leaves every
//! list in depth order. The number of pairs is the one thing read back per render. Backwards, each pair has a gradient record of its own place, and the
//! pairs of a Gaussian lie side by side, so that all sums have a fixed order.

mod blend;
mod geometry;
mod gradient;
mod harmonics;
mod lists;
mod project;
mod vector;

use super::sort::{exclusive_sums, sort_pairs};
use super::tensor::{UNITS, cubes_for, empty, floats, spread, upload};
use crate::cpu::raster::camera::{CameraConstants, CameraSums, RuleConstants};
use crate::cpu::raster::{MAX_TILE_PAIRS, RECORD, RasterSettings, TILE, TILE_PIXELS};
use crate::ops::rasterize::{Method, PARENTS, RasterBackward, RasterOps, Rasterized, Saved, SavedInputs};
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cc4dgs_core::{ParameterSpace, RenderWork};
use cubecl::prelude::*;
use geometry::camera_buffer;
use gradient::{GEOMETRY, SCREEN};
use project::{KEYS, SPLAT};

/// What the backward pass needs of the forward pass.
struct Lists {
    cam: CubeTensor,
    splats: CubeTensor,
    keys: CubeTensor,
    gaussian_of_pair: CubeTensor,
    start_of_gaussian: CubeTensor,
    sorted: CubeTensor,
    tile_starts: CubeTensor,
    state: CubeTensor,
    pairs: usize,
}

const DIM: fn() -> CubeDim = || CubeDim::new_1d(UNITS);

fn words(like: &CubeTensor, count: usize) -> CubeTensor {
    empty(like, [count], DType::U32)
}

/// The numbers of a buffer of words, read back.
fn read_words(tensor: &CubeTensor) -> Vec<u32> {
    u32::from_bytes(&tensor.client.read_one_unchecked(tensor.handle.clone())).to_vec()
}

fn read_floats(tensor: &CubeTensor) -> Vec<f32> {
    f32::from_bytes(&tensor.client.read_one_unchecked(tensor.handle.clone())).to_vec()
}

fn nothing_drawn(like: &CubeTensor, pairs: u64) -> Rasterized<CubeBackend> {
    Rasterized {
        planes: floats(like, [0, 0, 0]),
        radii: empty(like, [0], DType::I32),
        max_weights: floats(like, [0]),
        work: RenderWork::default(),
        too_many_pairs: Some(pairs),
        saved: Saved::new(()),
    }
}

/// Floats of higher coefficients per Gaussian.
fn rest_width(sh_rest: &CubeTensor, n: usize) -> usize {
    sh_rest.meta.shape().num_elements().checked_div(n).unwrap_or(0)
}

fn forward(inputs: SavedInputs<CubeBackend>, settings: &RasterSettings) -> Rasterized<CubeBackend> {
    let [means, scales, quaternions, opacities, colors, sh_rest, background] = inputs.map(into_contiguous);
    let client = means.client.clone();
    let n = means.meta.shape()[0];
    let (width, height) = (settings.width, settings.height);
    let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
    let tiles = tiles_x * tiles_y;
    let (constants, rules) = (CameraConstants::new(settings), RuleConstants::new(settings));
    let cam = upload(&means, &camera_buffer(&constants, &rules, width, height), DType::F32);
    let (splats, keys) = (floats(&means, [n, SPLAT]), empty(&means, [n, KEYS], DType::U32));
    let radii = empty(&means, [n], DType::I32);
    let raw = settings.space == ParameterSpace::Raw;
    if n > 0 {
        project::project_gaussians::launch(
            &client,
            cubes_for(n),
            DIM(),
            means.clone().into_buffer_arg(),
            scales.into_buffer_arg(),
            quaternions.into_buffer_arg(),
            opacities.into_buffer_arg(),
            cam.clone().into_buffer_arg(),
            splats.clone().into_buffer_arg(),
            keys.clone().into_buffer_arg(),
            radii.clone().into_buffer_arg(),
            raw,
            settings.antialiased,
            rules.square_tiles,
        );
        project::color_gaussians::launch(
            &client,
            cubes_for(n),
            DIM(),
            means.clone().into_buffer_arg(),
            colors.into_buffer_arg(),
            sh_rest.clone().into_buffer_arg(),
            cam.clone().into_buffer_arg(),
            splats.clone().into_buffer_arg(),
            keys.clone().into_buffer_arg(),
            radii.clone().into_buffer_arg(),
            rest_width(&sh_rest, n) as u32,
            settings.sh_degree.unwrap_or(0),
            settings.sh_degree.is_some(),
        );
    }
    // Depth order of all Gaussians; the culled ones come last and meet no tile.
    let (depth, index) = (words(&means, n), words(&means, n));
    let start_of_gaussian = words(&means, n);
    let counts = words(&means, n);
    let mut order = index.clone();
    let mut pairs = 0;
    if n > 0 {
        lists::depth_keys::launch(
            &client,
            cubes_for(n),
            DIM(),
            keys.clone().into_buffer_arg(),
            depth.clone().into_buffer_arg(),
            index.clone().into_buffer_arg(),
        );
        order = sort_pairs(depth, index, n, 32).1;
        lists::counts_by_rank::launch(
            &client,
            cubes_for(n),
            DIM(),
            keys.clone().into_buffer_arg(),
            order.clone().into_buffer_arg(),
            counts.clone().into_buffer_arg(),
        );
        let total = exclusive_sums(&counts, n);
        pairs = read_words(&total).first().copied().unwrap_or(0) as usize;
    }
    let largest = 4 * RECORD as u64 * pairs as u64;
    if pairs as u64 > MAX_TILE_PAIRS || largest > client.properties().memory.max_page_size {
        return nothing_drawn(&means, pairs as u64);
    }
    let (tile_of_pair, pair, gaussian_of_pair) = (words(&means, pairs), words(&means, pairs), words(&means, pairs));
    let tile_starts = words(&means, tiles + 1);
    let mut sorted = pair.clone();
    let mut sorted_tiles = tile_of_pair.clone();
    if pairs > 0 {
        lists::emit_pairs::launch(
            &client,
            cubes_for(n),
            DIM(),
            keys.clone().into_buffer_arg(),
            order.into_buffer_arg(),
            counts.into_buffer_arg(),
            tile_of_pair.clone().into_buffer_arg(),
            pair.clone().into_buffer_arg(),
            gaussian_of_pair.clone().into_buffer_arg(),
            start_of_gaussian.clone().into_buffer_arg(),
            tiles_x as u32,
        );
        (sorted_tiles, sorted) = sort_pairs(tile_of_pair, pair, pairs, usize::BITS - tiles.leading_zeros());
    }
    lists::tile_starts::launch(&client, cubes_for(pairs + 1), DIM(), sorted_tiles.into_buffer_arg(), tile_starts.clone().into_buffer_arg(), pairs as u32);
    let planes = floats(&means, [5, height, width]);
    let state = floats(&means, [2, height, width]);
    let weights = if settings.max_weights && n > 0 { upload(&means, &vec![0.0f32; n], DType::F32) } else { upload(&means, &[0.0f32], DType::F32) };
    blend::blend_tiles::launch(
        &client,
        spread(tiles),
        CubeDim::new_1d(TILE_PIXELS as u32),
        splats.clone().into_buffer_arg(),
        gaussian_of_pair.clone().into_buffer_arg(),
        sorted.clone().into_buffer_arg(),
        tile_starts.clone().into_buffer_arg(),
        background.into_buffer_arg(),
        planes.clone().into_buffer_arg(),
        state.clone().into_buffer_arg(),
        weights.clone().into_buffer_arg(),
        width as u32,
        height as u32,
        tiles_x as u32,
        rules.alpha_max,
        settings.max_weights && n > 0,
    );
    let max_weights = if settings.max_weights && n > 0 { weights } else { floats(&means, [0]) };
    let saved = Lists { cam, splats, keys, gaussian_of_pair, start_of_gaussian, sorted, tile_starts, state, pairs };
    // Visible Gaussians and pixels are not counted here: that would need another read-back.
    let work = RenderWork { visible: 0, tile_pairs: pairs as u64, pixel_pairs: 0 };
    Rasterized { planes, radii, max_weights, work, too_many_pairs: None, saved: Saved::new(saved) }
}

impl RasterOps for CubeBackend {
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
        _method: Method,
    ) -> Rasterized<Self> {
        forward([means, scales, quaternions, opacities, colors, sh_rest, background], &settings)
    }
}

impl RasterBackward for CubeBackend {
    fn rasterize_backward(
        inputs: SavedInputs<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        wanted: [bool; PARENTS],
    ) -> [Option<FloatTensor<Self>>; PARENTS] {
        // Nothing was drawn (too many pairs), so nothing flows back.
        let Some(lists) = saved.get::<Lists>() else { return std::array::from_fn(|_| None) };
        let rest_shape = inputs[5].meta.shape().clone();
        let [means, scales, quaternions, opacities, _, sh_rest, background] = inputs.map(into_contiguous);
        let upstream = into_contiguous(upstream);
        let client = means.client.clone();
        let n = means.meta.shape()[0];
        let (width, height) = (settings.width, settings.height);
        let tiles_x = width.div_ceil(TILE);
        let rules = RuleConstants::new(settings);
        let records = floats(&means, [lists.pairs, RECORD]);
        if lists.pairs > 0 {
            blend::blend_tiles_backward::launch(
                &client,
                spread(tiles_x * height.div_ceil(TILE)),
                CubeDim::new_1d(TILE_PIXELS as u32),
                lists.splats.clone().into_buffer_arg(),
                lists.gaussian_of_pair.clone().into_buffer_arg(),
                lists.sorted.clone().into_buffer_arg(),
                lists.tile_starts.clone().into_buffer_arg(),
                background.clone().into_buffer_arg(),
                lists.state.clone().into_buffer_arg(),
                upstream.clone().into_buffer_arg(),
                records.clone().into_buffer_arg(),
                width as u32,
                height as u32,
                tiles_x as u32,
                rules.alpha_max,
                rules.pass_capped,
            );
        }
        let (screen, geometry) = (floats(&means, [n, SCREEN]), floats(&means, [n, GEOMETRY]));
        let d_colors = floats(&means, [n, 3]);
        let degree = settings.sh_degree.unwrap_or(0);
        let wants_rest = wanted[5] && settings.sh_degree.is_some();
        let rest_floats = rest_shape.num_elements();
        let d_rest = match (wanted[5], wants_rest) {
            (true, true) => floats(&means, rest_shape),
            // Colours that are blended as they are do not depend on the coefficients.
            (true, false) => {
                let zeros = upload(&means, &vec![0.0f32; rest_floats.max(1)], DType::F32);
                CubeTensor::new_contiguous(zeros.client.clone(), zeros.device.clone(), rest_shape, zeros.handle.clone(), DType::F32)
            }
            _ => floats(&means, [1]),
        };
        if n > 0 {
            gradient::sum_records::launch(
                &client,
                cubes_for(n),
                DIM(),
                records.into_buffer_arg(),
                lists.start_of_gaussian.clone().into_buffer_arg(),
                lists.keys.clone().into_buffer_arg(),
                lists.splats.clone().into_buffer_arg(),
                screen.clone().into_buffer_arg(),
            );
            gradient::color_backward::launch(
                &client,
                cubes_for(n),
                DIM(),
                means.clone().into_buffer_arg(),
                sh_rest.clone().into_buffer_arg(),
                lists.cam.clone().into_buffer_arg(),
                lists.splats.clone().into_buffer_arg(),
                screen.clone().into_buffer_arg(),
                d_colors.clone().into_buffer_arg(),
                d_rest.clone().into_buffer_arg(),
                n as u32,
                rest_width(&sh_rest, n) as u32,
                degree,
                settings.sh_degree.is_some(),
                wants_rest,
            );
            gradient::geometry_backward::launch(
                &client,
                cubes_for(n),
                DIM(),
                means.clone().into_buffer_arg(),
                scales.into_buffer_arg(),
                quaternions.into_buffer_arg(),
                opacities.into_buffer_arg(),
                lists.cam.clone().into_buffer_arg(),
                lists.keys.clone().into_buffer_arg(),
                screen.clone().into_buffer_arg(),
                geometry.clone().into_buffer_arg(),
                n as u32,
                settings.space == ParameterSpace::Raw,
                settings.antialiased,
            );
        }
        let columns = |from: &CubeTensor, stride: usize, first: usize, shape: Vec<usize>| {
            let count: usize = shape.iter().product();
            let out = floats(&means, shape.clone());
            if count > 0 {
                let width = (count / n) as u32;
                let (from, to) = (from.clone().into_buffer_arg(), out.clone().into_buffer_arg());
                gradient::take_columns::launch(&client, cubes_for(count), DIM(), from, to, stride as u32, first as u32, width);
            }
            out
        };
        let camera = || {
            let mut sums = CameraSums::default();
            if n > 0 {
                let (of_camera, of_offset) = (floats(&means, [12]), floats(&means, [3]));
                for (from, to, stride, first) in [(&geometry, &of_camera, GEOMETRY, 11), (&screen, &of_offset, SCREEN, RECORD)] {
                    let (from, to) = (from.clone().into_buffer_arg(), to.clone().into_buffer_arg());
                    gradient::sum_rows::launch(&client, CubeCount::Static(1, 1, 1), CubeDim::new_1d(32), from, to, n as u32, stride as u32, first as u32);
                }
                let (matrix, offset) = (read_floats(&of_camera), read_floats(&of_offset));
                sums.rotation = std::array::from_fn(|k| f64::from(matrix[k]));
                sums.translation = std::array::from_fn(|k| f64::from(matrix[9 + k]));
                sums.center = std::array::from_fn(|k| -f64::from(offset[k]));
            }
            let gradient = upload(&means, &sums.matrix_gradient(&settings.world_to_camera), DType::F32);
            CubeTensor::new_contiguous(gradient.client.clone(), gradient.device.clone(), [4, 4].into(), gradient.handle.clone(), DType::F32)
        };
        let of_background = || {
            let out = floats(&means, [3]);
            let (state, upstream) = (lists.state.clone().into_buffer_arg(), upstream.clone().into_buffer_arg());
            let one = CubeCount::Static(1, 1, 1);
            gradient::background_backward::launch(&client, one, CubeDim::new_1d(32), state, upstream, out.clone().into_buffer_arg(), (width * height) as u32);
            out
        };
        [
            wanted[0].then(|| columns(&geometry, GEOMETRY, 0, vec![n, 3])),
            wanted[1].then(|| columns(&geometry, GEOMETRY, 3, vec![n, 3])),
            wanted[2].then(|| columns(&geometry, GEOMETRY, 6, vec![n, 4])),
            wanted[3].then(|| columns(&geometry, GEOMETRY, 10, vec![n])),
            wanted[4].then_some(d_colors),
            wanted[5].then_some(d_rest),
            wanted[6].then(|| columns(&screen, SCREEN, 0, vec![n, 2])),
            wanted[7].then(camera),
            wanted[8].then(of_background),
        ]
    }
}
