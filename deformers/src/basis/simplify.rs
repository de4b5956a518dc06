//! Drops functions of time that a trained deformer hardly uses, and heads without effect: fewer bytes to store and fewer coefficients to read per frame.
//!
//! A function's part in a head's offsets is measured on the Gaussians and times of the scene, not on weights: the root-mean-square of its coefficients
//! times its own. Functions are dropped from the smallest part on, as long as the root-mean-square of all that is dropped stays below a share of that of the
//! head's offsets.

use super::{Basis, NET};
use crate::parts::heads::Head;
use crate::parts::voxels::parameter;
use burn::tensor::Tensor;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, Error, Parameter, Part, Result, Simplified};

/// A head whose offsets have a root-mean-square below this has no effect. The unit is half the diagonal of the box for centres, else 1.
fn negligible(head: Head) -> f64 {
    match head {
        Head::Means => 1e-6,
        Head::LogScales | Head::Quaternions | Head::Opacity | Head::Sh => 1e-4,
    }
}

/// What is kept of a head.
struct Plan {
    head: Head,
    /// Indices into the head's list of functions.
    kept: Vec<usize>,
}

pub(super) fn simplified(field: &Basis, features: Tensor<2>, times: &[f32]) -> Result<Option<Simplified>> {
    let [m, _] = features.dims();
    if field.settings.unused == 0.0 || m == 0 || times.is_empty() {
        return Ok(None);
    }
    let device = features.device();
    let coefficients = if field.trains() { field.coefficients_of(features)? } else { features };
    let values = to_vec(coefficients.inner(), "coefficients")?;
    let mut functions = Vec::with_capacity(times.len());
    for at_time in field.functions_by_head(times, &device)? {
        functions.push(to_vec(at_time.inner(), "functions")?);
    }

    let (mut plans, mut lines) = (Vec::new(), Vec::new());
    let (mut column, mut first) = (0, 0);
    for (&head, &(width, own)) in field.settings.heads.iter().zip(&field.shape.groups) {
        let coefficients = &values[m * column..m * (column + width * own)];
        let effects = effects(coefficients.chunks_exact(own), functions.iter().map(|at| &at[first..first + own]), own);
        let (whole, least) = (effects.iter().sum::<f64>(), negligible(head) * field.scale_of(head));
        let kept = if whole < least * least { Vec::new() } else { keep(&effects, own, whole * field.settings.unused.powi(2)) };
        if kept.is_empty() {
            lines.push(format!("{} has no effect and is dropped", head.name()));
        } else if kept.len() < own {
            lines.push(format!("{} keeps {} of {own} functions", head.name(), kept.len()));
        }
        plans.push(Plan { head, kept });
        column += width * own;
        first += own;
    }
    // A deformer needs at least one head. The trainer handles deformers that move nothing.
    if lines.is_empty() || plans.iter().all(|p| p.kept.is_empty()) {
        return Ok(None);
    }
    let small = rebuilt(field, &plans)?;
    let bytes = |f: &Basis| f.parameters().iter().map(|p| 4 * p.shape.iter().product::<usize>()).sum::<usize>();
    let message = format!("{}; {} bytes of weights become {}", lines.join(", "), bytes(field), bytes(&small));
    Ok(Some(Simplified { settings: small.section.clone(), field: Box::new(small), message }))
}

/// The contribution of each pair of a head's `count` functions to the mean square of its offsets over Gaussians, outputs and times `[count, count]`: mean of c
/// cᵀ times mean of φ φᵀ, entry by entry. The sum over all pairs is the mean square; the sum over pairs of a subset is the mean square of its offsets.
fn effects<'a>(coefficients: impl Iterator<Item = &'a [f32]>, functions: impl Iterator<Item = &'a [f32]>, count: usize) -> Vec<f64> {
    let (of_coefficients, of_functions) = (mean_products(coefficients, count), mean_products(functions, count));
    of_coefficients.iter().zip(&of_functions).map(|(c, f)| c * f).collect()
}

/// The mean over `rows` of the products of each two of their `count` numbers `[count, count]`.
fn mean_products<'a>(rows: impl Iterator<Item = &'a [f32]>, count: usize) -> Vec<f64> {
    let (mut sums, mut wide, mut seen) = (vec![0.0f64; count * count], vec![0.0f64; count], 0u64);
    for row in rows {
        wide.iter_mut().zip(row).for_each(|(wide, v)| *wide = f64::from(*v));
        for (i, (sums, a)) in sums.chunks_exact_mut(count).zip(&wide).enumerate() {
            // The matrix is symmetric.
            sums[i..].iter_mut().zip(&wide[i..]).for_each(|(sum, b)| *sum += a * b);
        }
        seen += 1;
    }
    let mean = |(i, j): (usize, usize)| sums[i.min(j) * count + i.max(j)] / seen.max(1) as f64;
    (0..count * count).map(|k| mean((k / count, k % count))).collect()
}

/// The functions to keep of `count`, so that the offsets of the others have a mean square of at most `allowed`.
fn keep(effects: &[f64], count: usize, allowed: f64) -> Vec<usize> {
    let part = |f: usize| effects[f * count + f];
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|&a, &b| part(a).total_cmp(&part(b)));
    let mut left_out: Vec<usize> = Vec::new();
    let mut square = 0.0;
    for f in order {
        square += part(f) + 2.0 * left_out.iter().map(|&g| effects[f * count + g]).sum::<f64>();
        // False for NaN: nothing is dropped.
        if square <= allowed {
            left_out.push(f);
        } else {
            break;
        }
    }
    (0..count).filter(|f| !left_out.contains(f)).collect()
}

/// The deformer with the planned functions only: the same weights without the columns of the others.
fn rebuilt(field: &Basis, plans: &[Plan]) -> Result<Basis> {
    let left: Vec<(&Plan, &Vec<usize>)> = plans.iter().zip(&field.kept).filter(|(p, _)| !p.kept.is_empty()).collect();
    let mut section = field.section.clone();
    let names: Vec<toml::Value> = left.iter().map(|(p, _)| p.head.name().into()).collect();
    section.insert("heads".into(), names.into());
    let lists = left.iter().map(|(p, own)| {
        let numbers: Vec<toml::Value> = p.kept.iter().map(|&k| (own[k] as i64).into()).collect();
        (p.head.name().to_string(), toml::Value::from(numbers))
    });
    section.insert("kept".into(), toml::Value::Table(lists.collect()));
    let device = field.parameters[0].value.device();
    let mut small = Basis::new(field.kind, &section, &field.context, &device)?;
    for target in &mut small.parameters {
        let missing = || Error::backend(format!("deformer {}", field.kind.name()), format!("it has no weights {}", target.name), "Report this as a defect");
        let source = field.parameters.iter().find(|p| p.name == target.name).ok_or_else(missing)?;
        let of_head = field.settings.heads.iter().position(|h| format!("net.head.{}", h.name()) == target.name);
        *target = match of_head {
            None => Parameter { value: source.value.clone(), ..target.clone() },
            Some(index) => {
                let values = to_vec(source.value.clone(), &source.name)?;
                let kept = head_weights(&values, field.shape.groups[index], field.coefficients.trunk.last().copied().unwrap_or(0), &plans[index].kept);
                parameter(target.name.clone(), Part::Net, NET, kept, &device)
            }
        };
    }
    Ok(small)
}

/// A head's layers without some functions: hidden layers are unchanged, of the last layer's W `[width, outputs x functions]` and b only the kept columns are
/// left.
fn head_weights(values: &[f32], (outputs, own): (usize, usize), width: usize, kept: &[usize]) -> Vec<f32> {
    let first = values.len() - (width + 1) * outputs * own;
    let mut out = values[..first].to_vec();
    for row in values[first..].chunks_exact(outputs * own) {
        for o in 0..outputs {
            out.extend(kept.iter().map(|&f| row[o * own + f]));
        }
    }
    out
}
