//! The baselines are as large as their papers say.

use burn::tensor::Device;
use cc4dgs_core::{FieldContext, Registry, Seed, config};
use cc4dgs_deformers as _;

/// Bytes (grid, net) as float32 of a field built for 300 frames of Gaussians of degree 3.
fn size(kind: &str, settings: &str) -> (u64, u64) {
    let context = FieldContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 300, sh_degree: 3, seed: Seed::root(1) };
    let section = config::parse_table("test", settings).unwrap();
    let registry = Registry::collect().unwrap();
    (registry.deformer(kind).unwrap().build)(&section, &context, &Device::flex()).unwrap().size_bytes()
}

#[test]
fn swift4d_takes_9_2_or_127_7_megabytes() {
    // 16 levels of 2^15 rows of 4, the encoder, five heads padded to 16 columns.
    assert_eq!(size("swift4d-hash", ""), (4 * (2_097_152 + 24_576), 4 * 178_176));
    // The first of 16 levels of 2^19 rows is dense: 16^4 vertices.
    assert_eq!(size("swift4d-hash", "log2_rows = 19"), (4 * (31_719_424 + 24_576), 4 * 178_176));
}

#[test]
fn grid4d_takes_278_9_or_136_9_megabytes() {
    let of = |last: &str| size("grid4d", &format!("time_base = [16, 16, 16]\ntime_final = {last}"));
    let ((high, net), (low, _)) = (of("[512, 512, 128]"), of("[64, 64, 128]"));
    assert_eq!(net, 4 * 61_454);
    assert!((high as f64 / 1e6 - 278.9).abs() < 0.15 && (low as f64 / 1e6 - 136.9).abs() < 0.15, "{high} and {low} bytes");
}

#[test]
fn hexplane_takes_9_46_and_0_38_megabytes() {
    assert_eq!(size("hexplane", ""), (4 * 2_365_440, 4 * 94_395));
}

#[test]
fn deform_mlp_takes_2_megabytes() {
    assert_eq!(size("deform-mlp", ""), (0, 4 * 506_378));
    assert_eq!(size("deform-mlp", "time_bands = 6\ntime_network = true"), (0, 4 * 522_280));
}

#[test]
fn embedding_takes_1_17_megabytes() {
    let (grid, net) = size("embedding", "");
    // The published 292,756 floats hold 30 time offsets of cameras besides.
    assert_eq!((grid, net), (4 * 150 * 256, 4 * (292_756 - 30 - 150 * 256)));
}

#[test]
fn cdf_takes_0_753_and_1_113_megabytes() {
    assert_eq!(size("cdf", ""), (4 * 188_320, 4 * 278_203));
}
