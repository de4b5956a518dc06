//! `compact` with views and a renderer: the loss is kept, and measured steps are never worse than estimated ones.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

use cc4dgs_format::{
    Camera, CodecContext, CodecPlugin, Entries, EvaluateDeformer, Event, EventSink, ExtraAttribute, HostGaussians, Image8, Limits, RenderModel, RenderedPlanes,
    Result, Seed, Silent, Stream, TrainingViews, WeightArray, toml,
};
use std::sync::Mutex;

const SIZE: usize = 24;

/// Draws every Gaussian as a blot, without order, so that images depend smoothly on all values. The attribute `velocity` moves it.
struct Blots;

impl EvaluateDeformer for Blots {
    fn deform(&self, gaussians: &HostGaussians, _: f32) -> Result<HostGaussians> {
        Ok(gaussians.clone())
    }
}

impl RenderModel for Blots {
    fn render(&self, g: &HostGaussians, camera: &Camera, time_norm: f32) -> Result<RenderedPlanes> {
        let mut planes = vec![0.0; 5 * SIZE * SIZE];
        let width = g.sh_rest.len() / g.len().max(1);
        for i in 0..g.len() {
            let velocity = g.extra.get("velocity").map_or([0.0; 2], |a| [a.values[2 * i], a.values[2 * i + 1]]);
            let (x, y) = (g.means[3 * i] + (0.1 + velocity[0]) * time_norm, g.means[3 * i + 1] + velocity[1] * time_norm);
            let s = &g.log_scales[3 * i..3 * i + 3];
            let q = &g.quaternions[4 * i..4 * i + 4];
            let turn = q[1] * q[2] / q.iter().map(|v| v * v).sum::<f32>();
            let radius = (s[0] * (1.0 + turn)).exp() + s[1].exp() + s[2].exp() + 0.03;
            let alpha = 0.3 / (1.0 + (-g.opacity_logits[i]).exp());
            for p in 0..SIZE * SIZE {
                let at = |k: usize| (k as f32 + 0.5) / SIZE as f32 * 2.0 - 1.0;
                let d = ((at(p % SIZE) - x).powi(2) + (at(p / SIZE) - y).powi(2)) / (radius * radius);
                if d < 9.0 {
                    for c in 0..3 {
                        let rest: f32 = g.sh_rest[i * width..(i + 1) * width].iter().skip(c).step_by(3).sum();
                        planes[c * SIZE * SIZE + p] += alpha * (-0.5 * d).exp() * (0.5 + 0.28 * g.sh_dc[3 * i + c] + 0.1 * camera.cx as f32 * rest);
                    }
                }
            }
        }
        Ok(RenderedPlanes { width: SIZE as u32, height: SIZE as u32, planes })
    }
    fn background(&self) -> [f32; 3] {
        [0.0; 3]
    }
}

struct Views(Vec<(Camera, f32, Image8)>);

impl TrainingViews for Views {
    fn len(&self) -> usize {
        self.0.len()
    }
    fn view(&self, index: usize) -> (&Camera, f32) {
        (&self.0[index].0, self.0[index].1)
    }
    fn image(&self, index: usize) -> Result<Image8> {
        Ok(self.0[index].2.clone())
    }
}

/// Views of a split. Reading an image fails the test unless the views judge losses.
struct OfSplit<'a> {
    views: &'a Views,
    judges: bool,
}

impl TrainingViews for OfSplit<'_> {
    fn len(&self) -> usize {
        self.views.len()
    }
    fn kind(&self) -> &'static str {
        if self.judges { "validation" } else { "training" }
    }
    fn view(&self, index: usize) -> (&Camera, f32) {
        self.views.view(index)
    }
    fn image(&self, index: usize) -> Result<Image8> {
        assert!(self.judges, "a loss is measured on images of training views");
        self.views.image(index)
    }
}

#[derive(Default)]
struct Notes(Mutex<Vec<String>>);

impl EventSink for Notes {
    fn emit(&self, event: &Event) {
        if let Event::Note { message, .. } = event {
            self.0.lock().unwrap().push(message.clone());
        }
    }
}

fn draw(i: usize, k: usize) -> f32 {
    (Seed::root(77).index(i as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

fn scene(count: usize) -> HostGaussians {
    let mut g = HostGaussians { sh_degree: 1, ..Default::default() };
    for (column, (name, width, values)) in g.columns_mut().into_iter().enumerate() {
        let (shift, scale) = if name == "log_scales" { (-3.0, 0.7) } else { (0.0, if name == "sh_rest" { 0.2 } else { 0.9 }) };
        *values = (0..count * width).map(|i| shift + scale * draw(i, column)).collect();
    }
    g
}

fn psnr(g: &HostGaussians, views: &Views) -> f64 {
    let of = |(camera, time, image): &(Camera, f32, Image8)| {
        let (drawn, truth) = (Blots.render(g, camera, *time).unwrap(), image.to_planes([0.0; 3]));
        let error: f64 = truth.iter().zip(&drawn.planes).map(|(a, b)| f64::from(a - b.clamp(0.0, 1.0)).powi(2)).sum::<f64>() / truth.len() as f64;
        -10.0 * error.log10()
    };
    views.0.iter().map(of).sum::<f64>() / views.0.len() as f64
}

/// What is recorded differs from what is drawn, as for a trained model.
fn recorded(g: &HostGaussians) -> Views {
    let view = |k: u8| {
        let camera = Camera { cx: f64::from(k), ..Camera::look_at("view", (SIZE as u32, SIZE as u32), 0.8, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]) };
        let mut drawn = Blots.render(g, &camera, 0.3 * f32::from(k)).unwrap();
        drawn.planes.iter_mut().enumerate().for_each(|(p, v)| *v += 0.02 * draw(p, 50 + usize::from(k)));
        (camera, 0.3 * f32::from(k), drawn.to_image())
    };
    Views((0..4).map(view).collect())
}

#[test]
fn the_loss_is_kept_and_measured_steps_save_bytes() {
    cc4dgs_codecs::link();
    let g = scene(600);
    let (views, notes) = (recorded(&g), Notes::default());
    let context = CodecContext {
        views: Some(&views),
        renderer: Some(&Blots),
        // All may move, so that no axes are exchanged: blots are no ellipsoids.
        dynamic_threshold: Some(f32::NEG_INFINITY),
        ..CodecContext::new(Seed::root(1), Limits::default(), &notes)
    };
    let plugin = Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap();
    let encode = |profile: &str, settings: &str| {
        let codec = (plugin.build)(profile, &settings.parse::<toml::Table>().unwrap()).unwrap();
        let streams = codec.encode(&g, &context).unwrap();
        let found = codec.decode(&streams, &CodecContext::new(Seed::root(1), Limits::default(), &Silent)).unwrap();
        (streams.iter().map(|s: &Stream| s.bytes.len()).sum::<usize>(), psnr(&g, &views) - psnr(&found, &views))
    };
    let (loose, loose_drop) = encode("max-drop=0.5dB", "");
    let (tight, tight_drop) = encode("max-drop=0.02dB", "");
    assert!(loose_drop <= 0.5 && tight_drop <= 0.02, "{loose_drop}, {tight_drop}");
    assert!(loose < tight, "{loose} bytes for 0.5 dB, {tight} for 0.02 dB");
    assert!(notes.0.lock().unwrap().iter().any(|n| n.contains("dB allowed")));
    let (plain, plain_drop) = encode("max-drop=0.5dB", "allocate = false");
    println!("{loose} bytes with measured steps, {plain} without");
    assert!(plain_drop <= 0.5 && 100 * loose < 98 * plain, "{loose} bytes with measured steps, {plain} without");
    let (sized, _) = encode(&format!("max-size={}MB", loose as f64 / 1e6), "");
    assert!(sized <= loose);
    let bounded = format!("max-size={}MB", tight as f64 / 1e6);
    // A bound is one of the whole file.
    let rest = |bytes: u64| {
        let of_file = move |streams: &[Stream], _: Option<(&[WeightArray], f64)>| Ok(bytes + streams.iter().map(|s| s.bytes.len() as u64).sum::<u64>());
        let codec = (plugin.build)(&bounded, &toml::Table::new()).unwrap();
        codec.encode(&g, &CodecContext { file_bytes: Some(&of_file), ..context }).map(|streams| streams.iter().map(|s| s.bytes.len()).sum::<usize>())
    };
    let beside = tight as u64 / 4;
    assert!(rest(beside).unwrap() + (beside as usize) <= tight);
    let message = rest(tight as u64).unwrap_err().to_string();
    assert!(message.contains("weights of the deformer") && message.contains("--field-weights"), "{message}");
}

#[test]
fn a_loss_is_measured_on_the_views_that_judge() {
    cc4dgs_codecs::link();
    let g = scene(300);
    let (views, notes) = (recorded(&g), Notes::default());
    let (training, judges) = (OfSplit { views: &views, judges: false }, OfSplit { views: &views, judges: true });
    let context = CodecContext {
        views: Some(&training),
        judges: Some(&judges),
        renderer: Some(&Blots),
        dynamic_threshold: Some(f32::NEG_INFINITY),
        ..CodecContext::new(Seed::root(1), Limits::default(), &notes)
    };
    let codec = (Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap().build)("max-drop=0.5dB", &toml::Table::new()).unwrap();
    codec.encode(&g, &context).unwrap();
    let said = notes.0.lock().unwrap();
    assert!(said.iter().any(|note| note.contains("dB lower on 4 validation views (0.5 dB allowed)")), "{said:?}");
}

/// Views without images, as those of an orbit.
struct Cameras(Views);

impl TrainingViews for Cameras {
    fn len(&self) -> usize {
        self.0.len()
    }
    fn kind(&self) -> &'static str {
        "orbit"
    }
    fn has_images(&self) -> bool {
        false
    }
    fn view(&self, index: usize) -> (&Camera, f32) {
        self.0.view(index)
    }
    fn image(&self, _: usize) -> Result<Image8> {
        panic!("nothing was recorded")
    }
}

#[test]
fn without_images_the_difference_between_renders_is_what_was_asked_for() {
    cc4dgs_codecs::link();
    let (g, notes) = (scene(400), Notes::default());
    let views = Cameras(recorded(&g));
    let context = CodecContext {
        views: Some(&views),
        renderer: Some(&Blots),
        dynamic_threshold: Some(f32::NEG_INFINITY),
        ..CodecContext::new(Seed::root(1), Limits::default(), &notes)
    };
    let encode = |profile: &str| -> Result<(usize, f64)> {
        let codec = (Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap().build)(profile, &toml::Table::new()).unwrap();
        let streams = codec.encode(&g, &context)?;
        let found = codec.decode(&streams, &CodecContext::new(Seed::root(1), Limits::default(), &Silent))?;
        let (mut error, mut samples) = (0.0, 0);
        for (camera, time, _) in &views.0.0 {
            let [before, after] = [&g, &found].map(|g| Blots.render(g, camera, *time).unwrap().planes);
            error += before.iter().zip(&after).take(3 * SIZE * SIZE).map(|(a, b)| f64::from(a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).powi(2)).sum::<f64>();
            samples += 3 * SIZE * SIZE;
        }
        Ok((streams.iter().map(|s| s.bytes.len()).sum::<usize>(), -10.0 * (error / f64::from(samples as u32)).log10()))
    };
    // Without a profile it is 50 dB.
    let [fine, usual, coarse] = ["psnr=60dB", "", "psnr=40dB"].map(|profile| encode(profile).unwrap());
    for ((bytes, reached), wanted) in [(fine, 60.0), (usual, 50.0), (coarse, 40.0)] {
        // So few Gaussians have leaps between neighbouring steps.
        assert!((wanted..wanted + 2.0).contains(&reached), "{bytes} bytes, {reached} dB in place of {wanted}");
    }
    assert!(coarse.0 < usual.0 && usual.0 < fine.0, "{coarse:?}, {usual:?}, {fine:?}");
    assert!(notes.0.lock().unwrap().iter().any(|n| n.contains("before and after on 4 orbit views (40.00 dB wanted")));
    // What shows nothing has no differences.
    let faint = HostGaussians { opacity_logits: vec![-40.0; g.len()], ..g.clone() };
    let codec = (Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap().build)("psnr=50dB", &toml::Table::new()).unwrap();
    let refused = codec.encode(&faint, &context).unwrap_err().to_string();
    assert!(refused.contains("4 orbit views show nothing") && refused.contains("max-size"), "{refused}");
    // A loss needs images.
    let refused = encode("max-drop=0.05dB").unwrap_err().to_string();
    assert!(refused.starts_with("codec compact.max_drop_db") && refused.contains("--scene"), "{refused}");
}

#[test]
fn attributes_of_plug_ins_are_rounded_by_what_is_seen() {
    cc4dgs_codecs::link();
    let plugin = Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap();
    // Blots are no ellipsoids, so no axes may be exchanged.
    let codec = (plugin.build)("max-drop=0.05dB", &toml::Table::from_iter([("canonical".into(), false.into())])).unwrap();
    let plain = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
    let bytes = |streams: &[Stream]| streams.iter().filter(|s| s.name.contains("velocity") || s.name == "coded").map(|s| s.bytes.len()).sum::<usize>();
    let count = 600;
    let velocity = ExtraAttribute::exact(2, (0..2 * count).map(|i| 0.2 * draw(i, 90)).collect());
    let moves: Vec<bool> = scene(count).dynamic_scores.iter().map(|s| *s > 0.0).collect();
    let others: Vec<bool> = (0..count).map(|i| i % 3 == 0).collect();
    let stored = |rows: &[bool]| rows.iter().filter(|r| **r).count();
    for (velocity, rows) in [
        (velocity.clone(), &vec![true; count]),
        (velocity.clone().needed_in(moves.clone(), 0.0), &moves),
        (velocity.within(1e-4).needed_in(others.clone(), 0.0), &others),
    ] {
        let mut g = scene(count);
        let tolerance = velocity.tolerance;
        g.extra.insert("velocity".into(), velocity);
        // What is not needed has no effect, as where nothing moves.
        let mut drawn = g.clone();
        drawn.extra.get_mut("velocity").unwrap().values.chunks_exact_mut(2).zip(rows).filter(|(_, r)| !**r).for_each(|(v, _)| v.fill(0.0));
        let views = recorded(&drawn);
        let context = CodecContext { views: Some(&views), renderer: Some(&Blots), deformer: Some(&Blots), dynamic_threshold: Some(0.0), ..plain };
        let streams = codec.encode(&drawn, &context).unwrap();
        let found = codec.decode(&streams, &plain).unwrap();
        let drop = psnr(&drawn, &views) - psnr(&found, &views);
        assert!(drop <= 0.05, "{drop} dB");
        let values = &found.extra["velocity"].values;
        // The order of the rows differs: those that are not needed are counted.
        let without = values.chunks_exact(2).filter(|v| *v == [0.0; 2]).count();
        assert!(without >= count - stored(rows), "{without} rows without velocity, {} are needed", stored(rows));
        println!("{} bytes for {} rows", bytes(&streams), stored(rows));
        match tolerance {
            // 8 bytes per row are exact. Random values are the worst case.
            None => assert!(2 * bytes(&streams) < 8 * stored(rows), "{} bytes for {} rows", bytes(&streams), stored(rows)),
            Some(tolerance) => {
                // Every decoded row is near one of those given.
                let given = &drawn.extra["velocity"].values;
                let near = |v: &[f32]| given.chunks_exact(2).any(|w| (v[0] - w[0]).abs() <= tolerance && (v[1] - w[1]).abs() <= tolerance);
                assert!(values.chunks_exact(2).all(near), "an error over {tolerance}");
            }
        }
        // Without harmonics, as a player reads it first.
        let base: Vec<Stream> = streams.into_iter().filter(|s| s.name != "sh.1").collect();
        assert_eq!(&codec.decode_stage(&base, &plain).unwrap().extra["velocity"].values, values);
    }
}

#[test]
fn attributes_that_no_row_needs_are_stored_where_it_is_not_known_what_moves() {
    cc4dgs_codecs::link();
    let codec = (Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap().build)("", &"max_drop_db = 0.0".parse().unwrap()).unwrap();
    let count = 60;
    let mut g = scene(count);
    let velocity = ExtraAttribute::exact(2, (0..2 * count).map(|i| 0.2 * draw(i, 90)).collect());
    g.extra.insert("velocity".into(), velocity.needed_in(vec![false; count], 0.0));
    let views = recorded(&g);
    let plain = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
    let streams = codec.encode(&g, &CodecContext { views: Some(&views), renderer: Some(&Blots), deformer: Some(&Blots), ..plain }).unwrap();
    let found = codec.decode(&streams, &CodecContext::new(Seed::root(1), Limits::default(), &Silent)).unwrap();
    assert_eq!(found.extra["velocity"].values, vec![0.0; 2 * count]);
}
