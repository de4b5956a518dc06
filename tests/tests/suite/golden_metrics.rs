//! Metrics compared with the values of scikit-image, pytorch-msssim and Inria's code (`golden/metrics.json`), and with their definitions.

use cc4dgs_core::metrics::{Metric, PSNR_CEILING_DB, Planes, Protocol, Rounding, SsimConvention, mean_absolute_error, mean_squared_error, ms_ssim, psnr, ssim};
use cc4dgs_tests::golden::{folder, json};
use serde_json::Value;
use std::path::Path;

fn image(path: &Path) -> Planes {
    let rgb = image::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).to_rgb8();
    let (width, height) = rgb.dimensions();
    Planes::from_image8(&cc4dgs_core::Image8 { width, height, channels: 3, data: rgb.into_raw() }).unwrap()
}

/// A fixed texture with detail at several scales; `shift` moves it.
fn texture(width: usize, height: usize, shift: f64) -> Vec<f32> {
    let value = |i: usize| {
        let (c, y, x) = (i / (width * height), i / width % height, i % width);
        let (x, y) = (x as f64 + shift, y as f64);
        (0.5 + 0.3 * (0.31 * x + 0.17 * y).sin() + 0.15 * (0.9 * y - 0.2 * x * (1.0 + c as f64)).cos()) as f32
    };
    (0..3 * width * height).map(value).collect()
}

#[test]
fn golden_metrics() {
    let (folder, file) = (folder(), json("metrics.json"));
    let pairs = file["pairs"].as_array().unwrap();
    assert!(!pairs.is_empty());
    let mut checked = 0;
    for pair in pairs {
        let (a, b) = (image(&folder.join(pair["a"].as_str().unwrap())), image(&folder.join(pair["b"].as_str().unwrap())));
        let mut check = |key: &str, got: &dyn Fn() -> f64, tolerance: f64| {
            if let Some(expected) = pair.get(key).and_then(Value::as_f64) {
                let got = got();
                assert!((got - expected).abs() <= tolerance, "{} {key}: got {got}, expected {expected}", pair["b"]);
                checked += 1;
            }
        };
        check("mse", &|| mean_squared_error(&a, &b, None).unwrap(), 1e-14);
        check("l1", &|| mean_absolute_error(&a, &b, None).unwrap(), 1e-13);
        check("psnr_skimage", &|| psnr(&a, &b, None).unwrap(), 1e-10);
        check("ssim_skimage", &|| ssim(&a, &b, SsimConvention::Skimage, None).unwrap(), 1e-10);
        check("ssim_pytorch_msssim_f64window", &|| ssim(&a, &b, SsimConvention::Skimage, None).unwrap(), 1e-9);
        check("ssim_inria", &|| ssim(&a, &b, SsimConvention::Inria, None).unwrap(), 1e-10);
        // Inria's own window has float32 weights, which moves the score by up to 1e-6.
        check("ssim_inria_f32window", &|| ssim(&a, &b, SsimConvention::Inria, None).unwrap(), 2e-6);
        check("ms_ssim_pytorch_msssim_f64window", &|| ms_ssim(&a, &b).unwrap(), 1e-9);
    }
    assert!(checked >= 5 * pairs.len(), "only {checked} numbers were compared");
}

#[test]
fn the_eight_bit_protocol_equals_measuring_saved_images() {
    let (width, height) = (40, 30);
    let (a, b) = (texture(width, height, 0.0), texture(width, height, 0.4));
    let saved = |planes: &[f32]| Planes::from_image8(&cc4dgs_core::Image8::from_planes(planes, width as u32, height as u32)).unwrap();
    let metric = Metric::psnr(Rounding::EightBit);
    let got = metric.score(&a, &b, [3, height, width], None).unwrap();
    assert_eq!(got, psnr(&saved(&a), &saved(&b), None).unwrap());
    assert_ne!(got, Metric::psnr(Rounding::Float).score(&a, &b, [3, height, width], None).unwrap());
    let image = |planes: &[f32]| cc4dgs_core::Image8::from_planes(planes, width as u32, height as u32);
    assert_eq!(metric.score_images(&image(&a), &image(&b)).unwrap(), got);
    assert!(metric.masked().score_images(&image(&a), &image(&b)).is_err());
    let metric = Metric::ssim(SsimConvention::Inria, Rounding::EightBit);
    assert_eq!(metric.score(&a, &b, [3, height, width], None).unwrap(), ssim(&saved(&a), &saved(&b), SsimConvention::Inria, None).unwrap());
}

#[test]
fn identical_images_score_the_ceiling_and_one() {
    let a = texture(170, 165, 0.0);
    let shape = [3, 165, 170];
    assert_eq!(Metric::psnr(Rounding::EightBit).score(&a, &a, shape, None).unwrap(), PSNR_CEILING_DB);
    for convention in [SsimConvention::Skimage, SsimConvention::Inria] {
        assert_eq!(Metric::ssim(convention, Rounding::Float).score(&a, &a, shape, None).unwrap(), 1.0);
    }
    assert_eq!(Metric::ms_ssim(Rounding::Float).score(&a, &a, shape, None).unwrap(), 1.0);
}

#[test]
fn masks_choose_the_pixels() {
    let (width, height) = (48, 40);
    let a = texture(width, height, 0.0);
    let mut b = a.clone();
    // Damage the left third of every plane; a mask of the right half must exclude it.
    for (i, v) in b.iter_mut().enumerate() {
        if i % width < width / 3 {
            *v = 1.0 - *v;
        }
    }
    let right: Vec<bool> = (0..width * height).map(|i| i % width >= width / 2).collect();
    let shape = [3, height, width];
    let metric = Metric::psnr(Rounding::Float).masked();
    assert_eq!(metric.score(&a, &b, shape, Some(&right)).unwrap(), PSNR_CEILING_DB);
    let metric = Metric::ssim(SsimConvention::Inria, Rounding::Float).masked();
    assert_eq!(metric.score(&a, &b, shape, Some(&right)).unwrap(), 1.0);
    let left: Vec<bool> = right.iter().map(|k| !k).collect();
    let whole = Metric::ssim(SsimConvention::Inria, Rounding::Float).score(&a, &b, shape, None).unwrap();
    let (l, r) = (metric.score(&a, &b, shape, Some(&left)).unwrap(), metric.score(&a, &b, shape, Some(&right)).unwrap());
    assert!((0.5 * (l + r) - whole).abs() < 1e-12, "the halves must average to the whole");
}

#[test]
fn bad_input_is_an_error() {
    let a = texture(20, 20, 0.0);
    let psnr = Metric::psnr(Rounding::Float);
    assert!(psnr.score(&a, &a[..10], [3, 20, 20], None).is_err());
    assert!(psnr.score(&a, &a, [0, 20, 20], None).is_err());
    assert!(psnr.score(&a, &a, [usize::MAX, 20, 20], None).is_err());
    assert!(psnr.score(&a, &a, [3, 20, 20], Some(&[true; 400])).is_err(), "an unmasked metric takes no mask");
    assert!(psnr.clone().masked().score(&a, &a, [3, 20, 20], Some(&[false; 400])).is_err(), "an empty mask has no mean");
    assert!(psnr.masked().score(&a, &a, [3, 20, 20], Some(&[true; 3])).is_err());
    let mut nan = a.clone();
    nan[7] = f32::NAN;
    assert!(Metric::psnr(Rounding::Float).score(&a, &nan, [3, 20, 20], None).is_err());
    assert!(Metric::ms_ssim(Rounding::Float).score(&a, &a, [3, 20, 20], None).is_err(), "too small for five scales");
    let tiny = Metric::ssim(SsimConvention::Skimage, Rounding::Float);
    assert!(tiny.score(&a[..192], &a[..192], [3, 8, 8], None).is_err());
    assert_eq!(Metric::ssim(SsimConvention::Inria, Rounding::Float).score(&a[..3], &a[..3], [3, 1, 1], None).unwrap(), 1.0);
}

#[test]
fn protocols_survive_json() {
    for metric in [Metric::psnr(Rounding::EightBit), Metric::ssim(SsimConvention::Inria, Rounding::Float).masked(), Metric::ms_ssim(Rounding::EightBit)] {
        let text = serde_json::to_string(&metric).unwrap();
        assert_eq!(&serde_json::from_str::<Protocol>(&text).unwrap(), metric.protocol(), "{text}");
    }
}
