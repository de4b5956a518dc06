//! What a pixel adds to footprints, at the size of the training images and at others.

use crate::raster::{empty_splats, scene};
use cc4dgs_backends::bench::{StepCase, step_camera};
use cc4dgs_backends::rasterizers::reference::ReferenceRasterizer;
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{Camera, Gaussians, Rasterizer, RenderSettings, Seed, Splats};
use cc4dgs_tests::larger;

#[test]
fn impossible_blurs_are_refused() {
    let camera = step_camera(&StepCase { width: 5, height: 3, gaussians: 0 });
    for (name, device) in cc4dgs_tests::devices() {
        let refused = |render: RenderSettings, key: &str| {
            let message = TileRasterizer.render(&empty_splats(&device), &camera, &render).map(|_| ()).unwrap_err().to_string();
            assert!(message.contains(key), "{name}, {render:?}: {message}");
        };
        for wrong in [0.0, -0.1, f64::NAN, f64::INFINITY] {
            refused(RenderSettings { blur: wrong, ..Default::default() }, "render.blur");
            refused(RenderSettings { focal: Some(wrong), ..Default::default() }, "render.focal");
        }
        refused(RenderSettings { blur: 1e-300, ..Default::default() }, "render.blur");
    }
}

/// An image of twice the size blurs four times as many square pixels, and one of half the size as many as the training images.
#[test]
fn larger_images_than_in_training_blur_in_proportion() {
    let small = step_camera(&StepCase { width: 40, height: 30, gaussians: 0 });
    let focal = Some((small.fx * small.fy).sqrt());
    for (name, device) in cc4dgs_tests::devices() {
        let gaussians = Gaussians::from_host(&scene(300, Seed::root(5)), &device);
        let draw = |rasterizer: &dyn Rasterizer, camera: &Camera, blur: f64, focal: Option<f64>| {
            let render = RenderSettings { blur, focal, ..Default::default() };
            let out = rasterizer.render(&Splats::from_gaussians(&gaussians, 1), camera, &render).unwrap();
            out.planes.into_data().try_to_vec::<f32>().unwrap()
        };
        let all = [&TileRasterizer as &dyn Rasterizer, &ReferenceRasterizer::default()];
        // The reference computes in float64 on the host and refuses other devices.
        for rasterizer in all.into_iter().take(if name == "wgpu" { 1 } else { 2 }) {
            for (size, factor) in [((80, 60), 4.0), ((40, 30), 1.0), ((20, 15), 1.0)] {
                let camera = small.resized(size.0, size.1);
                let scaled = draw(rasterizer, &camera, 0.1, focal);
                let stated = draw(rasterizer, &camera, 0.1 * factor, None);
                let apart = scaled.iter().zip(&stated).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
                assert!(apart < 1e-5, "{name}, {size:?}: {apart}");
            }
            assert!(
                draw(rasterizer, &small.resized(80, 60), 0.1, focal) != draw(rasterizer, &small.resized(80, 60), 0.1, None),
                "{name}: focal changes nothing"
            );
        }
    }
}
