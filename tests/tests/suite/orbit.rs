//! Compression of models whose scene is not there, measured in views round them.

use crate::codec_context::moved_by_weights;
use burn::tensor::Device;
use cc4dgs_core::archive::Archive;
use cc4dgs_core::{Error, Event, Limits, Recorder, Registry, Silent};
use cc4dgs_play::{ArchiveOptions, Model, OrbitViews, ViewSource};

#[test]
fn codecs_measure_in_views_round_a_model() {
    let registry = Registry::collect().unwrap();
    let (device, limits, settings) = (Device::flex(), Limits::default(), toml::Table::new());
    let model = moved_by_weights(&registry, &device);
    let orbit = OrbitViews::around(&model.gaussians, (40, 30), 12).unwrap();
    // All that a compression says.
    let said = |views: Option<(ViewSource, &Device)>| -> String {
        let events = Recorder::default();
        let options = ArchiveOptions { codec: "compact:psnr=40dB", settings: &settings, field_weights: "compact:bits=6", views, tuner: None };
        let bytes = model.to_archive(&options, &registry, &limits, &events).unwrap();
        let archive = Archive::from_bytes("archive", bytes, &limits).unwrap();
        let opened = Model::of_archive("archive", &archive, &registry, &device, &limits, &Silent).unwrap();
        assert_eq!(opened.gaussians.len(), model.gaussians.len());
        let line = |event: Event| match event {
            Event::Note { message, .. } | Event::Warning { message, .. } => message,
            Event::Progress { task, .. } => task,
            _ => String::new(),
        };
        events.events().into_iter().map(line).collect::<Vec<String>>().join("\n")
    };
    let (measured, estimated) = (said(Some((ViewSource::Orbit(&orbit), &device))), said(None));
    for part in ["importance of Gaussians", "importance of weights", "12 orbit views"] {
        assert!(measured.contains(part), "{part}: {measured}");
        assert!(!estimated.contains(part), "{part}: {estimated}");
    }
}

#[test]
fn an_orbit_does_not_stand_for_the_images_of_a_scene() {
    let registry = Registry::collect().unwrap();
    let device = Device::flex();
    let model = moved_by_weights(&registry, &device);
    let orbit = OrbitViews::around(&model.gaussians, (40, 30), 12).unwrap();
    let cases = [("compact:max-drop=1dB", "", "fp32"), ("compact", "finetune = 9", "fp32"), ("raw", "", "compact:max-drop=1dB")];
    for (codec, settings, field_weights) in cases {
        let settings: toml::Table = settings.parse().unwrap();
        let early = ArchiveOptions::check(codec, &settings, field_weights, false, &registry).unwrap_err();
        let options = ArchiveOptions { codec, settings: &settings, field_weights, views: Some((ViewSource::Orbit(&orbit), &device)), tuner: None };
        let late = model.to_archive(&options, &registry, &Limits::default(), &Silent).unwrap_err();
        for refused in [early, late] {
            assert!(matches!(refused, Error::Parameter { .. }) && refused.to_string().contains("images of a scene"), "{refused}");
        }
    }
}
