//! Projection, tile lists, blending.

use super::blend;
use super::geometry::camera_buffer;
use super::gradient::{GEOMETRY, SCREEN};
use super::lists::{self, BACKGROUND};
use super::project::{self, KEYS};
use super::{DIM, Lists, read_word, rest_width, words};
use crate::cube::sort::{exclusive_sums, sort_pairs};
use crate::cube::tensor::{binding_bytes, buffer_bytes, constant, empty, floats, row_blocks, rows_of, spread, upload, workgroups_for, zeros};
use crate::ops::rasterize::camera::{CameraConstants, RuleConstants};
use crate::ops::rasterize::{MAX_TILE_PAIRS, RECORD, RasterSettings, Rasterized, Refusal, Saved, SplatTensors, TILE, TILE_PIXELS};
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cc4dgs_core::{ParameterSpace, RenderWork};
use cubecl::prelude::*;

fn refuse(like: &CubeTensor, refusal: Refusal) -> Rasterized<CubeBackend> {
    Rasterized {
        planes: floats(like, [0, 0, 0]),
        radii: empty(like, [0], DType::I32),
        max_weights: floats(like, [0]),
        work: RenderWork::default(),
        pair_count: upload(like, &[0i32], DType::I32),
        refused: Some(refusal),
        saved: Saved::new(()),
    }
}

/// Upper bound on the Gaussians: the widest array that is bound as a whole has at most `binding` bytes, and the coefficients above degree 0, `rest_width`
/// floats per Gaussian, which are bound in blocks of rows, at most the `buffer` bytes of one allocation.
fn most_gaussians(binding: u64, buffer: u64, rest_width: usize) -> u64 {
    let widest = KEYS.max(RECORD).max(SCREEN).max(GEOMETRY) as u64;
    (binding / (4 * widest)).min(buffer / (4 * rest_width.max(1) as u64))
}

/// Draws the Gaussians.
pub fn forward(splats: SplatTensors<CubeBackend>, settings: &RasterSettings) -> Rasterized<CubeBackend> {
    let SplatTensors { means, scales, quaternions, opacities, colors, sh_rest, background } = super::contiguous(splats);
    let client = means.client.clone();
    let n = means.meta.shape()[0];
    let (width, height) = (settings.width, settings.height);
    let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
    let tiles = tiles_x * tiles_y;
    let (constants, rules) = (CameraConstants::new(settings), RuleConstants::new(settings));
    let cam = constant(&means, &camera_buffer(&constants, &rules, width, height), DType::F32);
    let (splats, keys) = (floats(&means, [n, RECORD]), empty(&means, [n, KEYS], DType::U32));
    let radii = empty(&means, [n], DType::I32);
    let raw = settings.space == ParameterSpace::Raw;
    let most = most_gaussians(binding_bytes(&client), buffer_bytes(&client), rest_width(&sh_rest, n));
    if n as u64 > most {
        return refuse(&means, Refusal::Gaussians { found: n as u64, limit: most });
    }
    if n > 0 {
        project::project_gaussians::launch(
            &client,
            workgroups_for(n),
            DIM(),
            means.clone().into_buffer_arg(),
            scales.into_buffer_arg(),
            quaternions.into_buffer_arg(),
            opacities.into_buffer_arg(),
            cam.clone().into_buffer_arg(),
            splats.clone().into_buffer_arg(),
            keys.clone().into_buffer_arg(),
            n as u32,
            raw,
            settings.antialiased,
            rules.square_tiles,
        );
        let width = rest_width(&sh_rest, n);
        for rows in row_blocks(&client, n, width) {
            project::color_gaussians::launch(
                &client,
                workgroups_for(rows.len()),
                DIM(),
                means.clone().into_buffer_arg(),
                colors.clone().into_buffer_arg(),
                rows_of(&sh_rest, &rows, width).into_buffer_arg(),
                cam.clone().into_buffer_arg(),
                splats.clone().into_buffer_arg(),
                keys.clone().into_buffer_arg(),
                radii.clone().into_buffer_arg(),
                rows.start as u32,
                rows.len() as u32,
                width as u32,
                settings.sh_degree.unwrap_or(0),
                settings.sh_degree.is_some(),
            );
        }
    }
    // Depth order of all Gaussians; the culled ones come last and meet no tile.
    let (depth, index) = (words(&means, n), words(&means, n));
    let start_of_gaussian = words(&means, n);
    let counts = words(&means, n);
    let mut order = index.clone();
    let mut total = constant(&means, &[0u32], DType::U32);
    if n > 0 {
        lists::depth_keys::launch(
            &client,
            workgroups_for(n),
            DIM(),
            keys.clone().into_buffer_arg(),
            depth.clone().into_buffer_arg(),
            index.clone().into_buffer_arg(),
        );
        order = sort_pairs(depth, index, n, 32).1;
        lists::counts_by_rank::launch(
            &client,
            workgroups_for(n),
            DIM(),
            keys.clone().into_buffer_arg(),
            order.clone().into_buffer_arg(),
            counts.clone().into_buffer_arg(),
        );
        total = exclusive_sums(&counts, n);
    }
    let limit = MAX_TILE_PAIRS.min(binding_bytes(&client) / (4 * blend::record_floats(settings.absolute_centers) as u64));
    let capacity = settings.pair_capacity.filter(|&capacity| n > 0 && capacity as u64 <= limit);
    let pairs = match capacity {
        Some(capacity) => capacity,
        None if n == 0 => 0,
        None => match read_word(&total) {
            Ok(pairs) => pairs as usize,
            Err(error) => return refuse(&means, Refusal::Unread(error.to_string())),
        },
    };
    if pairs as u64 > limit {
        return refuse(&means, Refusal::Pairs { found: pairs as u64, limit });
    }
    let (tile_of_pair, pair, gaussian_of_pair) = (words(&means, pairs), words(&means, pairs), words(&means, pairs));
    let tile_starts = words(&means, tiles + 1 + BACKGROUND);
    let mut sorted = pair.clone();
    let mut sorted_tiles = tile_of_pair.clone();
    if pairs > 0 {
        lists::emit_pairs::launch(
            &client,
            workgroups_for(n),
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
        if capacity.is_some() {
            // Unused pairs get a tile behind the last one.
            let (tile, own) = (tile_of_pair.clone().into_buffer_arg(), pair.clone().into_buffer_arg());
            lists::fill_unused::launch(&client, workgroups_for(pairs), DIM(), tile, own, total.clone().into_buffer_arg(), tiles as u32);
        }
        (sorted_tiles, sorted) = sort_pairs(tile_of_pair, pair, pairs, usize::BITS - tiles.leading_zeros());
    }
    let (tiles_of_pairs, behind, starts) = (sorted_tiles.into_buffer_arg(), background.into_buffer_arg(), tile_starts.clone().into_buffer_arg());
    lists::tile_starts::launch(&client, workgroups_for(pairs + 1), DIM(), tiles_of_pairs, behind, starts, pairs as u32);
    let planes = floats(&means, [5, height, width]);
    let state = empty(&means, [2, height, width], DType::U32);
    let weights = if settings.max_weights { zeros(&means, n) } else { floats(&means, [1]) };
    // SAFETY: tiles and pixels are compared with the sizes of their buffers; pairs and Gaussians come from lists made above, which name none beyond the last.
    unsafe {
        blend::blend_tiles::launch_unchecked(
            &client,
            spread(tiles),
            CubeDim::new_1d(TILE_PIXELS as u32),
            splats.clone().into_buffer_arg(),
            gaussian_of_pair.clone().into_buffer_arg(),
            sorted.clone().into_buffer_arg(),
            tile_starts.clone().into_buffer_arg(),
            planes.clone().into_buffer_arg(),
            state.clone().into_buffer_arg(),
            weights.clone().into_buffer_arg(),
            width as u32,
            height as u32,
            tiles_x as u32,
            rules.alpha_max,
            settings.max_weights && n > 0,
        )
    };
    let max_weights = if settings.max_weights && n > 0 { weights } else { floats(&means, [0]) };
    let saved = Lists { cam, splats, keys, gaussian_of_pair, start_of_gaussian, sorted, tile_starts, state, pairs };
    // Visible Gaussians and pixels are not counted here: that would need another read-back.
    let work = RenderWork { visible: 0, tile_pairs: if capacity.is_none() { pairs as u64 } else { 0 }, pixel_pairs: 0 };
    // Counts stay below 2^31, so their bits are those of signed numbers too.
    let pair_count = CubeTensor::new_contiguous(total.client.clone(), total.device.clone(), [1].into(), total.handle.clone(), DType::I32);
    Rasterized { planes, radii, max_weights, work, pair_count, refused: None, saved: Saved::new(saved) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn harmonics_that_no_buffer_holds_bound_the_number_of_gaussians() {
        let smallest = 128 << 20;
        // Degree 3 has 15 coefficients above degree 0, in three channels.
        assert_eq!(most_gaussians(smallest, smallest, 45), smallest / 180);
        assert_eq!(most_gaussians(smallest, smallest, 0), smallest / (4 * GEOMETRY as u64));
        // A binding that is smaller than a buffer is no bound for what is bound in blocks of rows.
        assert_eq!(most_gaussians(smallest, 1 << 40, 45), smallest / (4 * GEOMETRY as u64));
    }
}
