//! From the gradient of an image to those of the Gaussians.

use super::blend;
use super::gradient::{self, AT_OFFSET, GEOMETRY, OF_CAMERA, OF_MEAN, OF_OPACITY, OF_QUATERNION, OF_SCALES, SCREEN};
use super::{DIM, Lists, rest_width};
use crate::cube::tensor::{constant, floats, row_blocks, rows_of, shared_bytes, spread, workgroups_for, zeros};
use crate::ops::rasterize::camera::{RuleConstants, camera_to_world};
use crate::ops::rasterize::{AT_X, GradientRequest, RasterGradients, RasterSettings, Saved, SplatTensors, TILE, TILE_PIXELS};
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cc4dgs_core::ParameterSpace;
use cubecl::prelude::*;

/// The gradients in `request`.
pub fn backward(
    splats: SplatTensors<CubeBackend>,
    settings: &RasterSettings,
    saved: &Saved,
    upstream: CubeTensor,
    request: GradientRequest,
) -> RasterGradients<CubeBackend> {
    // Nothing was drawn (too many pairs), so no gradient flows back.
    let Some(lists) = saved.get::<Lists>() else { return RasterGradients::default() };
    let rest_shape = splats.sh_rest.meta.shape().clone();
    let SplatTensors { means, scales, quaternions, opacities, sh_rest, .. } = super::contiguous(splats);
    let upstream = into_contiguous(upstream);
    let client = means.client.clone();
    let n = means.meta.shape()[0];
    let (width, height) = (settings.width, settings.height);
    let tiles_x = width.div_ceil(TILE);
    let rules = RuleConstants::new(settings);
    // Set before the forward pass, which has checked that the larger records fit.
    let absolute = request.absolute_screen && settings.absolute_centers;
    let stride = blend::record_floats(absolute);
    let records = floats(&means, [lists.pairs, stride]);
    if lists.pairs > 0 {
        // SAFETY: pixels are compared with the size of the image; everything else is indexed by the lists that the forward pass made.
        unsafe {
            blend::blend_tiles_backward::launch_unchecked(
                &client,
                spread(tiles_x * height.div_ceil(TILE)),
                CubeDim::new_1d(TILE_PIXELS as u32),
                lists.splats.clone().into_buffer_arg(),
                lists.gaussian_of_pair.clone().into_buffer_arg(),
                lists.sorted.clone().into_buffer_arg(),
                lists.tile_starts.clone().into_buffer_arg(),
                lists.state.clone().into_buffer_arg(),
                upstream.clone().into_buffer_arg(),
                records.clone().into_buffer_arg(),
                width as u32,
                height as u32,
                tiles_x as u32,
                rules.alpha_max,
                rules.pass_capped,
                blend::backward_batch(shared_bytes(&client)),
                absolute,
            )
        };
    }
    let (screen, geometry) = (floats(&means, [n, SCREEN]), floats(&means, [n, GEOMETRY]));
    let d_colors = floats(&means, [n, 3]);
    let degree = settings.sh_degree.unwrap_or(0);
    let wants_rest = request.sh_rest && settings.sh_degree.is_some();
    let rest_floats = rest_shape.num_elements();
    let d_rest = match (request.sh_rest, wants_rest) {
        (true, true) => floats(&means, rest_shape),
        // Colours that are blended as they are do not depend on the coefficients.
        (true, false) => {
            let zeros = zeros(&means, rest_floats);
            CubeTensor::new_contiguous(zeros.client.clone(), zeros.device.clone(), rest_shape, zeros.handle.clone(), DType::F32)
        }
        _ => floats(&means, [1]),
    };
    if n > 0 {
        gradient::sum_records::launch(
            &client,
            workgroups_for(n),
            DIM(),
            records.clone().into_buffer_arg(),
            lists.start_of_gaussian.clone().into_buffer_arg(),
            lists.keys.clone().into_buffer_arg(),
            lists.splats.clone().into_buffer_arg(),
            screen.clone().into_buffer_arg(),
            stride,
        );
        let width = rest_width(&sh_rest, n);
        for rows in row_blocks(&client, n, width) {
            gradient::color_backward::launch(
                &client,
                workgroups_for(rows.len()),
                DIM(),
                means.clone().into_buffer_arg(),
                rows_of(&sh_rest, &rows, width).into_buffer_arg(),
                lists.cam.clone().into_buffer_arg(),
                screen.clone().into_buffer_arg(),
                d_colors.clone().into_buffer_arg(),
                if wants_rest { rows_of(&d_rest, &rows, width) } else { d_rest.clone() }.into_buffer_arg(),
                rows.start as u32,
                rows.len() as u32,
                width as u32,
                degree,
                settings.sh_degree.is_some(),
                wants_rest,
            );
        }
        gradient::geometry_backward::launch(
            &client,
            workgroups_for(n),
            DIM(),
            means.clone().into_buffer_arg(),
            scales.into_buffer_arg(),
            quaternions.into_buffer_arg(),
            opacities.into_buffer_arg(),
            lists.cam.clone().into_buffer_arg(),
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
            gradient::take_columns::launch(&client, workgroups_for(count), DIM(), from, to, stride as u32, first as u32, width);
        }
        out
    };
    let camera = || {
        let (of_camera, of_offset, out) = (floats(&means, [12]), floats(&means, [3]), floats(&means, [4, 4]));
        for (from, to, stride, first) in [(&geometry, &of_camera, GEOMETRY, OF_CAMERA), (&screen, &of_offset, SCREEN, AT_OFFSET)] {
            let count = spread(to.meta.shape().num_elements());
            let (from, to) = (from.clone().into_buffer_arg(), to.clone().into_buffer_arg());
            gradient::sum_rows::launch(&client, count, DIM(), from, to, n as u32, stride as u32, first as u32);
        }
        // Nothing is read back here: a backward pass could not return the error of a failed read.
        let inverse = constant(&means, &camera_to_world(&settings.world_to_camera), DType::F32);
        let (sums, offset, inverse) = (of_camera.into_buffer_arg(), of_offset.into_buffer_arg(), inverse.into_buffer_arg());
        gradient::camera_matrix::launch(&client, workgroups_for(16), DIM(), sums, offset, inverse, out.clone().into_buffer_arg());
        out
    };
    let of_background = || {
        let out = floats(&means, [3]);
        let (state, upstream) = (lists.state.clone().into_buffer_arg(), upstream.clone().into_buffer_arg());
        gradient::background_backward::launch(&client, spread(3), DIM(), state, upstream, out.clone().into_buffer_arg(), (width * height) as u32);
        out
    };
    let absolute_screen = || {
        let out = floats(&means, [n, 2]);
        if n > 0 {
            let (records, starts) = (records.clone().into_buffer_arg(), lists.start_of_gaussian.clone().into_buffer_arg());
            let (keys, to) = (lists.keys.clone().into_buffer_arg(), out.clone().into_buffer_arg());
            gradient::sum_absolute::launch(&client, workgroups_for(n), DIM(), records, starts, keys, to, stride);
        }
        out
    };
    RasterGradients {
        means: request.means.then(|| columns(&geometry, GEOMETRY, OF_MEAN, vec![n, 3])),
        scales: request.scales.then(|| columns(&geometry, GEOMETRY, OF_SCALES, vec![n, 3])),
        quaternions: request.quaternions.then(|| columns(&geometry, GEOMETRY, OF_QUATERNION, vec![n, 4])),
        opacities: request.opacities.then(|| columns(&geometry, GEOMETRY, OF_OPACITY, vec![n])),
        colors: request.colors.then_some(d_colors),
        sh_rest: request.sh_rest.then_some(d_rest),
        background: request.background.then(of_background),
        screen: request.screen.then(|| columns(&screen, SCREEN, AT_X, vec![n, 2])),
        absolute_screen: absolute.then(absolute_screen),
        camera: request.camera.then(camera),
    }
}
