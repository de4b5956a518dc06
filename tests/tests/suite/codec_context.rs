//! The context of a codec when a model is stored together with its scene, and the loss of a deformer's attributes.

use burn::tensor::{Device, Tensor};
use cc4dgs_core::SceneOptions;
use cc4dgs_core::archive::Archive;
use cc4dgs_core::{
    AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Deformer, DeformerContext, EncodedWeights, Error, Event, ExtraAttribute, HostGaussians, Limits,
    Plugin, Recorder, Registry, Result, Seed, Silent, Stream, TrainingViews, TuneModel, TunedModel, Tuning, WeightArray, inventory,
};
use cc4dgs_play::codec_services::SceneViews;
use cc4dgs_play::model::{ModelDeformer, ModelSize};
use cc4dgs_play::{ArchiveOptions, Model, Moving, OrbitViews, RenderConfig, ViewSource};
use cc4dgs_train::data;
use std::cell::RefCell;
use std::path::Path;

/// The codec `raw`, which also records the parts of its context, and asks for the sizes of weights and files as a codec does whose size is bounded.
struct Witness(Box<dyn AttributeCodec>);

impl AttributeCodec for Witness {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        if let (Some(views), Some(renderer), Some(deformer)) = (context.views, context.renderer, context.deformer) {
            let (camera, time_norm) = views.view(0);
            let (image, drawn) = (views.image(0)?, renderer.render(gaussians, camera, time_norm)?.to_image());
            let moved = deformer.deform(gaussians, time_norm)?;
            let same_size = (image.width, image.height) == (drawn.width, drawn.height) && moved.len() == gaussians.len();
            let judges = context.judging_views().map(|judges| format!("{} {} views judge", judges.len(), judges.kind())).unwrap_or_default();
            context.events.emit(&Event::Note { object: "codec witness".into(), message: format!("{} views, {judges}, sizes agree: {same_size}", views.len()) });
        }
        if let (Some(tuner), Some(file_bytes)) = (context.tuner, context.file_bytes) {
            let weights = tuner.start(gaussians)?.weights;
            for steps in [2.0, 4.0] {
                tuner.encoded_weights(&weights, steps)?;
                file_bytes(&[], Some((weights.as_slice(), steps)))?;
            }
            file_bytes(&[], None)?;
            file_bytes(&[], None)?;
            tuner.adopt(weights, 2.0);
        }
        self.0.encode(gaussians, context)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        self.0.decode(streams, context)
    }
    fn losses(&self) -> Vec<DeclaredLoss> {
        self.0.losses()
    }
}

inventory::submit! {
    CodecPlugin {
        info: Plugin { name: "witness", version: "1", summary: "raw, and a note of its context", paper: "a test", schema: "# no settings\n", capabilities: &["lossless"] },
        build: |profile, settings| Ok(Box::new(Witness((Registry::collect()?.codec("raw")?.build)(profile, settings)?))),
    }
}

pub(super) const COUNT: usize = 90;

/// Every third Gaussian moves, with attributes of its own.
pub(super) fn model(registry: &Registry) -> Model {
    let draw = |i: usize, k: usize| (Seed::root(3).index(i as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
    let mut gaussians = HostGaussians::default();
    for i in 0..COUNT {
        gaussians.means.extend([draw(i, 0), draw(i, 1), draw(i, 2)]);
        gaussians.log_scales.extend([-2.0, -2.2, -2.4]);
        gaussians.quaternions.extend([1.0, 0.1 * draw(i, 3), 0.0, 0.0]);
        gaussians.opacity_logits.push(1.0);
        gaussians.sh_dc.extend([draw(i, 4), draw(i, 5), draw(i, 6)]);
        gaussians.dynamic_scores.push(if i % 3 == 0 { 9.0 } else { 0.0 });
    }
    let device = Device::flex();
    let section: toml::Table = "kind = \"native-4d\"\nduration = 0.5".parse().unwrap();
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 10, sh_degree: 0, seed: Seed::root(3) };
    let field = registry.build_deformer(&section, &context, &device).unwrap();
    for spec in field.attributes() {
        let values = (0..COUNT * spec.width).map(|i| spec.start + 0.1 * draw(i, 7)).collect();
        gaussians.extra.insert(spec.name.clone(), ExtraAttribute::exact(spec.width, values));
    }
    Model {
        gaussians,
        field: Some(ModelDeformer { field, section, context }),
        moving: Moving::Scored { zeta: 5.0 },
        render: RenderConfig::default(),
        background: Some([0.2, 0.4, 0.6]),
        rasterizer: "kind = \"tile\"".parse().unwrap(),
        frame_count: 10,
        normalisation: Default::default(),
        provenance: Default::default(),
        size: ModelSize::default(),
    }
}

/// The same Gaussians with a deformer whose weights move everything.
pub(super) fn moved_by_weights(registry: &Registry, device: &Device) -> Model {
    let mut model = model(registry);
    let section: toml::Table = "kind = \"cdf-basis\"\ncapacity = \"small\"\nresolutions = [8]\nhashes = 16\ntime_bands = 2".parse().unwrap();
    let context = model.field.as_ref().unwrap().context.clone();
    let mut field = registry.build_deformer(&section, &context, device).unwrap();
    add_noise(field.as_mut(), 0.07, 1, device);
    (model.field, model.moving) = (Some(ModelDeformer { field, section, context }), Moving::Everything);
    model.gaussians.extra.clear();
    model
}

pub(super) fn scene() -> cc4dgs_core::Scene {
    data::open(Path::new("procedural"), &SceneOptions { width: 40, height: 40, ..Default::default() }, &Registry::collect().unwrap(), &Limits::default())
        .unwrap()
}

#[test]
fn a_codec_gets_views_renderer_and_field_only_with_a_scene() {
    let registry = Registry::collect().unwrap();
    let (model, scene, device) = (model(&registry), scene(), Device::flex());
    let folder = tempfile::tempdir().unwrap();
    let settings = toml::Table::new();
    let notes = |scene: Option<&cc4dgs_core::Scene>| -> Vec<String> {
        let events = Recorder::default();
        let views = scene.map(|s| (ViewSource::Scene(s), &device));
        let options = ArchiveOptions { codec: "witness", settings: &settings, field_weights: "fp32", views, tuner: None };
        model.save_archive(&folder.path().join("m.cc4d"), &options, &registry, &Limits::default(), &events).unwrap();
        events.events().into_iter().filter_map(|e| if let Event::Note { message, .. } = e { Some(message) } else { None }).collect()
    };
    assert!(notes(None).is_empty());
    let count = SceneViews::new(&scene).len();
    assert_eq!(notes(Some(&scene)), [format!("{count} views, {count} training views judge, sizes agree: true")]);
    let scene = data::hold_out(&scene, 12).unwrap();
    let judges = count - SceneViews::new(&scene).len();
    assert!(judges > 0);
    assert_eq!(notes(Some(&scene)), [format!("{} views, {judges} validation views judge, sizes agree: true", count - judges)]);
}

/// A tuner that notes in which steps it encodes weights.
#[derive(Default)]
struct Counting {
    encoded: RefCell<Vec<f64>>,
    adopted: RefCell<Option<(Vec<WeightArray>, f64)>>,
}

impl TuneModel for Counting {
    fn caution(&self) -> Result<Option<String>> {
        Ok(None)
    }
    fn start(&self, gaussians: &HostGaussians) -> Result<TunedModel> {
        Ok(TunedModel { gaussians: gaussians.clone(), weights: vec![WeightArray { name: "tuned".into(), shape: vec![2], values: vec![1.0, 2.0] }] })
    }
    fn tune(&self, from: &TunedModel, _: &Tuning) -> Result<TunedModel> {
        Ok(from.clone())
    }
    fn psnr(&self, _: &HostGaussians, _: &[WeightArray], _: Option<f64>) -> Result<f64> {
        Ok(0.0)
    }
    fn encoded_weights(&self, _: &[WeightArray], weight_steps: f64) -> Result<EncodedWeights> {
        self.encoded.borrow_mut().push(weight_steps);
        Ok((Vec::new(), toml::Table::from_iter([("steps".into(), weight_steps.into())])))
    }
    fn adopt(&self, weights: Vec<WeightArray>, weight_steps: f64) {
        *self.adopted.borrow_mut() = Some((weights, weight_steps));
    }
    fn adopted(&self) -> Result<Option<EncodedWeights>> {
        self.adopted.borrow().as_ref().map(|(weights, steps)| self.encoded_weights(weights, *steps)).transpose()
    }
}

#[test]
fn weights_are_encoded_once_for_each_of_their_steps() {
    let registry = Registry::collect().unwrap();
    let (model, scene, device, tuner) = (model(&registry), scene(), Device::flex(), Counting::default());
    let (settings, limits) = (toml::Table::new(), Limits::default());
    let views = Some((ViewSource::Scene(&scene), &device));
    let options = ArchiveOptions { codec: "witness", settings: &settings, field_weights: "fp32", views, tuner: Some(&tuner) };
    let bytes = model.to_archive(&options, &registry, &limits, &Silent).unwrap();
    // Those of the codec twice, and once those of the model itself.
    assert_eq!(*tuner.encoded.borrow(), [2.0, 4.0, 1.0]);
    assert!(tuner.adopted.borrow().is_some(), "the tuner is told what was adopted");
    let stored = Archive::from_bytes("t", bytes, &limits).unwrap().manifest().deformer.clone().unwrap().weights;
    assert_eq!(stored.settings["steps"].as_float(), Some(2.0), "what was adopted is stored");

    // An orbit has no images to train on.
    let orbit = OrbitViews::around(&model.gaussians, (40, 30), 12).unwrap();
    model.to_archive(&ArchiveOptions { codec: "raw", views: Some((ViewSource::Orbit(&orbit), &device)), ..options }, &registry, &limits, &Silent).unwrap();
    assert_eq!(tuner.encoded.borrow().len(), 3);
}

#[test]
fn gaussians_that_no_reader_accepts_are_not_encoded() {
    let registry = Registry::collect().unwrap();
    let (model, settings) = (model(&registry), toml::Table::new());
    let options = ArchiveOptions { codec: "raw", settings: &settings, field_weights: "fp32", views: None, tuner: None };
    let write = |max_bytes: u64| model.to_archive(&options, &registry, &Limits { max_bytes, ..Limits::default() }, &Silent);
    let bytes = model.float32_size().point_cloud;
    assert!(write(bytes).is_ok());
    let refused = write(bytes - 1).unwrap_err();
    assert!(matches!(&refused, Error::Limit { value, limit, .. } if (*value, *limit) == (bytes, bytes - 1)), "{refused}");
    assert!(refused.to_string().contains("decoded bytes of 90 Gaussians") && refused.to_string().contains("limits.max_bytes"), "{refused}");
}

#[test]
fn weights_take_the_fewest_bits_that_keep_the_psnr() {
    let registry = Registry::collect().unwrap();
    let (scene, device) = (scene(), Device::flex());
    let model = moved_by_weights(&registry, &device);
    let folder = tempfile::tempdir().unwrap();
    let (settings, path) = (toml::Table::new(), folder.path().join("m.cc4d"));
    let views = Some((ViewSource::Scene(&scene), &device));
    let bits = |field_weights: &str| {
        let options = ArchiveOptions { codec: "raw", settings: &settings, field_weights, views, tuner: None };
        model.save_archive(&path, &options, &registry, &Limits::default(), &Silent).unwrap();
        let entry = Archive::open(&path, &Limits::default()).unwrap().manifest().deformer.clone().unwrap().weights;
        Model::open(&path, &registry, &device, &Limits::default(), &Silent).unwrap();
        // Of each array where they were searched, else of all.
        let number = |value: &toml::Value| value.as_float().or(value.as_integer().map(|v| v as f64)).unwrap();
        let arrays = entry.settings.get("array_bits").and_then(toml::Value::as_array).filter(|list| !list.is_empty());
        arrays.map_or_else(|| vec![number(&entry.settings["bits"])], |list| list.iter().map(number).collect())
    };
    let (stated, fewest) = (bits("compact:bits=5"), bits("compact:max-drop=60dB"));
    assert_eq!(stated, [5.0]);
    assert!(fewest.len() > 1 && fewest.iter().all(|b| *b == 3.0), "{fewest:?}");
    assert!(bits("compact:max-drop=0.001dB").iter().sum::<f64>() > 4.0 * fewest.len() as f64);
    for bad in ["compact:max-drop=x", "fp16:max-drop=0.1dB", "compact:bits=17", "compact:bits", "nothing"] {
        let options = ArchiveOptions { codec: "raw", settings: &settings, field_weights: bad, views, tuner: None };
        assert!(model.save_archive(&path, &options, &registry, &Limits::default(), &Silent).is_err(), "{bad}");
    }
    let options = ArchiveOptions { codec: "raw", settings: &settings, field_weights: "compact:max-drop=0.1dB", views: None, tuner: None };
    let refused = model.save_archive(&path, &options, &registry, &Limits::default(), &Silent).unwrap_err();
    assert!(refused.to_string().contains("--scene") && refused.to_string().contains("--field-weights"), "{refused}");

    // Validation views judge where there are some.
    let (held_out, events) = (data::hold_out(&scene, 12).unwrap(), Recorder::default());
    let views = Some((ViewSource::Scene(&held_out), &device));
    let options = ArchiveOptions { codec: "raw", settings: &settings, field_weights: "compact:max-drop=60dB", views, tuner: None };
    model.save_archive(&path, &options, &registry, &Limits::default(), &events).unwrap();
    let judged = |event: &Event| matches!(event, Event::Note { message, .. } if message.contains("validation views (60 dB allowed)"));
    assert!(events.events().iter().any(judged), "{:?}", events.events());

    // A bound on the size is one of the whole file.
    let size = |codec: &str, field_weights: &str| {
        let options = ArchiveOptions { codec, settings: &settings, field_weights, views: None, tuner: None };
        model.save_archive(&path, &options, &registry, &Limits::default(), &Silent)
    };
    let most = size("compact:psnr=60dB", "fp16").unwrap() + 2000;
    let bounded = format!("compact:max-size={}MB", most as f64 / 1e6);
    assert!(size(&bounded, "fp16").unwrap() <= most);
    let refused = size(&bounded, "fp32").unwrap_err().to_string();
    assert!(refused.contains("weights of the deformer"), "{refused}");
}

/// Noise for the weights of a deformer, of the standard deviation 1: array by array.
pub(super) fn noise(counts: &[usize], seed: u64) -> Vec<Vec<f32>> {
    let value = |word: u64| 3f32.sqrt() * ((word >> 40) as f32 / (1u64 << 23) as f32 - 1.0);
    let array = |(index, &count): (usize, &usize)| (0..count).map(|k| value(Seed::root(seed).index(index as u64).index(k as u64).value())).collect();
    counts.iter().enumerate().map(array).collect()
}

/// Gives the weights of `field` so much noise, so that all of them count.
pub(super) fn add_noise(field: &mut dyn Deformer, scale: f32, seed: u64, device: &Device) {
    let counts: Vec<usize> = field.parameters().iter().map(|p| p.value.dims()[0]).collect();
    for (parameter, noise) in field.parameters_mut().into_iter().zip(noise(&counts, seed)) {
        parameter.value = parameter.value.clone() + Tensor::<1>::from_floats(noise.as_slice(), device).mul_scalar(scale);
    }
}

#[test]
fn an_archive_has_the_same_bits_on_every_device() {
    let registry = Registry::collect().unwrap();
    let (model, scene, device) = (model(&registry), scene(), Device::flex());
    let folder = tempfile::tempdir().unwrap();
    let (path, limits) = (folder.path().join("m.cc4d"), Limits::default());
    let settings = "finetune = 0\nmax_drop_db = 1.0".parse().unwrap();
    let views = Some((ViewSource::Scene(&scene), &device));
    let options = ArchiveOptions { codec: "compact", settings: &settings, field_weights: "compact", views, tuner: None };
    model.save_archive(&path, &options, &registry, &limits, &Silent).unwrap();
    let stored = Archive::open(&path, &limits).unwrap().stream_sizes();
    assert!(stored.iter().any(|s| s.name.starts_with("coded.")), "attributes are rounded where the scene is given");
    let opened = |device: &Device| {
        let model = Model::open(&path, &registry, device, &limits, &Silent).unwrap();
        (model.gaussians, cc4dgs_play::weights_of(model.field.unwrap().field.as_ref()).unwrap())
    };
    let expected = opened(&device);
    for (name, device) in cc4dgs_tests::devices() {
        assert!(opened(&device) == expected, "{name}");
    }
}

#[test]
fn attributes_of_gaussians_that_stand_still_are_not_stored_by_lossy_codecs() {
    let registry = Registry::collect().unwrap();
    let model = model(&registry);
    let folder = tempfile::tempdir().unwrap();
    let (settings, limits) = (toml::Table::new(), Limits::default());
    let mut sizes = Vec::new();
    for codec in ["raw", "quantize"] {
        let path = folder.path().join(format!("{codec}.cc4d"));
        let options = ArchiveOptions { codec, settings: &settings, field_weights: "fp32", views: None, tuner: None };
        model.save_archive(&path, &options, &registry, &limits, &Silent).unwrap();
        let stored: u64 = Archive::open(&path, &limits).unwrap().stream_sizes().iter().filter(|s| s.name.starts_with("extra.")).map(|s| s.decoded_bytes).sum();
        sizes.push(stored);
        let back = Model::open(&path, &registry, &Device::flex(), &limits, &Silent).unwrap();
        // Codecs reorder Gaussians. The score tells moving ones from static ones, and their attributes must be among the encoded ones.
        for spec in model.field.as_ref().unwrap().field.attributes() {
            let given = &model.gaussians.extra[&spec.name].values;
            for (row, score) in back.gaussians.extra[&spec.name].values.chunks_exact(spec.width).zip(&back.gaussians.dynamic_scores) {
                let known = given.chunks_exact(spec.width).any(|g| g == row);
                let at_start = row.iter().all(|v| *v == spec.start);
                assert!(known && (*score > 5.0 || codec == "raw") || at_start && *score <= 5.0, "{codec}: {} of a score of {score}: {row:?}", spec.name);
            }
        }
    }
    assert!(2 * sizes[1] < sizes[0], "{sizes:?}: two thirds of the rows need no bytes");
}
