//! What codecs measure of a model with the views of its scene: its images, how they change with its weights and colours, and what its deformer moves.

use crate::codec_context::{COUNT, add_noise, model, noise, scene};
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{
    AttributeSpec, Camera, Deformer, EvaluateDeformer, HostGaussians, Offsets, Parameter, ParameterGroup, Registry, RenderModel, Result, Seed, Silent,
    SpatialFeatures, SpatialInput, TrainingViews,
};
use cc4dgs_play::codec_services::{ModelServices, SceneViews};
use cc4dgs_play::field_weights::FieldWeights;
use cc4dgs_play::model::ModelDeformer;
use cc4dgs_play::player::Player;
use cc4dgs_play::{Model, Moving};
use cc4dgs_tests::larger;
use std::sync::atomic::{AtomicUsize, Ordering};

/// A small change of weights.
const CHANGE: f64 = 2e-4;

#[test]
fn importance_tells_how_much_images_change_with_weights() {
    let registry = Registry::collect().unwrap();
    let (device, scene) = (Device::flex(), scene());
    let views = SceneViews::new(&scene);
    let context = model(&registry).field.unwrap().context;
    for (kind, section) in [
        ("cdf-basis", "capacity = \"small\"\nresolutions = [8]\nhashes = 16"),
        ("cdf", "capacity = \"small\""),
        ("hash-basis", ""),
        ("deform-mlp", "width = 32"),
        ("hexplane", ""),
    ] {
        let mut section: toml::Table = section.parse().unwrap();
        section.insert("kind".into(), kind.into());
        let built = |scales: &[f32]| {
            let mut field = registry.build_deformer(&section, &context, &device).unwrap();
            scales.iter().zip(1..).for_each(|(scale, seed)| add_noise(field.as_mut(), *scale, seed, &device));
            let mut out = Model {
                field: Some(ModelDeformer { field, section: section.clone(), context: context.clone() }),
                moving: Moving::Everything,
                ..model(&registry)
            };
            out.gaussians.extra.clear();
            out
        };
        let of = built(&[0.05]);
        let compact = FieldWeights::parse("compact", &registry).unwrap();
        assert!(FieldWeights::parse("fp16", &registry).unwrap().importance(&of, &views, &registry, &device, &Silent).unwrap().is_none());
        let importance = compact.importance(&of, &views, &registry, &device, &Silent).unwrap().unwrap();
        let counts: Vec<usize> = of.field.as_ref().unwrap().field.parameters().iter().map(|p| p.value.dims()[0]).collect();
        assert_eq!(importance.iter().map(Vec::len).collect::<Vec<_>>(), counts, "{kind}");
        assert!(importance.iter().flatten().all(|v| v.is_finite() && *v >= 0.0), "{kind}");
        // A small change of all weights that has nothing to do with images.
        let changes = noise(&counts, 2);
        let squares = changes
            .iter()
            .flatten()
            .zip(importance.iter().flatten())
            .map(|(change, importance)| (CHANGE * f64::from(*change)).powi(2) * f64::from(*importance));
        let expected: f64 = squares.sum();
        let (mut found, after) = (0.0, built(&[0.05, CHANGE as f32]));
        let (before, after) = (ModelServices::new(&of, &registry, &device).unwrap(), ModelServices::new(&after, &registry, &device).unwrap());
        for k in 0..views.len() {
            let (camera, time_norm) = views.view(k);
            let [a, b] = [&before, &after].map(|services| services.render(&of.gaussians, camera, time_norm).unwrap().planes);
            let colours = 3 * camera.width as usize * camera.height as usize;
            found += a.iter().zip(&b).take(colours).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / views.len() as f64;
        }
        println!("{kind}: expected {expected:e}, found {found:e}");
        assert!(expected > 0.0 && (0.2..5.0).contains(&(found / expected)), "{kind}: images change by {found:e}, {expected:e} was expected");
    }
}

#[test]
fn services_move_and_draw_as_playback_does() {
    let registry = Registry::collect().unwrap();
    let (model, scene, device) = (model(&registry), scene(), Device::flex());
    let services = ModelServices::new(&model, &registry, &device).unwrap();
    let views = SceneViews::new(&scene);
    let (camera, _) = views.view(0);
    let drawn = services.render(&model.gaussians, camera, 0.8).unwrap();
    let played = Player::new(&model, &registry, &device).unwrap().render(camera, 0.8).unwrap().0.planes.into_data().to_vec::<f32>().unwrap();
    let worst = drawn.planes.iter().zip(&played).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
    assert!(drawn.planes.len() == played.len() && worst < 1e-4, "off by {worst}");

    let moved = services.deform(&model.gaussians, 0.8).unwrap();
    for (i, (before, after)) in model.gaussians.means.chunks_exact(3).zip(moved.means.chunks_exact(3)).enumerate() {
        assert_eq!(before == after, i % 3 != 0, "Gaussian {i}: {before:?} became {after:?}");
    }
}

/// A deformer that counts how often it computes what does not depend on time.
struct Counted {
    inner: Box<dyn Deformer>,
    spatial: AtomicUsize,
}

impl Deformer for Counted {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        self.spatial.fetch_add(1, Ordering::Relaxed);
        self.inner.spatial(input)
    }
    fn attributes(&self) -> Vec<AttributeSpec> {
        self.inner.attributes()
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        self.inner.deform(features, time_norm)
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.inner.parameters()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.inner.parameters_mut()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        self.inner.groups()
    }
}

#[test]
fn views_share_what_does_not_depend_on_time() {
    let registry = Registry::collect().unwrap();
    let deformer = Counted { inner: model(&registry).field.unwrap().field, spatial: AtomicUsize::new(0) };
    let (model, scene, device) = (model(&registry), scene(), Device::flex());
    let services = ModelServices::new(&model, &registry, &device).unwrap().with_deformer(&deformer);
    let views = SceneViews::new(&scene);
    let shown: Vec<(&Camera, f32)> = [0.1, 0.5, 0.8].iter().enumerate().map(|(k, &time_norm)| (views.view(k * views.len() / 3).0, time_norm)).collect();
    let mut images = Vec::new();
    let drawn = services.render_views(&model.gaussians, &shown, &mut |k, drawn| {
        images.push((k, drawn));
        Ok(())
    });
    drawn.unwrap();
    assert_eq!(deformer.spatial.swap(0, Ordering::Relaxed), 1);
    assert_eq!(images.iter().map(|(k, _)| *k).collect::<Vec<_>>(), [0, 1, 2]);
    for (k, drawn) in &images {
        assert!(*drawn == services.render(&model.gaussians, shown[*k].0, shown[*k].1).unwrap(), "view {k}");
    }
    assert_eq!(deformer.spatial.swap(0, Ordering::Relaxed), 3);
    assert!(images[0].1 != images[2].1);
    // Derivatives do, too.
    let mut found = Vec::new();
    let measured = services.squared_derivatives_in_views(&model.gaussians, &shown, Seed::root(1), &mut |k, squares, means| {
        found.push((k, squares, means));
        Ok(())
    });
    assert!(measured.unwrap() && deformer.spatial.load(Ordering::Relaxed) == 1);
    for (k, (index, squares, means)) in found.iter().enumerate() {
        let (camera, time_norm) = shown[k];
        let alone = services.squared_derivatives(&model.gaussians, camera, time_norm, Seed::root(1).index(k as u64)).unwrap().unwrap();
        assert!(*index == k && *squares == alone, "view {k}");
        assert!(*means == Some(services.deform(&model.gaussians, time_norm).unwrap().means), "view {k}");
    }
    assert_eq!(found.len(), 3);
}

#[test]
fn a_colour_below_zero_matters_as_much_as_any_other() {
    let registry = Registry::collect().unwrap();
    let (model, scene, device) = (model(&registry), scene(), Device::flex());
    let services = ModelServices::new(&model, &registry, &device).unwrap();
    let views = SceneViews::new(&scene);
    let of = |gaussians: &HostGaussians| services.squared_derivatives(gaussians, views.view(0).0, 0.3, Seed::root(1)).unwrap().unwrap().sh_dc;
    // All are drawn black; once rounded they may not be.
    let dark = HostGaussians { sh_dc: vec![-9.0; 3 * COUNT], ..model.gaussians.clone() };
    let (bright, dark) = (of(&model.gaussians), of(&dark));
    assert!(bright.iter().filter(|v| **v > 0.0).count() > COUNT);
    let worst = bright.iter().zip(&dark).map(|(a, b)| (a - b).abs() / (a.max(*b) + 1e-6)).fold(0.0, larger);
    assert!(worst < 1e-3, "derivatives differ by {worst} of their size");
}
