//! Shortcuts of the tile rasterizer are exact: with them switched off, images and gradients of Gaussians are the same bits. (The gradient of the camera's pose
//! is summed over the visible Gaussians in groups, and without the opacity shortcut more of them count as visible, with gradient zero: its last bits differ.)

use crate::raster_fixtures::{narrow, scenes};
use cc4dgs_backends::cpu::raster::{self, SplatArrays};
use cc4dgs_backends::ops::rasterize::{GradientRequest, RasterSettings, Shortcuts};
use cc4dgs_core::{Camera, Entries, Error, Gaussians, HostGaussians, RasterizerPlugin, RenderSettings, Splats};
use cc4dgs_tests::devices;

#[test]
fn images_and_gradients_are_the_same_bits_without_shortcuts() {
    for scene in scenes() {
        let (colors, sh_rest) = scene.coefficients();
        let [means, scales, quaternions, opacities] = ["in.means", "in.scales", "in.quats_wxyz", "in.opacities"].map(|key| scene.inputs.narrow(key));
        let (colors, sh_rest, background) = (narrow(&colors), narrow(&sh_rest), scene.inputs.narrow("in.background"));
        let splats = SplatArrays {
            means: &means,
            scales: &scales,
            quaternions: &quaternions,
            opacities: &opacities,
            colors: &colors,
            sh_rest: &sh_rest,
            background: [background[0], background[1], background[2]],
        };
        let request = GradientRequest { means: true, scales: true, quaternions: true, opacities: true, colors: true, ..Default::default() };
        let upstream = narrow(&scene.upstream());
        let draw = |shortcuts: Shortcuts| {
            let settings = RasterSettings { shortcuts, ..scene.settings.clone() };
            let mut out = raster::forward(&splats, &settings).unwrap();
            let g = raster::backward(&splats, &settings, &mut out.workspace, &upstream, &request);
            let arrays = [out.planes, g.means, g.scales, g.quaternions, g.opacities, g.colors];
            (out.work.pixel_pairs, arrays.map(|values| values.into_iter().map(f32::to_bits).collect::<Vec<_>>()))
        };
        let (pairs, all) = draw(Shortcuts::default());
        for (opacity, transmittance) in [(false, true), (true, false), (false, false)] {
            let (more, other) = draw(Shortcuts { opacity, transmittance });
            assert!(more >= pairs, "{}: fewer pairs without a shortcut", scene.name);
            for (k, (a, b)) in all.iter().zip(&other).enumerate() {
                let different = a.iter().zip(b).filter(|(a, b)| a != b).count();
                assert!(different == 0, "{}, opacity {opacity}, transmittance {transmittance}, array {k}: {different} of {} differ", scene.name, a.len());
            }
        }
    }
}

#[test]
fn gpus_refuse_to_do_without_shortcuts() {
    let rasterizers = Entries::<RasterizerPlugin>::collect().unwrap();
    let one = HostGaussians {
        means: vec![0.0; 3],
        log_scales: vec![-1.0; 3],
        quaternions: vec![1.0, 0.0, 0.0, 0.0],
        opacity_logits: vec![1.0],
        sh_dc: vec![1.0; 3],
        dynamic_scores: vec![0.0],
        ..Default::default()
    };
    let camera = Camera::look_at("front", (16, 16), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
    for (name, device) in devices() {
        let splats = Splats::from_gaussians(&Gaussians::from_host(&one, &device), 0);
        for set in ["", "opacity_shortcut = false", "transmittance_shortcut = false"] {
            let rasterizer = (rasterizers.get("tile").unwrap().build)(&set.parse().unwrap()).unwrap();
            match rasterizer.render(&splats, &camera, &RenderSettings::default()) {
                Ok(_) => assert!(name != "wgpu" || set.is_empty(), "{name} ignores {set}"),
                Err(Error::Unsupported { .. }) => assert!(name == "wgpu" && !set.is_empty(), "{name} refuses {set}"),
                Err(e) => panic!("{name}, {set}: {e}"),
            }
        }
    }
}
