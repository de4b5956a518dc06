//! Loss terms and regularizers over millions of numbers have the same bits whatever the number of threads.

use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, DeformerContext, Gaussians, HostGaussians, LIFE_ATTRIBUTES, LossInput, Registry, Schedule, Seed, SpatialInput, Split, View};
use cc4dgs_deformers as _;
use cc4dgs_parts as _;

/// burn adds in parallel from 4 Mi numbers on.
const MANY: usize = (4 << 20) + 100;

fn numbers(count: usize) -> Vec<f32> {
    (0..count as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 8) as f32 * 1e-7).collect()
}

fn tensor<const D: usize>(shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(numbers(shape.iter().product()), shape), &Device::flex())
}

fn check(what: &str, value: impl Fn() -> Tensor<1> + Sync) {
    let found = [1, 2, 3, 5].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| to_vec(value(), what).unwrap()[0])
    });
    assert!(found[0] > 0.0 && found.iter().all(|value| value.to_bits() == found[0].to_bits()), "{what}: {found:?}");
}

fn context() -> DeformerContext {
    DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) }
}

#[test]
fn loss_terms_of_many_gaussians_do_not_depend_on_threads() {
    let registry = Registry::collect().unwrap();
    for name in ["scale", "opacity"] {
        let build = registry.loss(name).unwrap().build;
        check(name, || {
            let device = Device::flex();
            let host = HostGaussians {
                means: vec![0.0; 3],
                log_scales: vec![0.0; 3],
                quaternions: vec![1.0, 0.0, 0.0, 0.0],
                opacity_logits: vec![0.0],
                sh_dc: vec![0.0; 3],
                dynamic_scores: vec![0.0],
                ..Default::default()
            };
            // Only what the terms read has many rows.
            let mut gaussians = Gaussians::from_host(&host, &device);
            (gaussians.log_scales, gaussians.opacity_logits) = (tensor([MANY.div_ceil(3), 3]), tensor([MANY]));
            let (planes, target) = (Tensor::zeros([5, 1, 1], &device), Tensor::zeros([3, 1, 1], &device));
            let (radii, schedule) = (Tensor::<1, Int>::zeros([1], &device), Schedule::main(10));
            let camera = Camera::look_at("a camera", (1, 1), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let view = View { camera: 0, frame: 0, time_norm: 0.5, split: Split::Train };
            let input = LossInput::new(&camera, &view, &planes, &target, &gaussians, &radii, &schedule);
            build(&toml::Table::new()).unwrap().value(&input).unwrap().unwrap()
        });
    }
}

#[test]
fn regularizers_of_many_gaussians_do_not_depend_on_threads() {
    let registry = Registry::collect().unwrap();
    let build = registry.deformer("free-time").unwrap().build;
    check("gates", || {
        let field = build(&"gate_weight = 0.5".parse().unwrap(), &context(), &Device::flex()).unwrap();
        // Only gates are read.
        let column = |width: usize| Tensor::<2>::zeros([1, width], &Device::flex()).expand([MANY, width]);
        let attributes = LIFE_ATTRIBUTES.iter().map(|&(name, width)| if name == "life_gate" { tensor([MANY, 1]) } else { column(width) }).collect();
        let input = SpatialInput { means_world: column(3), attributes };
        field.regularizer(&input, 0.5, 0.5).unwrap().unwrap()
    });
    let build = registry.deformer("grid4d").unwrap().build;
    check("grid4d", || {
        let small = "log2_rows = 8\nspace_levels = 4\nspace_final = 32\ntime_levels = 1\nfeatures = 16\nwidth = 4";
        let field = build(&small.parse().unwrap(), &context(), &Device::flex()).unwrap();
        field.regularizer(&SpatialInput::new(tensor([MANY.div_ceil(64), 3])), 0.5, 0.5).unwrap().unwrap()
    });
}

#[test]
fn regularizers_of_large_planes_do_not_depend_on_threads() {
    let registry = Registry::collect().unwrap();
    let build = registry.deformer("hexplane").unwrap().build;
    check("hexplane", || {
        // A plane of space has 510 x 512 x 17 second differences, which are more than `MANY`.
        let large = "resolution = 512\nmultires = [1]\ntime_resolution = 2\nfeatures = 17\nwidth = 4";
        let field = build(&large.parse().unwrap(), &context(), &Device::flex()).unwrap();
        field.regularizer(&SpatialInput::new(tensor([1, 3])), 0.5, 0.5).unwrap().unwrap()
    });
}
