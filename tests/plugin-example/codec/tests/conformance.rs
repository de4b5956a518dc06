//! The suite that cc4dgs runs on its own codecs.

use cc4dgs_format::{CodecPlugin, Entries, conformance, toml::Table};
use half_floats as _;

#[test]
fn the_codec_conforms() {
    let codecs = Entries::<CodecPlugin>::collect().unwrap();
    let findings = conformance::codec(codecs.get("half").unwrap(), "", &Table::new());
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}
