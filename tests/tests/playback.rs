//! Playback: what it does not ask the field about changes no picture.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, FieldContext, Gaussians, HostGaussians, Registry, RenderSettings, Rules, Seed, Splats, config};
use cc4dgs_deformers as _;
use cc4dgs_engine::config::RenderConfig;
use cc4dgs_engine::model::{Model, ModelField, ModelSize};
use cc4dgs_engine::play::Player;
use cc4dgs_engine::train::Moving;
use cc4dgs_tests::devices;

fn noise(seed: u64, len: usize, size: f32) -> Vec<f32> {
    (0..len as u64).map(|k| size * ((Seed::root(seed).index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0)).collect()
}

/// Gaussians all around the origin, moved by a field whose heads are of order `motion`.
fn model(device: &Device, registry: &Registry, motion: f32) -> Model {
    let n = 3000;
    let gaussians = HostGaussians {
        means: noise(1, 3 * n, 4.0),
        log_scales: noise(2, 3 * n, 0.5).iter().map(|v| v - 3.0).collect(),
        quaternions: noise(3, 4 * n, 1.0),
        opacity_logits: noise(4, n, 3.0),
        sh_dc: noise(5, 3 * n, 1.5),
        // A tenth stands still.
        dynamic_scores: (0..n).map(|i| if i % 10 == 0 { -9.0 } else { 9.0 }).collect(),
        ..Default::default()
    };
    let context = FieldContext { box_min: [-4.0; 3], box_max: [4.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(7) };
    let text = "kind = \"cdf-basis\"\nlevels = 2\nresolutions = [4, 8]\nhashes = 16\nhidden = [16]\nfeatures = 8\nwidth = 16\nlearned = 4\ntime_bands = 3";
    let section = config::parse_table("test", text).unwrap();
    let mut field = registry.build_deformer(&section, &context, device).unwrap();
    for (k, parameter) in field.parameters_mut().into_iter().enumerate().filter(|(_, p)| p.name.starts_with("net.head")) {
        let len = parameter.value.dims()[0];
        parameter.value = Tensor::from_data(TensorData::new(noise(20 + k as u64, len, motion), [len]), device);
    }
    Model {
        gaussians,
        field: Some(ModelField { field, section, context }),
        moving: Moving::Scored { zeta: 0.0 },
        render: RenderConfig::default(),
        background: [0.2, 0.3, 0.4],
        rasterizer: config::parse_table("test", "kind = \"tile\"").unwrap(),
        frame_count: 20,
        provenance: Default::default(),
        size: ModelSize::default(),
        weight_precision: Default::default(),
    }
}

#[test]
fn what_no_moment_brings_into_the_picture_is_not_deformed_and_not_missed() {
    let registry = Registry::collect().unwrap();
    let eyes = [[0.5, 0.0, -3.0], [3.5, 3.0, 2.0], [0.0, 0.2, 0.1], [-9.0, 0.0, 0.0], [30.0, 0.0, 0.0]];
    for (name, device) in devices() {
        let mut model = model(&device, &registry, 0.01);
        let mut spared = Vec::new();
        for rules in [Rules::Gsplat099, Rules::Inria] {
            model.render.rules = rules;
            for (k, eye) in eyes.into_iter().enumerate() {
                let target = if k == 4 { [60.0, 0.0, 0.0] } else { [0.3, 0.1, 0.6] };
                let camera = Camera::look_at("", (96, 64), 0.7, eye, target, [0.0, -1.0, 0.0]);
                let mut player = Player::new(&model, &registry, &device).unwrap();
                let mut all = Player::new(&model, &registry, &device).unwrap();
                for time in [0.0, 0.41, 1.0] {
                    let seen = to_vec(player.render(&camera, time).unwrap().0.planes, "planes").unwrap();
                    let gaussians: Gaussians = all.gaussians_at(time).unwrap();
                    let background = Tensor::<1>::from_data(TensorData::new(model.background.to_vec(), [3]), &device);
                    let settings: RenderSettings = model.render.settings(Some(background));
                    let rasterizer = registry.build_rasterizer(&model.rasterizer).unwrap();
                    let wanted = rasterizer.render(&Splats::from_gaussians(&gaussians, 0), &camera, &settings).unwrap();
                    assert!(seen == to_vec(wanted.planes, "planes").unwrap(), "{name}, {rules:?}, eye {k}, time {time}: pictures differ");
                }
                let work = player.work;
                assert_eq!(work.deformed + work.unseen_skipped + work.static_skipped, 3 * 3000);
                spared.push(work.unseen_skipped);
            }
        }
        let moving = 3 * 2700;
        assert!(spared[0] < moving, "{name}, in front of the scene: {spared:?}");
        assert!(spared[2] > moving / 4, "{name}, amid the scene: {spared:?}");
        assert_eq!(spared[4], moving, "{name}, turned away: {spared:?}");
    }
}
