//! Drops functions of time that a trained deformer hardly uses, and heads without effect: fewer bytes to store and fewer coefficients to read per frame.
//!
//! A function's part in a head's offsets is measured on the scene's own Gaussians and times, not on weights: the root-mean-square of its coefficients times
//! its own. Functions are dropped from the smallest part on, as long as the sum of what is dropped stays below a share of the head's offsets.

use super::{CdfBasis, NET};
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

pub(super) fn simplified(field: &CdfBasis, features: Tensor<2>, times: &[f32]) -> Result<Option<Simplified>> {
    let [m, _] = features.dims();
    if field.settings.unused == 0.0 || m == 0 || times.is_empty() {
        return Ok(None);
    }
    let device = features.device();
    let values = to_vec(features.inner(), "coefficients")?;
    let mut functions = Vec::with_capacity(times.len());
    for at_time in field.functions_by_head(times, &device)? {
        functions.push(to_vec(at_time.inner(), "functions")?);
    }
    let count = field.shape.functions();
    let flat: Vec<f32> = functions.concat();
    let of_functions = mean_squares(&flat, count);

    let (mut plans, mut lines) = (Vec::new(), Vec::new());
    let (mut column, mut first) = (0, 0);
    for (&head, &(width, own)) in field.settings.heads.iter().zip(&field.shape.groups) {
        let coefficients = &values[m * column..m * (column + width * own)];
        // Mean square over Gaussians, outputs and times of c φ, per function.
        let strength = mean_squares(coefficients, own);
        let part = |f: usize| strength[f] * of_functions[first + f];
        let parts: Vec<f64> = (0..own).map(part).collect();
        let whole = combined_square(coefficients, (width, own), &functions, first);
        let scale = field.scale_of(head);
        let kept = if whole.sqrt() < negligible(head) * scale { Vec::new() } else { keep(&parts, whole * field.settings.unused.powi(2)) };
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
    let bytes = |f: &CdfBasis| f.parameters().iter().map(|p| 4 * p.shape.iter().product::<usize>()).sum::<usize>();
    let message = format!("{}; {} bytes of weights become {}", lines.join(", "), bytes(field), bytes(&small));
    Ok(Some(Simplified { settings: small.section.clone(), field: Box::new(small), message }))
}

/// The mean square of every column of rows `[_, columns]`.
fn mean_squares(values: &[f32], columns: usize) -> Vec<f64> {
    let mut sums = vec![0.0f64; columns];
    for row in values.chunks_exact(columns) {
        sums.iter_mut().zip(row).for_each(|(s, v)| *s += f64::from(*v).powi(2));
    }
    let rows = (values.len() / columns).max(1) as f64;
    sums.into_iter().map(|s| s / rows).collect()
}

/// The mean square of a head's offsets, over at most a thousand Gaussians.
fn combined_square(coefficients: &[f32], (width, own): (usize, usize), functions: &[Vec<f32>], first: usize) -> f64 {
    let rows = coefficients.len() / (width * own);
    let (mut sum, mut terms) = (0.0, 0u64);
    for coefficients in coefficients.chunks_exact(width * own).step_by(rows.div_ceil(1000)).flat_map(|row| row.chunks_exact(own)) {
        for phi in functions {
            let offset: f64 = coefficients.iter().zip(&phi[first..first + own]).map(|(c, f)| f64::from(c * f)).sum();
            sum += offset * offset;
            terms += 1;
        }
    }
    sum / terms.max(1) as f64
}

/// The indices to keep so that the parts of the others sum to less than `allowed`.
fn keep(parts: &[f64], allowed: f64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..parts.len()).collect();
    order.sort_by(|&a, &b| parts[a].total_cmp(&parts[b]));
    let mut left_out = 0.0;
    let mut kept: Vec<usize> = order
        .into_iter()
        .filter(|&f| {
            left_out += parts[f];
            left_out > allowed
        })
        .collect();
    kept.sort_unstable();
    kept
}

/// The deformer with the planned functions only: the same weights without the columns of the others.
fn rebuilt(field: &CdfBasis, plans: &[Plan]) -> Result<CdfBasis> {
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
    let mut small = CdfBasis::new(&section, &field.context, &device)?;
    for target in &mut small.parameters {
        let missing = || Error::backend("deformer cdf-basis", format!("it has no weights {}", target.name), "Report this as a defect");
        let source = field.parameters.iter().find(|p| p.name == target.name).ok_or_else(missing)?;
        let of_head = field.settings.heads.iter().position(|h| format!("net.head.{}", h.name()) == target.name);
        *target = match of_head {
            None => Parameter { value: source.value.clone(), ..target.clone() },
            Some(place) => {
                let values = to_vec(source.value.clone(), &source.name)?;
                let kept = head_weights(&values, field.shape.groups[place], field.coefficients.trunk.last().copied().unwrap_or(0), &plans[place].kept);
                parameter(target.name.clone(), Part::Net, NET, kept, &device)
            }
        };
    }
    Ok(small)
}

/// A head's layers without some functions: W `[in, hidden]` and b `[hidden]` unchanged, of the last layer's W `[hidden, outputs x functions]` and b only the kept
/// columns.
fn head_weights(values: &[f32], (outputs, own): (usize, usize), width: usize, kept: &[usize]) -> Vec<f32> {
    let first = width * (width + 1);
    let mut out = values[..first].to_vec();
    for row in values[first..].chunks_exact(outputs * own) {
        for o in 0..outputs {
            out.extend(kept.iter().map(|&f| row[o * own + f]));
        }
    }
    out
}
