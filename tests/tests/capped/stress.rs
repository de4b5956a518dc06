//! Extreme scenes on every device, with poisoned memory, compared with the float64 reference rasterizer.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::bench::random_gaussians;
use cc4dgs_backends::ops::photometric::bce_with_logits_loss;
use cc4dgs_backends::rasterizers::reference::ReferenceRasterizer;
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_backends::{cap_bindings, cap_shared_memory};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Gaussians, HostGaussians, Rasterizer, RenderSettings, Rules, Seed, Splats};
use cc4dgs_tests::{devices, larger, poison};

struct Case {
    name: &'static str,
    gaussians: HostGaussians,
    size: (u32, u32),
    rules: Rules,
    /// Tolerance of the relative error of a gradient.
    tolerance: f64,
}

fn noise(seed: Seed, len: usize) -> Vec<f32> {
    (0..len as u64).map(|k| (seed.index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0).collect()
}

fn changed(count: usize, seed: u64, change: impl Fn(&mut HostGaussians)) -> HostGaussians {
    let mut g = random_gaussians(count, Seed::root(seed));
    let stretch = noise(Seed::root(seed).child("stretch"), 3 * count);
    g.log_scales.iter_mut().zip(stretch).for_each(|(l, s)| *l += 0.5 * s);
    change(&mut g);
    g
}

fn cases() -> Vec<Case> {
    let case = |name, gaussians, size, rules, tolerance| Case { name, gaussians, size, rules, tolerance };
    let fill = |values: &mut Vec<f32>, value: f32| values.fill(value);
    vec![
        case(
            "thousands in one tile",
            changed(3000, 1, |g| {
                g.means.iter_mut().for_each(|v| *v *= 0.02);
                fill(&mut g.log_scales, -4.5);
            }),
            (48, 48),
            Rules::Gsplat099,
            1e-3,
        ),
        case(
            "opaque walls",
            changed(200, 2, |g| {
                g.log_scales.chunks_exact_mut(3).for_each(|s| s.copy_from_slice(&[0.3, 0.0, -0.5]));
                fill(&mut g.opacity_logits, 6.0);
            }),
            (37, 29),
            Rules::Inria,
            1e-3,
        ),
        case(
            "needles",
            changed(300, 3, |g| g.log_scales.chunks_exact_mut(3).for_each(|s| s.copy_from_slice(&[-7.0, -6.0, 0.7]))),
            (64, 40),
            Rules::Gsplat099,
            5e-3,
        ),
        case("everywhere, behind the camera too", changed(500, 4, |g| g.means.iter_mut().for_each(|v| *v *= 6.0)), (41, 23), Rules::Inria, 1e-3),
        case("one pixel", changed(50, 5, |_| {}), (1, 1), Rules::Gsplat099, 1e-3),
        case("a strip", changed(200, 6, |_| {}), (700, 3), Rules::Gsplat0999, 1e-3),
        case("a single Gaussian", changed(1, 7, |g| g.means.fill(0.1)), (33, 33), Rules::Gsplat099, 1e-3),
        case("nothing in sight", changed(20, 8, |g| g.means.iter_mut().for_each(|v| *v -= 100.0)), (20, 20), Rules::Gsplat099, 1e-3),
    ]
}

/// Planes, and gradients of centres, scales, quaternions, opacities and both kinds of coefficients for `upstream`.
fn draw(rasterizer: &dyn Rasterizer, case: &Case, device: &Device, upstream: &[f32]) -> (Vec<f32>, [Vec<f32>; 6]) {
    let (width, height) = case.size;
    let camera = Camera::look_at("stress", (width, height), 1.0, [0.0, 0.0, -7.0], [0.0; 3], [0.0, -1.0, 0.0]);
    let tracked = device.clone().autodiff();
    let mut g = Gaussians::from_host(&case.gaussians, &tracked);
    g.means = g.means.require_grad();
    g.log_scales = g.log_scales.require_grad();
    g.quaternions = g.quaternions.require_grad();
    g.opacity_logits = g.opacity_logits.require_grad();
    g.sh_dc = g.sh_dc.require_grad();
    g.sh_rest = g.sh_rest.require_grad();
    let settings = RenderSettings { rules: case.rules, ..Default::default() };
    let out = rasterizer.render(&Splats::from_gaussians(&g, 3), &camera, &settings).unwrap();
    let shape = [5, height as usize, width as usize];
    let loss = (out.planes.clone() * Tensor::<3>::from_data(TensorData::new(upstream.to_vec(), shape), &tracked)).sum();
    let gradients = loss.backward();
    let host = |t: Option<Tensor<2>>| to_vec(t.expect("a gradient"), "gradient").unwrap();
    let found = [
        host(g.means.grad(&gradients)),
        host(g.log_scales.grad(&gradients)),
        host(g.quaternions.grad(&gradients)),
        to_vec(g.opacity_logits.grad(&gradients).expect("a gradient"), "gradient").unwrap(),
        host(g.sh_dc.grad(&gradients)),
        to_vec(g.sh_rest.grad(&gradients).expect("a gradient"), "gradient").unwrap(),
    ];
    (to_vec(out.planes.inner(), "planes").unwrap(), found)
}

#[test]
fn every_device_draws_the_edges_like_the_reference() {
    let _held = crate::alone();
    let devices = devices();
    for (k, case) in cases().iter().enumerate() {
        let pixels = (case.size.0 * case.size.1) as usize;
        let upstream = noise(Seed::root(90).index(k as u64), 5 * pixels);
        let (truth, _) = draw(&ReferenceRasterizer::default(), case, &Device::flex(), &upstream);
        for (name, device) in &devices {
            poison(device);
            let (planes, _) = draw(&TileRasterizer, case, device, &upstream);
            // A float32 threshold may be decided differently at a few pixels; those get no upstream gradient.
            let mut masked = upstream.clone();
            let mut flipped = 0;
            for i in 0..pixels {
                let worst = (0..4).map(|c| (planes[c * pixels + i] - truth[c * pixels + i]).abs()).fold(0.0, larger);
                if worst > 2e-5 || worst.is_nan() {
                    assert!(worst < 4.0 / 255.0, "{}, {name}: pixel {i} differs by {worst}", case.name);
                    flipped += 1;
                    (0..5).for_each(|c| masked[c * pixels + i] = 0.0);
                }
            }
            assert!(flipped * 20 <= pixels, "{}, {name}: {flipped} of {pixels} pixels differ", case.name);
            let (_, wanted) = draw(&ReferenceRasterizer::default(), case, &Device::flex(), &masked);
            poison(device);
            let (again, found) = draw(&TileRasterizer, case, device, &masked);
            assert!(planes == again, "{}, {name}: two runs differ", case.name);
            for ((column, found), wanted) in ["means", "scales", "quaternions", "opacities", "sh_dc", "sh_rest"].iter().zip(found).zip(wanted) {
                let norm = wanted.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
                let error = found.iter().zip(&wanted).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt();
                assert!(error <= case.tolerance * norm + 1e-5, "{}, {name}, {column}: {error:.2e} of {norm:.2e}", case.name);
            }
        }
    }
}

/// Gaussians in a plane parallel to the image, up to a few millionths: rounding makes their depth order differ between devices.
#[test]
fn near_ties_of_depth_are_drawn_in_one_order() {
    let _held = crate::alone();
    let (width, height) = (48u32, 32u32);
    let camera = Camera::look_at("ties", (width, height), 1.0, [1.7, -2.3, -6.1], [0.1, 0.2, 0.3], [0.1, -1.0, 0.2]);
    let (forward, eye) = (camera.forward_world(), camera.center_world());
    let count = 600;
    let depths = noise(Seed::root(13).child("depth"), count);
    let gaussians = changed(count, 13, |g| {
        g.opacity_logits.fill(1.0);
        g.log_scales.fill(-2.0);
        for (mean, depth) in g.means.chunks_exact_mut(3).zip(&depths) {
            let away: f64 = (0..3).map(|k| forward[k] * (f64::from(mean[k]) - eye[k])).sum();
            (0..3).for_each(|k| mean[k] += (forward[k] * (6.7 + 3e-6 * f64::from(*depth) - away)) as f32);
        }
    });
    let draw = |rasterizer: &dyn Rasterizer, device: &Device| {
        let g = Gaussians::from_host(&gaussians, device);
        to_vec(rasterizer.render(&Splats::from_gaussians(&g, 3), &camera, &RenderSettings::default()).unwrap().image(), "image").unwrap()
    };
    let truth = draw(&ReferenceRasterizer::default(), &Device::flex());
    for (name, device) in devices() {
        let found = draw(&TileRasterizer, &device);
        let worst = found.iter().zip(&truth).map(|(a, b)| (a - b).abs()).fold(0.0f32, larger);
        assert!(worst < 0.5 / 255.0, "{name}: a value differs by {} levels", worst * 255.0);
    }
}

/// Adapters may limit a buffer binding to 128 MiB and shared memory to 16 KiB. Here the binding is limited to 1 MiB, so that 10,000 Gaussians exceed it as a
/// million would.
#[test]
fn small_adapters_change_nothing_or_are_an_error() {
    let _held = crate::alone();
    let case = |count| Case {
        name: "small adapter",
        gaussians: changed(count, 11, |g| g.log_scales.fill(-4.5)),
        size: (64, 48),
        rules: Rules::Gsplat099,
        tolerance: 1e-3,
    };
    let upstream = noise(Seed::root(91), 5 * 64 * 48);
    for (name, device) in devices().into_iter().filter(|(name, _)| *name == "wgpu") {
        let whole = draw(&TileRasterizer, &case(10_000), &device, &upstream);
        cap_bindings(1 << 20);
        let parts = draw(&TileRasterizer, &case(10_000), &device, &upstream);
        let many = Gaussians::from_host(&case(20_000).gaussians, &device);
        let camera = Camera::look_at("stress", (64, 48), 1.0, [0.0, 0.0, -7.0], [0.0; 3], [0.0, -1.0, 0.0]);
        let refused = TileRasterizer.render(&Splats::from_gaussians(&many, 3), &camera, &RenderSettings::default());
        // 300 x 200 pixels have 5 planes of 240,000 bytes.
        let wide = Camera::look_at("wide", (300, 200), 1.0, [0.0, 0.0, -7.0], [0.0; 3], [0.0, -1.0, 0.0]);
        let few = Gaussians::from_host(&case(10).gaussians, &device);
        let too_wide = TileRasterizer.render(&Splats::from_gaussians(&few, 3), &wide, &RenderSettings::default());
        let masked = bce_with_logits_loss(Tensor::zeros([5, 200, 300], &device), Tensor::zeros([200, 300], &device));
        cap_bindings(u64::MAX);
        for (what, refused) in [("render", too_wide.map(|_| ())), ("score loss", masked.map(|_| ()))] {
            let message = refused.expect_err("60,000 pixels need more").to_string();
            assert!(message.contains(what) && message.contains("60000") && message.contains("pixels"), "{name}: {message}");
        }
        assert!(whole == parts, "{name}: images or gradients differ");
        cap_shared_memory(16 << 10);
        let (image, gradients) = draw(&TileRasterizer, &case(10_000), &device, &upstream);
        cap_shared_memory(u64::MAX);
        assert!(whole.0 == image, "{name}: images differ with less shared memory");
        for (k, (whole, small)) in whole.1.iter().zip(&gradients).enumerate() {
            let scale = whole.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            // The sums over the pixels of a tile have another order.
            let worst = whole.iter().zip(small).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
            // The rotation gradient of round Gaussians is zero up to rounding.
            assert!(worst < 1e-5 * scale + 1e-7, "{name}: gradient {k} differs by {worst:e} of {scale:e} with less shared memory");
        }
        let message = refused.map(|_| ()).expect_err("20,000 Gaussians need more").to_string();
        assert!(message.contains("20000") && message.contains("Gaussians"), "{message}");
    }
}

#[test]
fn capacity_for_pairs_changes_neither_image_nor_gradients_unless_it_is_too_small() {
    let _held = crate::alone();
    let gaussians = changed(800, 12, |_| {});
    let camera = Camera::look_at("stress", (80, 48), 1.0, [0.0, 0.0, -7.0], [0.0; 3], [0.0, -1.0, 0.0]);
    for (name, device) in devices() {
        let mut g = Gaussians::from_host(&gaussians, &device.clone().autodiff());
        g.means = g.means.require_grad();
        let draw = |pair_capacity| {
            poison(&device);
            let settings = RenderSettings { pair_capacity, ..Default::default() };
            let out = TileRasterizer.render(&Splats::from_gaussians(&g, 3), &camera, &settings).unwrap();
            let loss = (out.planes.clone() * out.planes.clone()).sum();
            let gradient = g.means.grad(&loss.backward()).unwrap();
            let numbers = [to_vec(out.planes, "planes").unwrap(), to_vec(gradient, "gradient").unwrap()];
            (numbers.concat(), out.stats.pair_count.unwrap().into_scalar::<i64>() as usize)
        };
        let (exact, count) = draw(None);
        assert!(count > 800 && exact[5 * 80 * 48..].iter().any(|v| *v != 0.0));
        for capacity in [count, count + 1, 3 * count] {
            assert!(draw(Some(capacity)) == (exact.clone(), count), "{name}: capacity of {capacity} for {count} pairs");
        }
        let (less, still) = draw(Some(count / 2));
        // Gradients are of no use then.
        assert!(still == count && less[..5 * 80 * 48].iter().all(|v| v.is_finite()));
        if name == "wgpu" {
            assert!(less[..5 * 80 * 48] != exact[..5 * 80 * 48], "half of the pairs cannot draw the same image");
        }
    }
}

/// Of the tiles of a footprint's box, pairs are made for those that its ellipse comes near.
#[test]
fn slanted_gaussians_meet_few_of_the_tiles_of_their_boxes() {
    let _held = crate::alone();
    const SIDE: usize = 512;
    // Turned by 45 degrees about the view direction, with a box of more tiles than there are cells; wide enough that terms of sigma do not cancel.
    let (sin, cos) = (std::f32::consts::PI / 8.0).sin_cos();
    let slanted = changed(1, 3, |g| {
        g.means = vec![0.0; 3];
        g.log_scales = vec![0.6, -1.9, -1.9];
        g.quaternions = vec![cos, 0.0, 0.0, sin];
        g.opacity_logits = vec![4.0];
    });
    let camera = Camera::look_at("stress", (SIDE as u32, SIDE as u32), 1.0, [0.0, 0.0, -7.0], [0.0; 3], [0.0, -1.0, 0.0]);
    let mut drawn: Vec<Vec<f32>> = Vec::new();
    for (name, device) in devices() {
        let splats = Splats::from_gaussians(&Gaussians::from_host(&slanted, &device), 0);
        let out = TileRasterizer.render(&splats, &camera, &RenderSettings::default()).unwrap();
        let alpha = to_vec(out.planes, "planes").unwrap()[3 * SIDE * SIDE..4 * SIDE * SIDE].to_vec();
        let covered: Vec<usize> = (0..alpha.len()).filter(|&pixel| alpha[pixel] > 0.0).collect();
        let tiles = |at: fn(usize) -> usize| {
            let along = || covered.iter().map(|&pixel| at(pixel) / 16);
            along().max().zip(along().min()).map_or(0, |(last, first)| last - first + 1)
        };
        let tiles = tiles(|pixel| pixel % SIDE) * tiles(|pixel| pixel / SIDE);
        let pairs = out.stats.pair_count.unwrap().into_scalar::<i64>() as usize;
        assert!(tiles > 100, "{name}: the box has {tiles} tiles");
        assert!(pairs * 4 < tiles * 3, "{name}: {pairs} pairs for a box of {tiles} tiles");
        let first = drawn.first().unwrap_or(&alpha);
        // At the rim of the ellipse alpha is 1/255 or nothing, as rounding decides; a missing tile would lack more.
        let others = first.iter().zip(&alpha).filter(|(a, b)| (*a - *b).abs() > 1e-4).count();
        assert!(others <= 4, "{name} draws {others} pixels differently from the first device");
        drawn.push(alpha);
    }
}
