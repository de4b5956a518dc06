//! Deformers (deformation fields). Each registers itself; link this crate and name one in the configuration.

pub mod basis;
pub mod cdf;
pub mod deform_mlp;
pub mod embedding;
pub mod free_time;
pub mod grid4d;
pub mod hexplane;
pub mod life;
pub mod native4d;
pub mod none;
pub mod parts;
pub mod swift4d;

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Tensor};
    use cc4dgs_core::gaussians::to_vec;
    use cc4dgs_core::{DeformerContext, Registry, Seed, SpatialInput, toml};

    #[test]
    fn sizes_that_no_machine_has_are_refused_before_they_are_allocated() {
        let registry = Registry::collect().unwrap();
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 10, sh_degree: 1, seed: Seed::root(1) };
        let voxels = "resolutions = [8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8]\nhidden = [4096, 4096, 4096, 4096, 4096, 4096, 4096, 4096]\nfeatures = 4096\nhashes = 4096";
        let wide = "resolutions = [8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8]\nhidden = []\nfeatures = 4096\nhashes = 1\nwidth = 4096\ntime_layers = 1\nheads = ['opacity']";
        for (kind, settings) in [
            ("cdf", voxels),
            ("cdf-basis", voxels),
            ("hash-basis", "log2_rows = 24\nlevels = 16\nbase = 256\nfeatures = 64"),
            ("hexplane", "resolution = 4096\nmultires = [64, 64, 64, 64, 64, 64, 64, 64]\nfeatures = 256"),
            ("grid4d", "log2_rows = 24\nspace_levels = 64\nfeatures = 16\nspace_base = 65536\nspace_final = 65536"),
            ("swift4d-hash", "log2_rows = 24\nlevels = 20\nfeatures = 16"),
            ("embedding", "time_rows = 100000\ntime_features = 4096"),
            ("deform-mlp", "width = 4096\nlayers = 32"),
            // No network is too large by itself, but all together are.
            ("cdf", "width = 4096\ntime_layers = 12"),
            // The layer between 16 levels of 4096 features and a network 4096 wide.
            ("cdf", wide),
            ("cdf-basis", "resolutions = [8]\nhidden = [4096, 4096, 4096, 4096, 4096, 4096]\nfeatures = 4096\nhashes = 4096\nwidth = 4096\nlayers = 8"),
        ] {
            let mut section: toml::Table = settings.parse().unwrap();
            section.insert("kind".into(), kind.into());
            let error = registry.build_deformer(&section, &context, &Device::flex()).err().unwrap_or_else(|| panic!("{kind} was built"));
            assert!(error.exit_code() == 4 && error.to_string().contains("parameters of the deformer"), "{kind}: {error}");
        }
    }

    #[test]
    fn rates_follow_the_extent_of_the_cameras_unless_a_setting_says_otherwise() {
        let registry = Registry::collect().unwrap();
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 10, sh_degree: 1, seed: Seed::root(1) };
        for kind in ["hexplane", "embedding", "swift4d-hash"] {
            for (settings, follows) in [("", true), ("times_extent = false", false)] {
                let section: toml::Table = format!("kind = '{kind}'\n{settings}").parse().unwrap();
                let groups = registry.build_deformer(&section, &context, &Device::flex()).unwrap().groups();
                assert!(!groups.is_empty() && groups.iter().all(|group| group.times_extent == follows), "{kind}: {settings}");
            }
        }
    }

    #[test]
    fn random_heads_move_gaussians_at_first_and_change_no_other_weights() {
        let registry = Registry::collect().unwrap();
        let device = Device::flex();
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 10, sh_degree: 1, seed: Seed::root(1) };
        let centres = Tensor::<2>::from_floats([[0.3, -0.2, 0.1], [-0.7, 0.4, 0.6]], &device);
        for (kind, sizes) in [
            ("hexplane", "resolution = 4\ntime_resolution = 4\nfeatures = 2\nwidth = 8"),
            ("deform-mlp", "width = 8\nlayers = 3\nskip = 1"),
            ("grid4d", "log2_rows = 6\nspace_levels = 2\nspace_final = 32\ntime_levels = 2\nwidth = 8\ndepth = 1"),
            ("embedding", "gaussian_features = 4\ntime_features = 4\nwidth = 8"),
        ] {
            let start = |settings: &str| {
                let section: toml::Table = format!("kind = '{kind}'\n{sizes}\n{settings}").parse().unwrap();
                let built = registry.build_deformer(&section, &context, &device).unwrap();
                let features = built.spatial(&SpatialInput::at_start(centres.clone(), built.as_ref())).unwrap().values;
                let offsets = to_vec(built.deform(features, 0.3).unwrap().concatenated().unwrap(), "offsets").unwrap();
                let weights: Vec<f32> = built.parameters().iter().flat_map(|p| to_vec(p.value.clone(), "weights").unwrap()).collect();
                (offsets, weights)
            };
            let (plain, random) = (start(""), start("random_heads = true"));
            assert_eq!(start("random_heads = false"), plain, "{kind}");
            assert!(plain.0.iter().all(|v| *v == 0.0), "{kind}: {:?}", plain.0);
            assert!(random.0.iter().all(|v| v.is_finite()) && random.0.iter().filter(|v| **v != 0.0).count() > random.0.len() / 2, "{kind}: {:?}", random.0);
            // All layers of `embedding` start in another way.
            let other = |(a, b): (&f32, &f32)| *a != 0.0 && a != b;
            assert!(plain.1.len() == random.1.len() && (kind == "embedding" || !plain.1.iter().zip(&random.1).any(other)), "{kind}");
        }
    }

    #[test]
    fn rates_and_weights_that_are_negative_or_no_numbers_are_refused() {
        let registry = Registry::collect().unwrap();
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 10, sh_degree: 1, seed: Seed::root(1) };
        for (kind, settings) in [
            ("cdf", "lr_start lr_end clip_norm"),
            ("cdf-basis", "lr_start lr_end clip_norm sparsity"),
            ("hash-basis", "lr_start lr_end clip_norm sparsity grid_rate"),
            ("hexplane", "lr_start lr_end grid_rate tv_space tv_time time_one"),
            ("grid4d", "lr_start lr_end lr_grid_start lr_grid_end smooth_weight smooth_delta smooth_from"),
            ("swift4d-hash", "lr_start lr_end grid_rate"),
            ("embedding", "lr_start lr_end gaussian_lr smooth_weight smooth_falloff"),
            ("deform-mlp", "lr_start lr_end"),
            ("native-4d", "time_lr duration_lr velocity_lr color_lr"),
            ("free-time", "center_lr width_lr gate_lr velocity_lr velocity_lr_end gate_weight"),
            ("life", "center_lr width_lr gate_lr velocity_lr velocity_lr_end gate_weight"),
        ] {
            for name in settings.split(' ') {
                for value in ["-1e-3", "nan", "inf", "1e300"] {
                    let text = match kind {
                        "life" => format!("kind = 'none'\nlife = {{ {name} = {value} }}"),
                        _ => format!("kind = '{kind}'\n{name} = {value}"),
                    };
                    let section: toml::Table = text.parse().unwrap();
                    let error = registry.build_deformer(&section, &context, &Device::flex()).err().unwrap_or_else(|| panic!("built: {text}"));
                    assert!(error.to_string().contains(name), "{text}: {error}");
                }
            }
        }
    }
}
