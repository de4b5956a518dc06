//! The suite that cc4dgs runs on its own codecs.

use cc4dgs_format::storage::relative_rms;
use cc4dgs_format::{CodecContext, CodecPlugin, Entries, HostGaussians, Limits, Seed, Silent, conformance, toml::Table};
use half_floats as _;

#[test]
fn the_codec_conforms() {
    let codecs = Entries::<CodecPlugin>::collect().unwrap();
    let findings = conformance::codec(codecs.get("half").unwrap(), "", &Table::new());
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn what_is_promised_holds_far_from_the_origin() {
    let codec = (Entries::<CodecPlugin>::collect().unwrap().get("half").unwrap().build)("", &Table::new()).unwrap();
    let mut far = HostGaussians { opacity_logits: vec![0.0; 50], ..Default::default() };
    far.columns_mut().into_iter().for_each(|(_, width, values)| *values = (0..50 * width).map(|k| (k as f32).sin()).collect());
    far.means.iter_mut().for_each(|mean| *mean += 1000.0);
    far.log_scales[7] = 1e6;
    let context = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
    let found = codec.decode(&codec.encode(&far, &context).unwrap(), &context).unwrap();
    for ((name, _, before), (_, _, after)) in far.columns().into_iter().zip(found.columns()) {
        assert!(relative_rms(before, after) <= 0.02, "{name}");
    }
    assert!(found.means == far.means && found.sh_dc != far.sh_dc, "float32 where it is needed, and nowhere else");
}
