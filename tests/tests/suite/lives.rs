//! `life = true` beside any deformer: what lasts moves as without it, what has a life of its own appears and vanishes.

use burn::tensor::{Device, Tensor};
use cc4dgs::{backends as _, deformers as _};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, DeformerContext, Offsets, Registry, Seed, SpatialInput, gate_value};

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
