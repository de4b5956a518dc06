use super::weights::LAYERS;
use super::*;
use safetensors::tensor::{Dtype, TensorView, serialize};
use std::collections::BTreeMap;

/// Numbers in -1..1 by index.
fn noise(i: usize) -> f32 {
    let h = crate::Seed::root(i as u64).child("lpips").value();
    (h >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

/// A whole weights file with made-up numbers; `linear` is the weight of every channel.
fn synthetic(linear: f32, change: impl Fn(&str, &mut Vec<usize>, &mut Vec<u8>)) -> Vec<u8> {
    let mut arrays: BTreeMap<String, (Vec<usize>, Vec<u8>)> = BTreeMap::new();
    let bytes = |values: &mut dyn Iterator<Item = f32>| values.flat_map(|v| half::f16::from_f32(v).to_le_bytes()).collect::<Vec<u8>>();
    for (layer, (inputs, outputs, kernel, _, _)) in LAYERS.into_iter().enumerate() {
        let count = outputs * inputs * kernel * kernel;
        let scale = (2.0 / (inputs * kernel * kernel) as f32).sqrt();
        arrays.insert(format!("conv{layer}.weight"), (vec![outputs, inputs, kernel, kernel], bytes(&mut (0..count).map(|i| scale * noise(7 * layer + i)))));
        arrays.insert(format!("conv{layer}.bias"), (vec![outputs], bytes(&mut (0..outputs).map(|i| 0.1 * noise(i)))));
        arrays.insert(format!("linear{layer}.weight"), (vec![outputs], bytes(&mut (0..outputs).map(|_| linear))));
    }
    for (name, (shape, data)) in &mut arrays {
        change(name, shape, data);
    }
    let views = arrays.iter().map(|(name, (shape, data))| (name.as_str(), TensorView::new(Dtype::F16, shape.clone(), data).expect("consistent arrays")));
    serialize(views, None).expect("an array list")
}

fn texture(width: usize, height: usize, seed: usize, amount: f32) -> Planes {
    let value = |i: usize| 0.5 + 0.3 * (i as f64 * 0.11).sin() + f64::from(amount * 0.1 * noise(seed + i));
    Planes::new((0..3 * width * height).map(value).collect(), 3, height, width).unwrap()
}

#[test]
fn a_network_of_made_up_weights_behaves_like_a_distance() {
    let lpips = Lpips::from_bytes(&synthetic(0.01, |_, _, _| ())).unwrap();
    let (a, near, far) = (texture(67, 43, 0, 0.0), texture(67, 43, 9, 0.1), texture(67, 43, 9, 1.0));
    let d = |a: &Planes, b: &Planes| lpips.distance(a, b).unwrap();
    assert_eq!(d(&a, &a), 0.0);
    assert!(0.0 < d(&a, &near) && d(&a, &near) < d(&a, &far), "{} {}", d(&a, &near), d(&a, &far));
    assert_eq!(d(&a, &far), d(&far, &a));
    // It is linear in the linear weights.
    let twice = Lpips::from_bytes(&synthetic(0.02, |_, _, _| ())).unwrap();
    assert!((twice.distance(&a, &far).unwrap() / d(&a, &far) - 2.0).abs() < 1e-3);
    assert_ne!(twice.id().xxh3, lpips.id().xxh3);
    // No number of threads changes a bit.
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one.install(|| d(&a, &far)), d(&a, &far));
}

#[test]
fn the_distance_of_a_layer_follows_its_formula() {
    let map = |values: [f32; 4]| Map { channels: 2, height: 1, width: 2, values: values.to_vec() };
    // Feature vectors (3, 4) and (0, 0) against (4, 3) and (2, 0): unit vectors differ by (-0.2, 0.2), and by (-1, 0).
    let got = layer_distance(&map([3.0, 0.0, 4.0, 0.0]), &map([4.0, 2.0, 3.0, 0.0]), &[0.5, 2.0]);
    assert!((got - 0.5 * (0.5 * 0.04 + 2.0 * 0.04 + 0.5)).abs() < 1e-6, "{got}");
}

#[test]
fn the_smallest_image_is_the_documented_one() {
    let lpips = Lpips::from_bytes(&synthetic(0.01, |_, _, _| ())).unwrap();
    let small = |side| lpips.distance(&texture(side, 64, 0, 0.0), &texture(side, 64, 1, 1.0));
    assert!(small(LPIPS_SMALLEST_SIDE).unwrap() > 0.0);
    assert!(small(LPIPS_SMALLEST_SIDE - 1).unwrap_err().to_string().contains("31"));
    let grey = Planes::new(vec![0.5; 64 * 64], 1, 64, 64).unwrap();
    assert!(lpips.distance(&grey, &grey).is_err());
}

#[test]
fn damaged_weights_are_refused_by_name() {
    let said = |bytes: &[u8]| Lpips::from_bytes(bytes).unwrap_err().to_string();
    let whole = synthetic(0.01, |_, _, _| ());
    for cut in [0, 7, 100, whole.len() - 1] {
        assert!(said(&whole[..cut]).contains("safetensors"), "cut at {cut}");
    }
    let transposed = synthetic(0.01, |name, shape, _| {
        if name == "conv1.weight" {
            shape.reverse()
        }
    });
    assert!(said(&transposed).contains("conv1.weight"));
    let infinite = synthetic(0.01, |name, _, data| {
        if name == "linear3.weight" {
            data[..2].copy_from_slice(&half::f16::INFINITY.to_le_bytes())
        }
    });
    assert!(said(&infinite).contains("linear3.weight"));
    let empty = serialize(std::iter::empty::<(&str, TensorView)>(), None).unwrap();
    assert!(said(&empty).contains("conv0.weight"));
    assert!(Lpips::read(std::path::Path::new("no/such/file")).is_err());
}

/// Scores of the published packages on the golden images: `tests/fixtures/golden/perceptual.json`, made by `benches/perceptual_reference.py`.
#[test]
fn golden_lpips() {
    let Ok(installed) = installed_lpips() else {
        eprintln!("{}: the golden scores are not compared", installed_lpips().unwrap_err());
        return;
    };
    let (mut compared, mut worst) = (0, 0.0f64);
    crate::metrics::golden::pairs(|name, a, b, expected| {
        let Some(expected) = expected["lpips_alex"].as_f64() else { return };
        let got = installed.network.distance(a, b).unwrap();
        assert!((got - expected).abs() < 1e-4, "{name}: {got} instead of {expected}");
        (compared, worst) = (compared + 1, worst.max((got - expected).abs()));
    });
    eprintln!("{compared} pairs, off by at most {worst:.1e}");
    assert!(compared >= 15, "only {compared} pairs were compared");
}
