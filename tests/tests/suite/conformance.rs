//! Every registered plug-in with the conformance suites that `cc4dgs-core` exports.

use cc4dgs::video::ffmpeg_version;
use cc4dgs_backends as _;
use cc4dgs_codecs as _;
use cc4dgs_core::{Registry, config, conformance};
use cc4dgs_deformers as _;
use cc4dgs_parts as _;
use cc4dgs_tests::devices;

/// Small sizes that make the suite fast, for deformers that have sizes.
fn small(name: &str) -> toml::Table {
    let text = match name {
        "cdf" => "levels = 3\nresolutions = [3, 8, 40]\nhashes = 24\nhidden = [20, 12]\nfeatures = 6\nwidth = 16",
        "cdf-basis" => "levels = 3\nresolutions = [3, 8, 40]\nhashes = 24\nhidden = [20, 12]\nfeatures = 6\nwidth = 16\nlearned = 5",
        "hash-basis" => "levels = 3\nbase = 4\nlog2_rows = 7\nwidth = 16\nlearned = 5",
        "swift4d-hash" => "levels = 3\nlog2_rows = 9\nbase = 4\nwidth = 16",
        "grid4d" => "log2_rows = 9\nspace_levels = 3\nspace_final = 64\ntime_levels = 3\nwidth = 16",
        "hexplane" => "resolution = 6\ntime_resolution = 8\nfeatures = 4\nwidth = 16",
        "deform-mlp" => "width = 24\nlayers = 4\nskip = 2\nposition_bands = 3\ntime_bands = 3\ntime_network = true",
        // Neighbours of the suite are too far apart for the default falloff.
        "embedding" => "gaussian_features = 6\ntime_features = 10\ntime_rows = 9\ncoarse_rows = 4\nwidth = 16\nsmooth_falloff = 2.0",
        // The suite evaluates all times, so Gaussians must not be hidden initially.
        "native-4d" => "duration = 0.5\nharmonics = 1",
        "free-time" => "half_width = 0.2\nfalloff = 0.5\ngate = 0.5",
        _ => "",
    };
    config::parse_table("test", text).unwrap()
}

/// The plug-ins of this repository, by kind.
const OURS: [(&str, &[&str]); 10] = [
    ("deformer", &["cdf", "cdf-basis", "deform-mlp", "embedding", "free-time", "grid4d", "hash-basis", "hexplane", "native-4d", "none", "swift4d-hash"]),
    ("codec", &["cca", "compact", "quantize", "raw", "sorted-image", "spz", "vq"]),
    ("weight-codec", &["compact", "fp16", "fp32", "int8"]),
    ("exporter", &["gltf", "mp4", "ply", "ply-sequence", "sog", "splatv", "spz", "web"]),
    ("rasterizer", &["reference", "tile"]),
    ("density", &["clone-split", "mcmc", "none"]),
    ("loss", &["depth", "dssim", "l1", "mask-bce", "mse", "opacity", "photometric", "scale"]),
    ("appearance", &["affine", "none"]),
    ("poses", &["none", "refined"]),
    ("optimizer", &["adam"]),
];

/// The plug-ins of `kind` that are linked, ours among them.
fn linked(registry: &Registry, kind: &str) -> Vec<&'static str> {
    let names: Vec<&str> = registry.plugins().into_iter().filter(|(k, _)| *k == kind).map(|(_, plugin)| plugin.name).collect();
    let ours = OURS.iter().find(|(k, _)| *k == kind).map(|(_, ours)| *ours).expect("a kind of the table");
    let missing: Vec<&&str> = ours.iter().filter(|name| !names.contains(name)).collect();
    assert!(missing.is_empty(), "{kind}: {missing:?} are not linked");
    names
}

#[test]
fn every_deformer_conforms() {
    let registry = Registry::collect().unwrap();
    let names = linked(&registry, "deformer");
    let mut findings = Vec::new();
    for (_, device) in devices() {
        for name in &names {
            findings.extend(conformance::deformer(registry.deformer(name).unwrap(), &small(name), &device));
        }
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn every_codec_conforms() {
    let registry = Registry::collect().unwrap();
    let mut findings = Vec::new();
    linked(&registry, "codec");
    for (_, plugin) in registry.plugins().into_iter().filter(|(kind, _)| *kind == "codec") {
        let profiles = plugin.capabilities.iter().find_map(|c| c.strip_prefix("profiles=")).unwrap_or("");
        for profile in profiles.split(',') {
            // Fewer training steps for codecs that train.
            let quick = if plugin.schema.contains("sample_budget") { "sample_budget = 5000" } else { "" };
            findings.extend(conformance::codec(registry.codec(plugin.name).unwrap(), profile, &config::parse_table("test", quick).unwrap()));
        }
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn every_weight_codec_conforms() {
    let registry = Registry::collect().unwrap();
    let names = linked(&registry, "weight-codec");
    let findings: Vec<String> = names.iter().flat_map(|name| conformance::weight_codec(registry.weight_codec(name).unwrap(), &toml::Table::new())).collect();
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn every_exporter_conforms() {
    let registry = Registry::collect().unwrap();
    linked(&registry, "exporter");
    let drawn = ffmpeg_version().is_ok();
    if !drawn {
        eprintln!("ffmpeg is absent: videos are left out");
    }
    let plugins = registry.exporters().filter(|p| drawn || !p.info.capabilities.contains(&"images"));
    // Pages need the built player; the crate of the exporters tests theirs with a stand-in.
    let plugins: Vec<_> = plugins.filter(|p| !p.info.capabilities.contains(&"player")).collect();
    let findings: Vec<String> = plugins.iter().flat_map(|plugin| conformance::exporter(plugin, &toml::Table::new())).collect();
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn every_rasterizer_conforms() {
    let registry = Registry::collect().unwrap();
    let mut findings = Vec::new();
    let names = linked(&registry, "rasterizer");
    for (device_name, device) in devices() {
        // The reference computes on the host, and refuses other devices.
        for name in names.iter().filter(|name| !(device_name == "wgpu" && **name == "reference")) {
            findings.extend(conformance::rasterizer(registry.rasterizer(name).unwrap(), &toml::Table::new(), &device));
        }
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

/// Runs a suite for every plug-in of `kind` on every device.
fn on_every_device(kind: &str, suite: impl Fn(&Registry, &str, &burn::tensor::Device) -> Vec<String>) {
    let registry = Registry::collect().unwrap();
    let names = linked(&registry, kind);
    let findings: Vec<String> =
        devices().iter().flat_map(|(_, device)| names.iter().flat_map(|name| suite(&registry, name, device)).collect::<Vec<_>>()).collect();
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn every_density_control_conforms() {
    on_every_device("density", |registry, name, device| conformance::density(registry.density(name).unwrap(), &toml::Table::new(), device));
}

#[test]
fn every_loss_term_conforms() {
    on_every_device("loss", |registry, name, device| conformance::loss(registry.loss(name).unwrap(), &toml::Table::new(), registry, device));
}

#[test]
fn every_appearance_model_conforms() {
    on_every_device("appearance", |registry, name, device| conformance::appearance(registry.appearance(name).unwrap(), &toml::Table::new(), device));
}

#[test]
fn every_pose_model_conforms() {
    on_every_device("poses", |registry, name, device| conformance::poses(registry.poses(name).unwrap(), &toml::Table::new(), device));
}

#[test]
fn every_optimizer_conforms() {
    on_every_device("optimizer", |registry, name, device| conformance::optimizer(registry.optimizer(name).unwrap(), &toml::Table::new(), device));
}
