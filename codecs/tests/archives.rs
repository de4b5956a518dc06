//! Archives whose streams contradict what they say of themselves.

use cc4dgs_format::archive::{Archive, ArchiveWriter, CodecEntry, Manifest, StreamKind};
use cc4dgs_format::{CodecContext, Entries, Error, FIELD_STREAMS, Limits, Seed, Silent, Stream, WeightArray, WeightCodecPlugin, read_weights, toml};

const COUNT: usize = 600_000;

#[test]
fn weights_beyond_the_settings_are_not_decoded() {
    cc4dgs_codecs::link();
    let weights = [WeightArray { name: "table".into(), shape: vec![COUNT], values: vec![0.5; COUNT] }];
    let limits = Limits::default();
    for name in ["fp32", "fp16", "int8", "compact"] {
        let plugin = Entries::<WeightCodecPlugin>::collect().unwrap().get(name).unwrap();
        let codec = (plugin.build)(&toml::Table::new()).unwrap();
        let streams = codec.encode(&weights, &CodecContext::new(Seed::root(1), limits, &Silent)).unwrap();
        let streams = streams.into_iter().map(|s| Stream { name: format!("{FIELD_STREAMS}{}", s.name), bytes: s.bytes });
        let manifest = Manifest { frame_count: 1, time_range: [0.0, 1.0], ..Default::default() };
        let archive = Archive::from_bytes("model.cc4d", ArchiveWriter::new(manifest).add_all(StreamKind::Field, streams).to_bytes().unwrap(), &limits).unwrap();
        let entry = CodecEntry { name: name.into(), version: plugin.info.version.into(), ..Default::default() };
        let read = |count| read_weights("model.cc4d", &archive, &entry, count, &limits, &Silent);
        assert_eq!(read(Some(COUNT as u64)).unwrap()[0].values.len(), COUNT);
        assert!(read(None).is_ok());
        // A MiB is left to names and shapes.
        let error = read(Some(COUNT as u64 / 2)).unwrap_err();
        assert!(matches!(error, Error::Data { .. }) && error.to_string().contains("model.cc4d"), "{name}: {error}");
    }
}
