//! Loss, optimizer and network kernels compared with the reference values of `golden/` on every device.

use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::cpu::mlp::{activation, mish};
use cc4dgs_backends::ops::adam::{AdamSettings, GRADIENT_LIMIT, adam_step};
use cc4dgs_backends::ops::field::MishShape;
use cc4dgs_backends::ops::photometric::{bce_with_logits_loss, photometric_loss};
use cc4dgs_core::{OptimizerState, Registry};
use cc4dgs_parts as _;
use cc4dgs_tests::devices;
use cc4dgs_tests::golden::{Fixture, cases, largest_difference, narrow as to_f32, relative_l2, widen};

fn check(what: &str, got: &[f32], want: &[f64], tolerance: f64) {
    let d = relative_l2(&widen(got), want);
    assert!(d < tolerance, "{what}: relative L2 distance {d:.3e}, allowed {tolerance:.1e}");
}

fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().try_to_vec::<f32>().expect("float32")
}

/// `[H, W, C]` of a fixture to planes `[C, H, W]`.
fn planes(fixture: &Fixture, name: &str) -> ([usize; 3], Vec<f64>) {
    let (shape, data) = (fixture.shape(name), fixture.get(name));
    let (h, w, c) = (shape[0], shape[1], shape[2]);
    ([c, h, w], (0..c * h * w).map(|i| data[(i % (h * w)) * c + i / (h * w)]).collect())
}

#[test]
fn golden_ssim_loss() {
    cases("ssim_loss", &["ssim_loss"]).iter().for_each(ssim_loss);
}

fn ssim_loss(fixture: &Fixture) {
    let one = |key: &str| fixture.get(key)[0];
    let (shape, render) = planes(fixture, "in.render");
    let (_, target) = planes(fixture, "in.target");
    for (name, device) in devices() {
        for (lambda_c, loss_key, kind) in [(0.8, "out.loss", "loss"), (0.0, "out.ssim", "ssim")] {
            let grad_key = &format!("grad.{kind}.render");
            // Two more planes, as in a rasterizer's output.
            let mut five = to_f32(&render);
            five.resize(5 * shape[1] * shape[2], 0.25);
            let planes5 = Tensor::<3>::from_data(TensorData::new(five, [5, shape[1], shape[2]]), &device.clone().autodiff()).require_grad();
            let target = Tensor::<3>::from_data(TensorData::new(to_f32(&target), shape), &device);
            let out = photometric_loss(planes5.clone(), target, lambda_c).expect("a loss");
            let numbers = out.numbers().expect("terms");
            let grads = out.loss.clone().backward();
            let grad = values(planes5.grad(&grads).expect("a gradient"));
            let loss = f64::from(values(out.loss)[0]);
            // With lambda_c = 0 the loss is 1 - SSIM, and its gradient is minus that of SSIM.
            let (want, sign) = if lambda_c == 0.0 { (1.0 - one(loss_key), -1.0) } else { (one(loss_key), 1.0) };
            assert!((loss - want).abs() < 1e-5, "{name}: loss {loss} instead of {want}");
            assert!((f64::from(numbers.l1) - one("out.l1")).abs() < 1e-6);
            assert!((f64::from(numbers.ssim) - one("out.ssim")).abs() < 2e-5);
            let mse = render.iter().zip(&target_of(fixture)).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / render.len() as f64;
            assert!((f64::from(numbers.mse) / mse - 1.0).abs() < 1e-5, "{name}: mse {} instead of {mse}", numbers.mse);
            let want: Vec<f64> = planes(fixture, grad_key).1.iter().map(|g| sign * g).collect();
            check(&format!("{} {name} {grad_key}", fixture.name), &grad[..render.len()], &want, fixture.tolerance(&format!("grad_{kind}"), 2e-5).min(2e-4));
            assert!(grad[render.len()..].iter().all(|g| *g == 0.0), "{name}: planes that are not read have a gradient");
        }
    }
}

fn target_of(fixture: &Fixture) -> Vec<f64> {
    planes(fixture, "in.target").1
}

#[test]
fn golden_adam() {
    cases("adam", &["adam", "adam_wide"]).iter().for_each(adam);
}

/// The variants of a fixture of Adam; one that is described by a sentence has a rate per step, in `in.lr_schedule`.
fn adam(fixture: &Fixture) {
    let shape = fixture.shape("in.grads");
    let (steps, n) = (shape[0], shape[1]);
    let variants: Vec<String> = fixture.facts["variants"].as_object().unwrap().keys().cloned().collect();
    assert!(!variants.is_empty());
    let [first, grads] = ["in.p0", "in.grads"].map(|key| fixture.narrow(key));
    for (name, device) in devices() {
        for variant in &variants {
            let stated = &fixture.facts["variants"][variant];
            // A variant that is a sentence follows the schedule with the constants of Adam's paper.
            let scheduled = stated.is_string();
            let number = |value: &serde_json::Value, usual: f64| if scheduled { usual } else { value.as_f64().unwrap() };
            let (beta1, beta2) = (number(&stated["betas"][0], 0.9), number(&stated["betas"][1], 0.999));
            let epsilon = number(&stated["eps"], 1e-15);
            let rates = if scheduled { fixture.get("in.lr_schedule") } else { vec![stated["lr"].as_f64().unwrap(); steps] };
            let vector = |v: &[f32]| Tensor::<1>::from_data(TensorData::new(v.to_vec(), [n]), &device);
            let (mut p, mut m, mut v) = (vector(&first), Tensor::<1>::zeros([n], &device), Tensor::<1>::zeros([n], &device));
            let (mut all_p, mut all_m, mut all_v) = (Vec::new(), Vec::new(), Vec::new());
            for step in 0..steps {
                let grad = vector(&grads[step * n..(step + 1) * n]);
                let settings = AdamSettings { lr: rates[step], beta1, beta2, epsilon, step: step as u64 + 1, visible: None };
                let out = adam_step(p, m, v, grad, &settings).expect("a step");
                (p, m, v) = (out.param, out.m, out.v);
                all_p.extend(values(p.clone()));
                all_m.extend(values(m.clone()));
                all_v.extend(values(v.clone()));
            }
            for (array, short, got) in [("params", "params", &all_p), ("exp_avg", "m", &all_m), ("exp_avg_sq", "v", &all_v)] {
                let want = fixture.get(&format!("{variant}.out.{array}"));
                check(&format!("{} {name} {variant} {short}", fixture.name), got, &want, fixture.tolerance(&format!("{variant}.{array}"), 5e-7));
            }
            // A norm hides one wrong parameter among many.
            let worst = largest_difference(&widen(&all_p), &fixture.get(&format!("{variant}.out.params")));
            let allowed = (10.0 * fixture.number(&["noise_f32", &format!("{variant}.params"), "max_abs"])).min(5e-6);
            assert!(worst <= allowed, "{} {name} {variant}: a parameter is off by {worst:.1e}, allowed {allowed:.1e}", fixture.name);
        }
    }
}

#[test]
fn adam_leaves_invisible_and_broken_rows_alone() {
    for (name, device) in devices() {
        // Enough rows for several tasks of the kernel, odd width; and narrow and wide rows.
        for shape in [[9_002, 5], [302, 3], [302, 17]] {
            for broken in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, GRADIENT_LIMIT, -1e25] {
                leaves_rows_alone(&format!("{name}, {shape:?}, a gradient of {broken}"), &device, shape, broken);
            }
        }
    }
}

fn leaves_rows_alone(what: &str, device: &Device, [rows, width]: [usize; 2], value: f32) {
    let count = rows * width;
    let wave = |k: f32| (0..count).map(|i| (i as f32 * k).sin()).collect::<Vec<f32>>();
    let matrix = |v: &[f32]| Tensor::<2>::from_data(TensorData::new(v.to_vec(), [rows, width]), device);
    let (p0, m0, v0) = (wave(0.3), wave(0.7), wave(0.9).iter().map(|v| v * v).collect::<Vec<_>>());
    let mut g = wave(1.1);
    let visible: Vec<i64> = (0..rows as i64).map(|i| if i % 3 == 0 { 0 } else { i }).collect();
    let broken = [7, rows / 2, rows - 1];
    for (row, column) in broken.into_iter().zip([0, width - 1, 2]) {
        assert!(visible[row] != 0);
        g[row * width + column] = value;
    }
    // Large, and still a gradient.
    g[10 * width] = 0.9 * GRADIENT_LIMIT;
    let mut settings = AdamSettings::new(0.01, 3);
    settings.visible = Some(Tensor::<1, Int>::from_data(TensorData::new(visible.clone(), [rows]), device));
    let out = adam_step(matrix(&p0), matrix(&m0), matrix(&v0), matrix(&g), &settings).expect("a step");
    let (p, m, v) = (values(out.param), values(out.m), values(out.v));
    for (row, &shown) in visible.iter().enumerate() {
        for i in row * width..(row + 1) * width {
            if shown == 0 || broken.contains(&row) {
                assert_eq!((p[i], m[i], v[i]), (p0[i], m0[i], v0[i]), "{what}: row {row} moved");
            } else {
                let (m1, v1) = (0.9 * f64::from(m0[i]) + 0.1 * f64::from(g[i]), 0.999 * f64::from(v0[i]) + 0.001 * f64::from(g[i]).powi(2));
                let step = 0.01 / (1.0 - 0.9f64.powi(3)) * m1 / (v1.sqrt() / (1.0 - 0.999f64.powi(3)).sqrt() + 1e-15);
                assert!((f64::from(p[i]) - (f64::from(p0[i]) - step)).abs() < 1e-6 * (1.0 + step.abs()), "{what}: row {row}");
            }
        }
    }
}

#[test]
fn fresh_rows_of_adam_have_no_momentum_and_a_quarter_of_the_second_moment() {
    let registry = Registry::collect().unwrap();
    for (name, device) in devices() {
        let mut adam = registry.build_optimizer(&"kind = 'adam'".parse().unwrap()).unwrap();
        let matrix = |values: [f32; 6]| Tensor::<2>::from_data(TensorData::new(values.to_vec(), [3, 2]), &device);
        let mut state = OptimizerState::default();
        state.arrays.insert("a/first_moment".into(), matrix([0.5, -0.0, f32::NAN, f32::INFINITY, -2.0, 3.0]));
        state.arrays.insert("a/second_moment".into(), matrix([1.0, 0.3, 2.0, 7.0, 4.0, 1e-30]));
        state.steps.insert("a".into(), 5);
        adam.restore(state).unwrap();
        adam.select_rows("a", &[2, 0, 1, 0], &[false, true, true, false]).unwrap();
        let state = adam.state();
        let bits = |moment: &str| values(state.arrays[moment].clone()).into_iter().map(f32::to_bits).collect::<Vec<_>>();
        assert_eq!(bits("a/first_moment"), [-2.0f32, 3.0, 0.0, 0.0, 0.0, 0.0, 0.5, -0.0].map(f32::to_bits), "{name}");
        assert_eq!(bits("a/second_moment"), [4.0f32, 1e-30, 0.25, 0.25 * 0.3, 0.5, 1.75, 1.0, 0.3].map(f32::to_bits), "{name}");
    }
}

#[test]
fn golden_nn_activations() {
    cases("nn", &["nn", "nn_deep"]).iter().for_each(activations);
}

fn activations(fixture: &Fixture) {
    // A float32 kernel rounds each of a few operations, whatever the reference's own noise.
    let check = |key: &str, noise: &str, got: &[f32]| check(&format!("{} {key}", fixture.name), got, &fixture.get(key), fixture.tolerance(noise, 5e-7));
    let (x, w) = (fixture.narrow("mish.in.x"), fixture.narrow("mish.in.weights"));
    let out: Vec<f32> = x.iter().map(|&x| activation::mish(x)).collect();
    check("mish.out", "mish.out", &out);
    let grad: Vec<f32> = x.iter().zip(w).map(|(&x, w)| activation::mish_derivative(x) * w).collect();
    check("mish.grad.x", "mish.grad.x", &grad);

    let shape = fixture.shape("layernorm.in.x");
    let (rows, n) = (shape[0], shape[1]);
    let mut normalized = fixture.narrow("layernorm.in.x");
    let (gain, shift) = (fixture.narrow("layernorm.in.weight"), fixture.narrow("layernorm.in.bias"));
    let (mut inverse, mut work) = (vec![0.0; rows], vec![0.0; n]);
    activation::normalize_rows(&mut normalized, n, &mut inverse, &mut work);
    let out: Vec<f32> = normalized.iter().enumerate().map(|(i, v)| v * gain[i % n] + shift[i % n]).collect();
    check("layernorm.out", "layernorm.out", &out);
    let mut grad = fixture.narrow("layernorm.in.weights_loss");
    let (mut grad_gain, mut grad_shift) = (vec![0.0; n], vec![0.0; n]);
    activation::layer_norm_backward(&mut grad, &normalized, &inverse, &gain, (&mut grad_gain, &mut grad_shift), &mut work);
    for (key, got) in [("layernorm.grad.x", &grad), ("layernorm.grad.weight", &grad_gain), ("layernorm.grad.bias", &grad_shift)] {
        check(key, key, got);
    }
}

#[test]
fn golden_nn_mlp() {
    cases("nn", &["nn", "nn_deep"]).iter().for_each(mlp);
}

fn mlp(fixture: &Fixture) {
    // Linear, LayerNorm and Mish as often as there are LayerNorms, then Linear. The fixture keeps W as [out, in]; the kernel as [in, out].
    let hidden_layers = (0..).find(|l| !fixture.has(&format!("mlp.in.ln{l}.weight"))).unwrap();
    let width = |l: usize| fixture.shape(&format!("mlp.in.lin{l}.weight"));
    let shape = MishShape { input: width(0)[1], hidden: (0..hidden_layers).map(|l| width(l)[0]).collect(), output: width(hidden_layers)[0] };
    let transposed = |name: &str| {
        let (shape, data) = (fixture.shape(name), fixture.get(name));
        let (out, input) = (shape[0], shape[1]);
        (0..out * input).map(|i| data[(i % out) * input + i / out]).collect::<Vec<f64>>()
    };
    let flat = |prefix: &str| -> Vec<f64> {
        let layer = |l: usize| {
            let (weight, bias) = (transposed(&format!("{prefix}.lin{l}.weight")), fixture.get(&format!("{prefix}.lin{l}.bias")));
            let norm = |what: &str| if l < hidden_layers { fixture.get(&format!("{prefix}.ln{l}.{what}")) } else { Vec::new() };
            [weight, bias, norm("weight"), norm("bias")].concat()
        };
        (0..=hidden_layers).flat_map(layer).collect()
    };
    let weights = to_f32(&flat("mlp.in"));
    assert_eq!(weights.len(), shape.parameter_count());
    let (x, batch) = (fixture.narrow("mlp.in.x"), fixture.shape("mlp.in.x")[0]);
    let rows = |first: usize, out: &mut [f32]| out.copy_from_slice(&x[first * shape.input..][..out.len()]);
    let what = |key: &str| format!("{} {key}", fixture.name);
    let tolerance = |key: &str| fixture.tolerance(key, 1e-6);
    check(&what("mlp.out"), &mish::forward(&shape, &weights, batch, &rows), &fixture.get("mlp.out"), tolerance("mlp.out"));
    let mut grad_x = vec![0.0; x.len()];
    let grad = mish::backward(&shape, &weights, batch, &rows, &fixture.narrow("mlp.in.weights_loss"), Some(&mut grad_x));
    check(&what("x"), &grad_x, &fixture.get("mlp.grad.x"), tolerance("mlp.grad.x"));
    for (l, layer) in shape.layers().iter().enumerate() {
        let (weight, bias) = (format!("mlp.grad.lin{l}.weight"), format!("mlp.grad.lin{l}.bias"));
        check(&what(&weight), &grad[layer.weight.clone()], &transposed(&weight), tolerance(&weight));
        check(&what(&bias), &grad[layer.bias.clone()], &fixture.get(&bias), tolerance(&bias));
    }
    let worst = fixture.facts["noise_f32"].as_object().unwrap().keys().filter(|key| key.starts_with("mlp.grad.")).map(|key| tolerance(key));
    check(&what("all gradients"), &grad, &flat("mlp.grad"), worst.fold(0.0, f64::max));
}

/// The loss by its definition in float64, with two-dimensional windows.
fn plain_loss(x: &[f64], y: &[f64], (c, h, w): (usize, usize, usize), lambda_c: f64) -> f64 {
    let weight = |d: isize| (-(d * d) as f64 / 4.5).exp();
    let norm: f64 = (-5..=5).map(weight).sum();
    let (mut ssim, mut l1) = (0.0, 0.0);
    for ch in 0..c {
        for i in 0..h as isize {
            for j in 0..w as isize {
                let mut m = [0.0f64; 5];
                for di in -5..=5isize {
                    for dj in -5..=5isize {
                        let (r, q) = (i + di, j + dj);
                        if r >= 0 && q >= 0 && r < h as isize && q < w as isize {
                            let at = (ch * h + r as usize) * w + q as usize;
                            let g = weight(di) * weight(dj) / (norm * norm);
                            let (a, b) = (x[at], y[at]);
                            for (m, v) in m.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                                *m += g * v;
                            }
                        }
                    }
                }
                let (sx, sy, sxy) = (m[2] - m[0] * m[0], m[3] - m[1] * m[1], m[4] - m[0] * m[1]);
                ssim += (2.0 * m[0] * m[1] + 1e-4) * (2.0 * sxy + 9e-4) / ((m[0] * m[0] + m[1] * m[1] + 1e-4) * (sx + sy + 9e-4));
                let at = (ch * h + i as usize) * w + j as usize;
                l1 += (x[at] - y[at]).abs();
            }
        }
    }
    let n = (c * h * w) as f64;
    lambda_c * l1 / n + (1.0 - lambda_c) * (1.0 - ssim / n)
}

#[test]
fn photometric_loss_matches_its_definition_at_awkward_sizes() {
    for (h, w) in [(1, 1), (3, 130), (17, 64), (23, 5)] {
        let n = 3 * h * w;
        let x: Vec<f64> = (0..n).map(|i| f64::from((0.5 + 0.4 * (i as f64 * 0.37).sin()) as f32)).collect();
        let y: Vec<f64> = (0..n).map(|i| f64::from((0.5 + 0.4 * (i as f64 * 0.31 + 1.0).cos()) as f32)).collect();
        for (name, device) in devices() {
            let planes = Tensor::<3>::from_data(TensorData::new(to_f32(&x), [3, h, w]), &device.clone().autodiff()).require_grad();
            let target = Tensor::<3>::from_data(TensorData::new(to_f32(&y), [3, h, w]), &device);
            let out = photometric_loss(planes.clone(), target.clone(), 0.6).expect("a loss");
            let untracked = photometric_loss(planes.clone().inner(), target, 0.6).expect("a loss");
            // A factor of the upstream gradient must reach the pixels.
            let grads = (out.loss.clone() * 3.0).backward();
            let grad = values(planes.grad(&grads).expect("a gradient"));
            let loss = values(out.loss)[0];
            assert_eq!(loss, values(untracked.loss)[0], "tracking must not change the value");
            let want = plain_loss(&x, &y, (3, h, w), 0.6);
            assert!((f64::from(loss) - want).abs() < 5e-6, "{name} {h}x{w}: {loss} instead of {want}");
            for at in [0, n / 3, n / 2, n - 1] {
                let mut moved = [x.clone(), x.clone()];
                moved[0][at] += 1e-5;
                moved[1][at] -= 1e-5;
                let slope = 3.0 * (plain_loss(&moved[0], &y, (3, h, w), 0.6) - plain_loss(&moved[1], &y, (3, h, w), 0.6)) / 2e-5;
                assert!((f64::from(grad[at]) - slope).abs() < 2e-3 * slope.abs() + 1e-6, "{name} {h}x{w} pixel {at}: {} instead of {slope}", grad[at]);
            }
        }
    }
}

#[test]
fn photometric_loss_is_right_where_most_of_an_image_is_equal() {
    // Equal but for a box: in the middle, at a corner, one pixel. Kernels may skip what is equal.
    let (h, w) = (30, 41);
    for (rows, columns) in [(12..16, 16..25), (0..3, 36..41), (29..30, 0..1)] {
        let n = 3 * h * w;
        let y: Vec<f64> = (0..n).map(|i| f64::from((0.5 + 0.4 * (i as f64 * 0.31 + 1.0).cos()) as f32)).collect();
        let differs = |i: usize| rows.contains(&(i / w % h)) && columns.contains(&(i % w));
        let x: Vec<f64> = y.iter().enumerate().map(|(i, y)| if differs(i) { f64::from((y + 0.3 * (i as f64).sin()) as f32) } else { *y }).collect();
        let slope = |at: usize| {
            let moved = |by: f64| x.iter().enumerate().map(|(i, x)| if i == at { x + by } else { *x }).collect::<Vec<f64>>();
            (plain_loss(&moved(1e-5), &y, (3, h, w), 0.2) - plain_loss(&moved(-1e-5), &y, (3, h, w), 0.2)) / 2e-5
        };
        let pixels = (0..h).step_by(5).chain([h - 1]).flat_map(|row| (0..w).step_by(6).map(move |column| (h + row) * w + column));
        let slopes: Vec<(usize, f64)> = pixels.map(|at| (at, slope(at))).collect();
        let want = plain_loss(&x, &y, (3, h, w), 0.2);
        for (name, device) in devices() {
            let planes = Tensor::<3>::from_data(TensorData::new(to_f32(&x), [3, h, w]), &device.clone().autodiff()).require_grad();
            let out = photometric_loss(planes.clone(), Tensor::<3>::from_data(TensorData::new(to_f32(&y), [3, h, w]), &device), 0.2).expect("a loss");
            let grad = values(planes.grad(&out.loss.clone().backward()).expect("a gradient"));
            let loss = f64::from(values(out.loss)[0]);
            assert!((loss - want).abs() < 2e-7, "{name} {rows:?} {columns:?}: {loss} instead of {want}");
            for &(at, slope) in &slopes {
                let error = (f64::from(grad[at]) - slope).abs();
                assert!(error < 2e-3 * slope.abs() + 1e-7, "{name} {rows:?} {columns:?} value {at}: {} instead of {slope}", grad[at]);
            }
        }
    }
}

#[test]
fn cross_entropy_is_stable_and_its_gradient_right() {
    for (name, device) in devices() {
        let logits = [-200.0f32, -3.0, -0.5, 0.0, 0.5, 4.0, 200.0, 7.0];
        let mask = [0.0f32, 1.0, 0.0, 1.0, 0.25, 1.0, 0.0, 1.0];
        let planes = Tensor::<3>::from_data(TensorData::new([logits, [9.0; 8]].concat(), [2, 2, 4]), &device.clone().autodiff()).require_grad();
        let loss = bce_with_logits_loss(planes.clone(), Tensor::<2>::from_data(TensorData::new(mask.to_vec(), [2, 4]), &device)).expect("a loss");
        let grads = loss.clone().backward();
        let grad = values(planes.grad(&grads).expect("a gradient"));
        let plain = |x: f64, z: f64| x.max(0.0) - x * z + (-x.abs()).exp().ln_1p();
        let want: f64 = logits.iter().zip(&mask).map(|(&x, &z)| plain(f64::from(x), f64::from(z))).sum::<f64>() / 8.0;
        assert!((f64::from(values(loss)[0]) / want - 1.0).abs() < 1e-6, "{name}");
        for i in 0..8 {
            let slope = (1.0 / (1.0 + (-f64::from(logits[i])).exp()) - f64::from(mask[i])) / 8.0;
            assert!((f64::from(grad[i]) - slope).abs() < 1e-7, "{name} logit {i}");
        }
        assert!(grad[8..].iter().all(|g| *g == 0.0));
    }
}

#[test]
fn losses_and_steps_refuse_what_does_not_fit() {
    let device = Device::flex();
    let image = |c, h, w| Tensor::<3>::zeros([c, h, w], &device);
    assert!(photometric_loss(image(2, 4, 4), image(3, 4, 4), 0.8).is_err());
    assert!(photometric_loss(image(3, 4, 4), image(3, 4, 5), 0.8).is_err());
    assert!(photometric_loss(image(3, 4, 4), image(3, 4, 4), f32::NAN).is_err());
    assert!(bce_with_logits_loss(image(1, 4, 4), Tensor::zeros([4, 3], &device)).is_err());
    let v = |n| Tensor::<1>::zeros([n], &device);
    assert!(adam_step(v(3), v(3), v(2), v(3), &AdamSettings::new(0.1, 1)).is_err());
    assert!(adam_step(v(3), v(3), v(3), v(3), &AdamSettings::new(0.1, 0)).is_err());
    for epsilon in [0.0, 1e-50, -1e-8, f64::INFINITY, f64::NAN] {
        let error = adam_step(v(3), v(3), v(3), v(3), &AdamSettings { epsilon, ..AdamSettings::new(0.1, 1) }).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("epsilon"), "{error}");
    }
    let empty = adam_step(v(0), v(0), v(0), v(0), &AdamSettings::new(0.1, 1)).expect("no rows are fine");
    assert_eq!(empty.param.dims(), [0]);
}
