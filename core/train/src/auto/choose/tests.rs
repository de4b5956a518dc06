//! Plans for made-up scenes and machines.

use super::stages::slower;
use super::*;

const MACHINE: Machine = Machine { threads: 2, graphics: false, memory: Some(24_000_000_000) };

fn facts(arrangement: Arrangement) -> Facts {
    Facts {
        arrangement,
        views: 480,
        cameras: 16,
        frames: 30,
        size: [320, 180],
        points: 0,
        transparent: 0.0,
        plain: None,
        mean: Some([0.4, 0.5, 0.6]),
        detail: 0.4,
        moving: Some(0.1),
        occupied: Some(0.2),
        noise: Some(0.001),
        exposure: Some(0.02),
        overlap: None,
    }
}

fn chosen(facts: &Facts, machine: Machine, minutes: f64, deformer: Option<&str>) -> Vec<Choice> {
    choose(facts, machine, minutes, Stated { deformer, ..Default::default() })
}

fn value(choices: &[Choice], key: &str) -> Option<Value> {
    choices.iter().flat_map(|c| &c.settings).find(|(k, _)| *k == key).map(|(_, v)| v.clone())
}

#[test]
fn scenes_get_what_they_need_and_no_more() {
    let dome = chosen(&facts(Arrangement::Dome), MACHINE, 5.0, None);
    assert_eq!((value(&dome, "deformer.kind"), value(&dome, "train.key_frames")), (Some("free-time".into()), Some(3.into())));
    let stated = chosen(&facts(Arrangement::Dome), MACHINE, 5.0, Some(CDF_BASIS));
    assert!(value(&stated, "deformer.kind") == Some("cdf-basis".into()) && value(&stated, "train.key_frames").is_none());
    let on_the_spot = chosen(&Facts { occupied: Some(0.46), ..facts(Arrangement::Dome) }, MACHINE, 5.0, None);
    assert_eq!((value(&on_the_spot, "deformer.kind"), value(&on_the_spot, "train.key_frames")), (Some("cdf-basis".into()), None));
    let long = chosen(&Facts { frames: 3000, ..facts(Arrangement::Dome) }, MACHINE, 5.0, None);
    assert_eq!((value(&long, "deformer.kind"), value(&long, "deformer.width")), (Some("cdf-basis".into()), Some(64.into())));
    let sparse = Facts { cameras: 8, frames: 300, size: [160, 90], ..facts(Arrangement::Dome) };
    assert!(value(&chosen(&sparse, MACHINE, 5.0, None), "train.key_frames").is_none(), "too few points for each");
    let sharp = Facts { size: [320, 180], ..sparse };
    assert_eq!(value(&chosen(&sharp, MACHINE, 20.0, None), "train.key_frames"), Some(9.into()), "37 key frames of 400 points");
    let patient = chosen(&Facts { frames: 3000, ..facts(Arrangement::Dome) }, MACHINE, 25.0, None);
    assert_eq!(value(&patient, "deformer.width"), Some(128.into()));
    assert_eq!(value(&dome, "train.coarse_frames"), Some("first".into()));
    assert!(value(&dome, "appearance.kind").is_none() && value(&dome, "train.mask_threshold").is_none());
    assert_eq!(value(&dome, "render.background"), Some(vec![0.4, 0.5, 0.6].into()));
    let few = chosen(&Facts { cameras: 6, ..facts(Arrangement::Dome) }, MACHINE, 5.0, None);
    let of_overlap = |cameras: usize, seen_by: Option<usize>| {
        let overlap = seen_by.map(|cameras| Overlap { compared: 16, cameras, by_three: 0.9, alone: 0.0, apart: Vec::new() });
        chosen(&Facts { cameras, overlap, ..facts(Arrangement::Dome) }, MACHINE, 5.0, None)
    };
    let decay = |cameras: usize, seen_by: Option<usize>| value(&of_overlap(cameras, seen_by), "density.decay").and_then(|v| v.as_float());
    let cases = [(4, Some(3)), (10, Some(5)), (16, Some(8)), (18, Some(18)), (16, None), (27, Some(12))];
    assert_eq!(cases.map(|(cameras, seen_by)| decay(cameras, seen_by)), [Some(0.02), Some(0.01), Some(0.01), Some(0.005), Some(0.005), None]);
    let why = |seen_by| of_overlap(16, seen_by).into_iter().find(|choice| choice.settings[0].0 == "density.decay").unwrap().reason;
    assert!(why(Some(8)).ends_with("half of what a camera sees is seen by 8 or more of 16 cameras"), "{}", why(Some(8)));
    assert!(why(None).ends_with("images do not need fade"), "all cameras have one pose");
    assert!(value(&few, "train.dropout").is_some() && value(&dome, "train.dropout").is_none());
    let most = |cameras: usize| value(&chosen(&Facts { cameras, ..facts(Arrangement::Dome) }, MACHINE, 10.0, None), "density.max_gaussians");
    assert_eq!([4, 9, 60].map(most), [6500, 22_000, 37_000].map(|n: i64| Some(n.into())));
    let photos = chosen(&Facts { frames: 1, moving: None, noise: None, ..facts(Arrangement::Photos) }, MACHINE, 5.0, None);
    assert_eq!(value(&photos, "deformer.kind"), Some("none".into()));
    let odd = Facts { noise: Some(0.02), exposure: Some(0.2), plain: Some([1.0; 3]), ..facts(Arrangement::OneMovingCamera) };
    let odd = chosen(&odd, MACHINE, 5.0, None);
    assert_eq!((value(&odd, "train.dynamic"), value(&odd, "train.recover")), (Some("all".into()), Some(true.into())));
    let growth = |arrangement, minutes: f64| value(&chosen(&facts(arrangement), MACHINE, minutes, None), "train.image_growth");
    for arrangement in [Arrangement::OneCameraAnywhere, Arrangement::Dome, Arrangement::Rig] {
        assert_eq!((growth(arrangement, 5.0), growth(arrangement, 30.0)), (Some(0.5.into()), Some(0.0.into())));
    }
    // Several cameras have more to learn where there are more frames.
    let of_frames = |arrangement, frames| value(&chosen(&Facts { frames, ..facts(arrangement) }, MACHINE, 10.0, None), "train.image_growth");
    assert_eq!([30, 150].map(|frames| of_frames(Arrangement::Dome, frames)), [0.0, 0.5].map(|growth| Some(growth.into())));
    assert_eq!(of_frames(Arrangement::OneCameraAnywhere, 150), Some(0.0.into()));
    let stored = |minutes: f64, key: &str| value(&chosen(&facts(Arrangement::OneCameraAnywhere), MACHINE, minutes, None), key);
    assert_eq!((stored(5.0, "deformer.kind"), stored(5.0, "deformer.log2_rows")), (Some("hash-basis".into()), Some(13.into())));
    assert_eq!((stored(90.0, "deformer.log2_rows"), stored(90.0, "deformer.cycles")), (Some(15.into()), Some(0.5.into())));
    assert_eq!(value(&odd, "deformer.kind"), Some("cdf-basis".into()));
    let decoded = chosen(&facts(Arrangement::OneCameraAnywhere), MACHINE, 5.0, Some(CDF_BASIS));
    assert_eq!((value(&decoded, "deformer.capacity"), value(&decoded, "deformer.cycles")), (Some("small".into()), Some(0.5.into())));
    assert_eq!(value(&decoded, "deformer.sparsity"), Some(0.0.into()));
    assert_eq!((stored(90.0, "deformer.head_layers"), value(&decoded, "deformer.head_layers")), (Some(0.into()), None));
    let tables = chosen(&facts(Arrangement::Rig), MACHINE, 5.0, Some(HASH_BASIS));
    assert_eq!((value(&tables, "deformer.kind"), value(&tables, "deformer.log2_rows")), (Some("hash-basis".into()), Some(13.into())));
    let other = chosen(&facts(Arrangement::Dome), MACHINE, 5.0, Some("hexplane"));
    assert!(value(&other, "train.key_frames").is_none());
    let large = Facts { size: [800, 800], transparent: 0.8, ..facts(Arrangement::OneCameraAnywhere) };
    let rate = |minutes: f64| value(&chosen(&large, MACHINE, minutes, None), "train.lr.means").and_then(|v| v.as_float()).unwrap();
    assert_eq!((rate(3.0), slower(60_000.0)), (3.2e-4, 0.5));
    assert!(rate(90.0) < 1e-4);
    assert_eq!(super::rate(1.6e-5 * 0.4), Value::Float(6.4e-6));
    assert_eq!(value(&chosen(&facts(Arrangement::OneMovingCamera), MACHINE, 5.0, None), "train.dynamic"), Some("score".into()));
    assert!(value(&odd, "appearance.kind").is_some() && value(&odd, "train.mask_threshold").is_some() && value(&odd, "render.background").is_some());
}

#[test]
fn images_shrink_to_the_time() {
    let options = SceneOptions::default();
    assert!(image_size(&[[320, 180]], &options, MACHINE, 10.0).is_none() && image_size(&[], &options, MACHINE, 10.0).is_none());
    let large = image_size(&[[1920, 1080]], &options, MACHINE, 10.0).unwrap();
    let width = large.settings[0].1.as_integer().unwrap();
    assert!((500..700).contains(&width), "{width}");
    assert_eq!(large.reason, "images of 1920x1080 pixels are too many for 10 minutes on this machine");
    let short = [0.4, 1.0, 1.5].map(|minutes| image_size(&[[1920, 1080]], &options, MACHINE, minutes).unwrap().reason);
    let said = ["0.4 minutes", "1 minute", "1.5 minutes"].map(|time| format!("images of 1920x1080 pixels are too many for {time} on this machine"));
    assert_eq!(short, said);
    let mixed = image_size(&[[320, 180], [1920, 1080], [1920, 1080]], &options, MACHINE, 10.0).unwrap();
    assert_eq!(mixed.settings, large.settings);
    assert_eq!(mixed.reason, format!("{}; 1 of 3 cameras has smaller ones, which are not enlarged", large.reason));
    assert!(image_size(&[[1920, 1080]], &SceneOptions { width: 700, ..options }, MACHINE, 10.0).is_none());
}

#[test]
fn a_stated_number_of_gaussians_is_planned_with() {
    let scene = facts(Arrangement::OneCameraAnywhere);
    let with = |gaussians: f64| choose(&scene, MACHINE, 5.0, Stated { gaussians: Some(gaussians), ..Default::default() });
    assert_eq!(value(&with(60_000.0), "init.count"), Some(60_000.into()));
    let begun = choose(&scene, MACHINE, 5.0, Stated { first: Some(90_000.0), ..Default::default() });
    assert_eq!(value(&begun, "density.max_gaussians"), Some(90_000.into()), "no lower than what a run begins with");
    let rate = |gaussians: f64| value(&with(gaussians), "train.lr.means").and_then(|v| v.as_float()).unwrap();
    assert_eq!((rate(1000.0), rate(60_000.0)), (3.2e-4, 1.6e-4));
}

#[test]
fn short_runs_on_graphics_cards_have_small_fields_and_match_images_with_the_processor() {
    let card = Machine { graphics: true, ..MACHINE };
    let object = Facts { transparent: 0.5, ..facts(Arrangement::OneMovingCamera) };
    for (minutes, small) in [(3.0, true), (30.0, false)] {
        assert_eq!(value(&chosen(&object, card, minutes, None), "deformer.capacity").is_some(), small, "{minutes}");
    }
    let rig = Facts { frames: 300, detail: 0.9, ..facts(Arrangement::Rig) };
    let every = |threads| key_frames(&rig, Machine { threads, ..card }, 3.0, most_gaussians(&rig, card, 3.0));
    // Key frames further apart on fewer threads.
    assert!(every(16).is_some() && every(16) < every(2), "{:?} {:?}", every(16), every(2));
}
