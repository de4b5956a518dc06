//! Reads the golden fixtures of the rasterizer.

use cc4dgs_backends::ops::rasterize::RasterSettings;
use cc4dgs_core::{BLUR, ParameterSpace, Rules};
use cc4dgs_tests::golden::folder;
pub use cc4dgs_tests::golden::{Fixture, largest_difference, narrow, relative_l2, widen};

/// A 4x4 from 16 row-major values.
pub fn matrix(values: &[f64]) -> [[f64; 4]; 4] {
    std::array::from_fn(|i| std::array::from_fn(|j| values[4 * i + j]))
}

/// Settings of a camera with intrinsics `k` (3x3) and activated parameters.
pub fn settings(width: usize, height: usize, k: &[f64], view: &[f64]) -> RasterSettings {
    RasterSettings {
        width,
        height,
        fx: k[0],
        fy: k[4],
        cx: k[2],
        cy: k[5],
        world_to_camera: matrix(view),
        rules: Rules::Gsplat099,
        near: None,
        antialiased: false,
        blur: BLUR,
        space: ParameterSpace::Activated,
        sh_degree: None,
        max_weights: false,
        absolute_centers: false,
        pair_capacity: None,
        shortcuts: Default::default(),
    }
}

/// One golden scene under one rule set.
pub struct Scene {
    /// `raster_<scene>.<variant>`.
    pub name: String,
    /// Inputs.
    pub inputs: Fixture,
    /// Results.
    pub results: Fixture,
    /// Sizes, camera, rules.
    pub settings: RasterSettings,
    /// Whether float32 is inaccurate here (very thin Gaussians).
    pub ill_conditioned: bool,
}

/// Every scene and variant in the folder.
pub fn scenes() -> Vec<Scene> {
    let mut names: Vec<String> = std::fs::read_dir(folder())
        .unwrap_or_else(|e| panic!("{}: {e}", folder().display()))
        .filter_map(|entry| entry.unwrap().file_name().to_str()?.strip_suffix(".f64.safetensors").map(str::to_string))
        .filter(|name| name.starts_with("raster_") && !name.ends_with(".inputs"))
        .collect();
    names.sort();
    names.iter().map(|name| Scene::open(name)).collect()
}

impl Scene {
    /// Opens `raster_<scene>.<variant>`.
    pub fn open(name: &str) -> Self {
        let (scene, variant) = name.split_once('.').unwrap();
        let inputs = Fixture::open(&format!("{scene}.inputs"));
        let mut settings = settings(inputs.count("W"), inputs.count("H"), &inputs.get("in.K"), &inputs.get("in.viewmat"));
        settings.sh_degree = Some(inputs.count("sh_degree"));
        settings.antialiased = inputs.facts["antialiased"].as_bool().unwrap();
        settings.rules = match variant {
            "gsplat099" => Rules::Gsplat099,
            "gsplat0999" => Rules::Gsplat0999,
            "inria" => Rules::Inria,
            other => panic!("unknown variant {other}"),
        };
        Self { name: name.to_string(), results: Fixture::open(name), inputs, settings, ill_conditioned: scene.contains("needles") }
    }
    /// Degree-0 coefficients `[N,3]` and the others `[N,K,3]`.
    pub fn coefficients(&self) -> (Vec<f64>, Vec<f64>) {
        split_coefficients(&self.inputs.get("in.sh"), self.inputs.shape("in.sh")[1])
    }
    /// Weights of the loss as planes `[5,H,W]`.
    pub fn upstream(&self) -> Vec<f64> {
        let mut planes = to_planes(&self.inputs.get("in.weights_image"));
        planes.extend(self.inputs.get("in.weights_alpha"));
        planes.extend(vec![0.0; self.settings.width * self.settings.height]);
        planes
    }
    /// Reference planes `[5,H,W]`.
    pub fn planes(&self) -> Vec<f64> {
        let mut planes = to_planes(&self.results.get("out.image"));
        planes.extend(self.results.get("out.alpha"));
        planes.extend(self.results.get("out.depth_acc"));
        planes
    }
    /// Largest difference at robust pixels: of the colour and alpha planes, and of depth over its largest value; then at all pixels.
    pub fn image_errors(&self, planes: &[f64]) -> (f64, f64, f64) {
        let golden = self.planes();
        let robust = self.inputs.get("robust_pixel");
        let pixels = robust.len();
        let mut errors = (0.0f64, 0.0f64, 0.0f64);
        let deepest = golden[4 * pixels..].iter().fold(1.0f64, |a, &b| a.max(b));
        for (i, (a, b)) in planes.iter().zip(&golden).enumerate() {
            let difference = if a.is_nan() { f64::INFINITY } else { (a - b).abs() };
            match (robust[i % pixels] > 0.0, i < 4 * pixels) {
                (true, true) => errors.0 = errors.0.max(difference),
                (true, false) => errors.1 = errors.1.max(difference / deepest),
                (false, true) => errors.2 = errors.2.max(difference),
                (false, false) => {}
            }
        }
        errors
    }
}

/// Degree-0 coefficients and the rest of `[N,count,3]`.
pub fn split_coefficients(all: &[f64], count: usize) -> (Vec<f64>, Vec<f64>) {
    let rows = all.chunks_exact(3 * count);
    (rows.clone().flat_map(|row| row[..3].to_vec()).collect(), rows.flat_map(|row| row[3..].to_vec()).collect())
}

/// `[H,W,3]` to `[3,H,W]`.
pub fn to_planes(image: &[f64]) -> Vec<f64> {
    (0..3).flat_map(|c| image.iter().skip(c).step_by(3).copied()).collect()
}
