//! `life = true` beside any deformer: what lasts moves as without it, what has a life of its own appears and vanishes.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs::{backends as _, deformers as _};
use cc4dgs_backends::ops::life::{HIDDEN, LEAST_FALLOFF, LifeRules, OUTPUTS, WIDTH, lives};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Deformer, DeformerContext, Gaussians, HostGaussians, LIFE_ATTRIBUTES, LIFE_GATE_STEEPNESS, Offsets, Registry, Seed, SpatialInput, gate_value,
};
use cc4dgs_tests::{devices, poison};

const COUNT: usize = 40;

fn build(registry: &Registry, kind: &str, life: bool, device: &Device) -> cc4dgs_core::Result<Box<dyn Deformer>> {
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 30, sh_degree: 1, seed: Seed::root(5) };
    let mut section = toml::Table::new();
    section.insert("kind".into(), kind.into());
    section.insert("life".into(), life.into());
    registry.build_deformer(&section, &context, device)
}

fn centres(device: &Device) -> Tensor<2> {
    let values: Vec<f32> = (0..3 * COUNT).map(|k| (k as f32 * 0.37).sin() * 0.9).collect();
    Tensor::<1>::from_floats(values.as_slice(), device).reshape([COUNT, 3])
}

fn offsets(field: &dyn Deformer, input: &SpatialInput, time: f32) -> Offsets {
    field.deform(field.packed(field.spatial(input).unwrap().values), time).unwrap()
}

/// The weights are made to matter: most fields start as the identity.
fn disturb(field: &mut dyn Deformer) {
    for parameter in field.parameters_mut() {
        let [n] = parameter.value.dims();
        let noise: Vec<f32> = (0..n).map(|k| ((k as f32 + 1.0) * 0.618).sin() * 0.05).collect();
        parameter.value = parameter.value.clone() + Tensor::<1>::from_floats(noise.as_slice(), &parameter.value.device());
    }
}

#[test]
fn what_lasts_is_moved_by_the_deformer_alone() {
    let (registry, device) = (Registry::collect().unwrap(), Device::flex());
    let kinds: Vec<&str> = registry.plugins().into_iter().filter(|(kind, _)| *kind == "deformer").map(|(_, plugin)| plugin.name).collect();
    assert!(kinds.len() >= 9, "{kinds:?}");
    for kind in kinds {
        let mut plain = build(&registry, kind, false, &device).unwrap();
        let Ok(mut with) = build(&registry, kind, true, &device) else {
            // They have velocities of their own.
            assert!(["free-time", "native-4d"].contains(&kind), "{kind}");
            continue;
        };
        disturb(plain.as_mut());
        disturb(with.as_mut());
        let input = SpatialInput::at_start(centres(&device), with.as_ref());
        let own = SpatialInput { attributes: input.attributes[..plain.attributes().len()].to_vec(), ..input.clone() };
        for time in [0.0, 0.3, 1.0] {
            let got = offsets(with.as_ref(), &input, time);
            assert!(to_vec(got.opacity_log_factor.unwrap(), "f").unwrap().iter().all(|f| f.abs() < 1.0), "{kind}");
            let got = to_vec(got.means.unwrap(), "means").unwrap();
            if plain.is_static() {
                assert!(got.iter().all(|v| *v == 0.0), "{kind}");
            } else if let Some(means) = offsets(plain.as_ref(), &own, time).means {
                // Playback's layout of coefficients sums in another order.
                let expected = to_vec(means, "means").unwrap();
                assert!(got.iter().zip(&expected).all(|(a, b)| (a - b).abs() <= 1e-5), "{kind} at {time}: {got:?} {expected:?}");
            }
        }
    }
}

#[test]
fn what_has_a_life_moves_and_vanishes() {
    let (registry, device) = (Registry::collect().unwrap(), Device::flex());
    let field = build(&registry, "cdf-basis", true, &device).unwrap();
    let mut input = SpatialInput::at_start(centres(&device), field.as_ref());
    let column = |values: f32, width: usize| Tensor::<2>::full([COUNT, width], values, &device);
    input.attributes = vec![column(0.5, 1), column(0.1f32.ln(), 1), column(0.05f32.ln(), 1), column(gate_value(0.0), 1), column(2.0, 3)];
    let there = offsets(field.as_ref(), &input, 0.55);
    assert!(to_vec(there.means.unwrap(), "means").unwrap().iter().all(|v| (v - 0.1).abs() < 1e-3));
    assert!(to_vec(there.opacity_log_factor.unwrap(), "f").unwrap().iter().all(|f| f.abs() < 1e-3));
    let gone = offsets(field.as_ref(), &input, 0.9);
    assert!(to_vec(gone.opacity_log_factor.unwrap(), "f").unwrap().iter().all(|f| *f < -20.0));
}

#[test]
fn settings_are_read_and_refused() {
    let (registry, device) = (Registry::collect().unwrap(), Device::flex());
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 30, sh_degree: 1, seed: Seed::root(5) };
    let attributes = |text: &str| {
        let section = toml::from_str::<toml::Table>(&format!("kind = 'none'\n{text}")).unwrap();
        registry.build_deformer(&section, &context, &device).map(|field| field.attributes())
    };
    assert!(attributes("").unwrap().is_empty() && attributes("life = false").unwrap().is_empty());
    assert_eq!(attributes("life = true").unwrap().len(), LIFE_ATTRIBUTES.len());
    assert_eq!(attributes("life = { half_width = 0.2 }").unwrap()[1].start, 0.2f32.ln());
    for bad in ["life = 3", "life = { half_width = -1.0 }", "life = { width = 1.0 }"] {
        let error = attributes(bad).expect_err(bad).to_string();
        assert!(error.contains("life") || error.contains("lives"), "{error}");
    }
}

/// The formula in float64, from attributes and a time: shift and logarithm of the factor.
fn formula(a: &[f64], time: f64, rules: &LifeRules) -> [f64; 4] {
    let gate = 1.0 / (1.0 + (-f64::from(LIFE_GATE_STEEPNESS) * a[3]).exp());
    let since = time - a[0];
    let falloff = a[2].exp().max(f64::from(LEAST_FALLOFF));
    let in_falloffs = (since.abs() - a[1].exp()).max(0.0) / falloff;
    let factor = gate + (1.0 - gate) * (-(in_falloffs * in_falloffs).min(30.0)).exp();
    let moving = if rules.gated_velocity { 1.0 - gate } else { 1.0 };
    let log_factor = if factor < f64::from(rules.hidden_below) { f64::from(HIDDEN) } else { factor.ln() };
    [a[4] * since * moving, a[5] * since * moving, a[6] * since * moving, log_factor]
}

#[test]
fn values_and_gradients_are_those_of_the_formula() {
    const ROWS: usize = 700;
    let noise = |seed: u64, k: usize| (Seed::root(seed).index(k as u64).value() >> 40) as f64 / (1u64 << 23) as f64 - 1.0;
    let mut attributes = Vec::new();
    for row in 0..ROWS {
        let [c, r, s, g] = [1, 2, 3, 4].map(|seed| noise(seed, row));
        // Half-widths of 0.02 to 0.4, falloffs of 0.0005 (below the least) to 0.5; gates from shut to open.
        attributes.extend([0.5 + 0.7 * c, -2.4 + 1.5 * r, -4.2 + 3.5 * s, 0.35 * g]);
        attributes.extend([5, 6, 7].map(|seed| 2.0 * noise(seed, row)));
    }
    let attributes: Vec<f32> = attributes.into_iter().map(|v| v as f32).collect();
    for (gated_velocity, hidden_below) in [(false, 0.01), (true, 0.01), (true, 0.0)] {
        let rules = LifeRules { times_norm: vec![0.0, 0.31, 0.5, 1.0], hidden_below, gated_velocity };
        let upstream: Vec<f32> = (0..rules.times_norm.len() * OUTPUTS * ROWS).map(|k| noise(8, k) as f32).collect();
        let weight = |time: usize, row: usize, output: usize| {
            let base = time * OUTPUTS * ROWS;
            f64::from(if output < 3 { upstream[base + 3 * row + output] } else { upstream[base + 3 * ROWS + row] })
        };
        for (name, device) in devices() {
            poison(&device);
            let device = device.autodiff();
            let input = Tensor::<2>::from_data(TensorData::new(attributes.clone(), [ROWS, WIDTH]), &device).require_grad();
            let found = lives(input.clone(), rules.clone()).unwrap();
            let flat = Tensor::cat(found.iter().flat_map(|at| [at.shift.clone().reshape([3 * ROWS]), at.log_factor.clone()]).collect(), 0);
            let weights = Tensor::<1>::from_data(TensorData::new(upstream.clone(), [upstream.len()]), &device);
            let gradients = (flat.clone() * weights).sum().backward();
            let gradient = to_vec(input.grad(&gradients).unwrap(), "gradient").unwrap();
            let values = to_vec(flat.inner(), "values").unwrap();
            let (mut compared, mut moving) = (0, 0);
            for row in 0..ROWS {
                let own: Vec<f64> = attributes[WIDTH * row..][..WIDTH].iter().map(|v| f64::from(*v)).collect();
                let loss = |a: &[f64]| -> f64 {
                    let at =
                        |(k, time): (usize, &f32)| formula(a, f64::from(*time), &rules).iter().enumerate().map(|(o, v)| v * weight(k, row, o)).sum::<f64>();
                    rules.times_norm.iter().enumerate().map(at).sum()
                };
                for (k, time) in rules.times_norm.iter().enumerate() {
                    let wanted = formula(&own, f64::from(*time), &rules);
                    let base = k * OUTPUTS * ROWS;
                    for (output, wanted) in wanted.into_iter().enumerate() {
                        let value = f64::from(if output < 3 { values[base + 3 * row + output] } else { values[base + 3 * ROWS + row] });
                        // A factor at the threshold may be hidden or not.
                        let at_threshold = output == 3 && (wanted.exp() - f64::from(hidden_below)).abs() < 1e-5;
                        assert!(
                            at_threshold || (value - wanted).abs() < 3e-5 * wanted.abs().max(1.0),
                            "{name}: row {row}, time {time}, output {output}: {value} {wanted}"
                        );
                    }
                }
                for k in 0..WIDTH {
                    let shifted = |by: f64| {
                        let mut a = own.clone();
                        a[k] += by;
                        loss(&a)
                    };
                    // Two step sizes agree where the formula has no corner or threshold between them.
                    let [wide, narrow] = [1e-5, 1e-6].map(|h| (shifted(h) - shifted(-h)) / (2.0 * h));
                    if (wide - narrow).abs() > 1e-4 * narrow.abs().max(1.0) {
                        continue;
                    }
                    let got = f64::from(gradient[WIDTH * row + k]);
                    assert!((got - narrow).abs() < 2e-3 * narrow.abs().max(1.0), "{name}: row {row}, attribute {k}: {got} {narrow}");
                    compared += 1;
                    moving += usize::from(narrow.abs() > 0.01);
                }
            }
            assert!(compared > 6 * ROWS && moving > 3 * ROWS, "{name}: {compared} compared, {moving} not zero");
        }
    }
}

#[test]
fn what_lasts_has_a_gradient_of_its_gate_alone() {
    // Outside of the half-width and not hidden at both times. The second gate, of the logit 16, is 1e-7 below 1.
    let row = |gate: f32| [0.5, 0.1f32.ln(), 0.2f32.ln(), gate, 0.3, -0.2, 0.1];
    let attributes = [row(gate_value(1.0)), row(0.8)].concat();
    for (name, device) in devices() {
        for gated_velocity in [false, true] {
            poison(&device);
            let device = device.clone().autodiff();
            let rules = LifeRules { times_norm: vec![0.1, 0.8], hidden_below: 0.01, gated_velocity };
            let input = Tensor::<2>::from_data(TensorData::new(attributes.clone(), [2, WIDTH]), &device).require_grad();
            let found = lives(input.clone(), rules).unwrap();
            let sum = found.into_iter().map(|at| at.shift.sum() + at.log_factor.sum()).reduce(|a, b| a + b).unwrap();
            let gradient = to_vec(input.grad(&sum.backward()).unwrap(), "gradient").unwrap();
            let (lasting, other) = gradient.split_at(WIDTH);
            assert!(lasting[3] != 0.0 && other.iter().all(|g| g.is_finite() && *g != 0.0), "{name}: {gradient:?}");
            assert!(lasting[1..3].iter().all(|g| *g == 0.0), "{name}: {gradient:?}");
            // A velocity that no gate multiplies moves what lasts, too.
            let of_motion = [lasting[0], lasting[4], lasting[5], lasting[6]];
            assert!(of_motion.iter().all(|g| (*g == 0.0) == gated_velocity), "{name}: {gradient:?}");
        }
    }
}

/// A gate that is NaN must not look like a hidden Gaussian, nor bounds of a half-width or a falloff that is NaN make one of it that is there at all times: the
/// watchdog of a training looks at offsets.
#[test]
fn a_life_that_is_nan_stays_nan() {
    let row = |gate: f32, log_width: f32, log_falloff: f32| [0.5, log_width, log_falloff, gate, 0.3, -0.2, 0.1];
    let (width, falloff) = (0.1f32.ln(), 0.2f32.ln());
    let attributes =
        [row(0.1, width, falloff), row(f32::NAN, width, falloff), row(0.2, width, falloff), row(0.1, f32::NAN, falloff), row(0.1, width, f32::NAN)];
    let (count, attributes) = (attributes.len(), attributes.concat());
    for (name, device) in devices() {
        for (gated_velocity, hidden_below) in [(false, 0.01), (true, 0.01), (true, 0.0)] {
            poison(&device);
            let rules = LifeRules { times_norm: vec![0.5, 0.9], hidden_below, gated_velocity };
            let input = Tensor::<2>::from_data(TensorData::new(attributes.clone(), [count, WIDTH]), &device);
            for at in lives(input, rules).unwrap() {
                let (factors, shifts) = (to_vec(at.log_factor, "factors").unwrap(), to_vec(at.shift, "shifts").unwrap());
                let is_nan: Vec<bool> = factors.iter().map(|factor| factor.is_nan()).collect();
                assert!(is_nan == [false, true, false, true, true] && factors[0].is_finite() && factors[2].is_finite(), "{name}: {factors:?}");
                assert!(shifts[3..6].iter().all(|shift| shift.is_nan() == gated_velocity), "{name}: {shifts:?}");
            }
        }
    }
}

#[test]
fn lives_of_another_shape_are_refused() {
    let device = Device::flex();
    let rules = |time| LifeRules { times_norm: vec![time], hidden_below: 0.01, gated_velocity: false };
    for (rows, columns, time) in [(0, WIDTH, 0.5), (2, WIDTH + 1, 0.5), (2, WIDTH, f32::NAN)] {
        assert!(lives(Tensor::zeros([rows, columns], &device), rules(time)).is_err());
    }
}

#[test]
fn fading_multiplies_the_opacity() {
    for (name, device) in devices() {
        let (logits, factors) = ([-90.0f32, -3.0, 0.0, 4.0, 20.0, 90.0], [0.0f32, -1e-3, -1.0, -30.0]);
        for factor in factors {
            let count = logits.len();
            let mut host = HostGaussians { means: vec![0.0; 3 * count], log_scales: vec![0.0; 3 * count], sh_dc: vec![0.0; 3 * count], ..Default::default() };
            (host.opacity_logits, host.quaternions, host.dynamic_scores) = (logits.to_vec(), [1.0, 0.0, 0.0, 0.0].repeat(count), vec![0.0; count]);
            let offsets = Offsets { opacity_log_factor: Some(Tensor::from_floats([factor].repeat(count).as_slice(), &device)), ..Offsets::default() };
            let faded = offsets.apply("test", &Gaussians::from_host(&host, &device), None).unwrap().to_host().unwrap();
            for (before, after) in logits.iter().zip(&faded.opacity_logits) {
                let opacity = |logit: f32| 1.0 / (1.0 + (-f64::from(logit)).exp());
                let (wanted, got) = (opacity(*before) * f64::from(factor).exp(), opacity(*after));
                assert!((got - wanted).abs() <= 1e-5 * wanted + 1e-7, "{name}: logit {before}, factor {factor}: {got} {wanted}");
            }
        }
    }
}
