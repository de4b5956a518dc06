//! The deformer's offsets at even times, in the form of the playback layer and in units of their tolerance.

use super::check_stop;
use super::tolerance::Tolerances;
use crate::model::{Model, ModelDeformer};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::playback::Head;
use cc4dgs_core::{Gaussians, HostGaussians, Result, SpatialInput};
use rayon::prelude::*;
use std::sync::atomic::AtomicBool;

/// Positions of a Gaussian at which the nearest camera is looked for.
const POSITIONS: usize = 9;
/// Gaussians that the deformer is asked about at a time.
const BLOCK: usize = 1 << 14;
/// Numbers of moved Gaussians, all attributes at all times, held at a time: 768 MiB.
const MOVED_FLOATS: usize = 192 << 20;

/// The moving Gaussians of a model and their deformer.
pub(super) struct Motion<'a> {
    model: &'a Model,
    field: &'a ModelDeformer,
    device: Device,
    stop: &'a AtomicBool,
    /// Indices of the moving Gaussians in the model.
    pub(super) rows: Vec<usize>,
    /// The heads that the deformer changes.
    heads: Vec<Head>,
}

/// Offsets of some Gaussians.
pub(super) struct Offsets {
    /// By head.
    pub(super) heads: Vec<HeadOffsets>,
}

/// Offsets of one head.
pub(super) struct HeadOffsets {
    pub(super) head: Head,
    pub(super) width: usize,
    pub(super) samples: usize,
    /// Offsets over the tolerance of their Gaussian `[rows, samples, width]`.
    pub(super) values: Vec<f32>,
    /// Tolerances of the Gaussians.
    pub(super) tolerances: Vec<f32>,
}

/// The size of an error: its length for centres and rotations, its largest number for others.
pub(super) fn size_of(head: Head, error: impl Iterator<Item = f32>) -> f32 {
    match head {
        Head::Means | Head::Rotations => error.map(|v| v * v).sum::<f32>().sqrt(),
        _ => error.map(f32::abs).fold(0.0, f32::max),
    }
}

impl Offsets {
    /// The largest error, over its tolerance, of taking the mean of neighbours for every other sample.
    pub(super) fn largest_bend(&self) -> f32 {
        let of_row = |head: &HeadOffsets, row: &[f32]| {
            let at = |k: usize| &row[k * head.width..(k + 1) * head.width];
            let bend = |k: usize| size_of(head.head, (0..head.width).map(|c| at(k)[c] - 0.5 * (at(k - 1)[c] + at(k + 1)[c])));
            (1..head.samples.saturating_sub(1)).step_by(2).map(bend).fold(0.0, f32::max)
        };
        self.heads.iter().flat_map(|h| h.values.chunks_exact((h.samples * h.width).max(1)).map(move |row| of_row(h, row))).fold(0.0, f32::max)
    }
}

impl<'a> Motion<'a> {
    /// `None` if nothing moves. Once `stop` is set, [`Motion::evaluate`] is an error.
    pub(super) fn of(model: &'a Model, device: &Device, stop: &'a AtomicBool) -> Result<Option<Self>> {
        let Some(field) = model.field.as_ref().filter(|f| !f.field.is_static()) else { return Ok(None) };
        let rows = model.moving.rows(&model.gaussians.dynamic_scores).unwrap_or_else(|| (0..model.gaussians.len()).collect());
        if rows.is_empty() {
            return Ok(None);
        }
        let mut motion = Self { model, field, device: device.clone(), stop, rows, heads: Vec::new() };
        let (_, input) = motion.block(&[0])?;
        let offsets = field.field.deform(field.field.packed(field.field.spatial(&input)?.values), 0.5)?;
        let present = [
            offsets.means.is_some(),
            offsets.log_scales.is_some() || offsets.scales.is_some(),
            offsets.quaternions.is_some() || offsets.rotation_vectors.is_some(),
            offsets.opacity_logits.is_some() || offsets.opacity_log_factor.is_some(),
            offsets.sh.is_some(),
        ];
        motion.heads = Head::ALL.into_iter().zip(present).filter(|(_, there)| *there).map(|(head, _)| head).collect();
        Ok(if motion.heads.is_empty() { None } else { Some(motion) })
    }
    /// Numbers per Gaussian and sample.
    pub(super) fn width(&self) -> usize {
        self.heads.iter().map(|h| h.width(self.model.gaussians.sh_degree)).sum()
    }
    /// At most `count` of the moving Gaussians, evenly spread.
    pub(super) fn rows_evenly(&self, count: usize) -> Vec<usize> {
        let n = self.rows.len();
        if n <= count { (0..n).collect() } else { (0..count).map(|i| i * n / count).collect() }
    }
    /// Gaussians whose attributes at `samples` times are held at a time.
    fn block_len(&self, samples: usize) -> usize {
        // Centre, scales, rotation, opacity, colour, score; then harmonics.
        let attributes = 15 + 3 * sh_rest_len(self.model.gaussians.sh_degree);
        (MOVED_FLOATS / (attributes * samples.max(1))).clamp(1, BLOCK)
    }
    /// The moving Gaussians `part` (indices into `rows`) and what the deformer is asked about them.
    fn block(&self, part: &[usize]) -> Result<(HostGaussians, SpatialInput)> {
        let indices: Vec<usize> = part.iter().map(|&i| self.rows[i]).collect();
        let host = self.model.gaussians.select(&indices);
        let tensor = |values: &[f32], width: usize| Tensor::<2>::from_data(TensorData::new(values.to_vec(), [indices.len(), width]), &self.device);
        let attributes = self.field.field.attributes();
        let attributes = attributes.iter().filter_map(|spec| host.extra.get(&spec.name)).map(|a| tensor(&a.values, a.width)).collect();
        let input = SpatialInput { means_world: tensor(&host.means, 3), attributes };
        Ok((host, input))
    }
    /// The offsets of the moving Gaussians `part` (indices into `rows`) at `samples` even times from 0 to 1.
    pub(super) fn evaluate(&self, part: &[usize], samples: usize, tolerances: &Tolerances) -> Result<Offsets> {
        let degree = self.model.gaussians.sh_degree;
        let empty = |&head: &Head| HeadOffsets { head, width: head.width(degree), samples, values: Vec::new(), tolerances: Vec::new() };
        let mut out = Offsets { heads: self.heads.iter().map(empty).collect() };
        for rows in part.chunks(self.block_len(samples)) {
            let (host, input) = self.block(rows)?;
            let canonical = Gaussians::from_host(&HostGaussians { extra: Default::default(), ..host.clone() }, &self.device);
            let features = self.field.field.packed(self.field.field.spatial(&input)?.values);
            let mut moved = Vec::with_capacity(samples);
            for k in 0..samples {
                check_stop(self.stop)?;
                let time = if samples > 1 { k as f32 / (samples - 1) as f32 } else { 0.0 };
                let offsets = self.field.field.deform(features.clone(), time)?;
                offsets.check_finite(self.field.name())?;
                moved.push(offsets.apply(self.field.name(), &canonical, None)?.to_host()?);
            }
            let of_rows: Vec<[f32; 5]> = (0..rows.len())
                .into_par_iter()
                .map(|i| {
                    let position = |g: &HostGaussians| -> [f32; 3] { std::array::from_fn(|k| g.means[3 * i + k]) };
                    let step = (samples / POSITIONS).max(1);
                    let positions: Vec<[f32; 3]> = moved.iter().step_by(step).map(position).collect();
                    // Errors of scales and rotations show most where the deformer makes the Gaussian largest, and those of rotations where it makes the
                    // quaternion shortest.
                    let largest = |most: f32, g: &HostGaussians| g.log_scales[3 * i..3 * i + 3].iter().copied().fold(most, f32::max);
                    let norms = Norms::of(&moved, i);
                    tolerances.of(&positions, moved.iter().fold(f32::NEG_INFINITY, largest).exp(), norms.least / norms.mean)
                })
                .collect();
            for head in &mut out.heads {
                let at = Head::ALL.iter().position(|h| *h == head.head).unwrap_or(0);
                let (kind, width) = (head.head, head.width);
                let values: Vec<Vec<f32>> = (0..rows.len())
                    .into_par_iter()
                    .map(|i| {
                        let mut values = offsets_of(kind, &host, &moved, i);
                        values.iter_mut().for_each(|v| *v /= of_rows[i][at]);
                        debug_assert_eq!(values.len(), samples * width);
                        values
                    })
                    .collect();
                values.into_iter().for_each(|v| head.values.extend(v));
                head.tolerances.extend(of_rows.iter().map(|t| t[at]));
            }
        }
        Ok(out)
    }
}

fn quaternion(g: &HostGaussians, i: usize) -> [f32; 4] {
    std::array::from_fn(|k| g.quaternions[4 * i + k])
}

/// The norm of the quaternion of the Gaussian `i`, above 0.
fn norm_of(g: &HostGaussians, i: usize) -> f32 {
    quaternion(g, i).iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE)
}

/// Norms of the quaternion of a Gaussian over time.
struct Norms {
    /// The mean of the first and the last, which are the same however many samples are between.
    mean: f32,
    least: f32,
}

impl Norms {
    fn of(moved: &[HostGaussians], i: usize) -> Self {
        let mean = moved.first().zip(moved.last()).map_or(1.0, |(first, last)| 0.5 * (norm_of(first, i) + norm_of(last, i)));
        Self { mean, least: moved.iter().map(|g| norm_of(g, i)).fold(mean, f32::min) }
    }
}

/// The offsets of one head of the Gaussian `i` of `host` at all samples `moved`.
pub(super) fn offsets_of(head: Head, host: &HostGaussians, moved: &[HostGaussians], i: usize) -> Vec<f32> {
    let differences = |width: usize, of: fn(&HostGaussians) -> &Vec<f32>| -> Vec<f32> {
        let start = &of(host)[width * i..width * (i + 1)];
        moved.iter().flat_map(|g| of(g)[width * i..width * (i + 1)].iter().zip(start).map(|(a, b)| a - b)).collect()
    };
    let sigmoid = |logit: f32| 1.0 / (1.0 + (-logit).exp());
    match head {
        Head::Means => differences(3, |g| &g.means),
        Head::LogScales => differences(3, |g| &g.log_scales),
        Head::Rotations => {
            let start = quaternion(host, i).map(|v| v / norm_of(host, i));
            // Quaternions of any length are the same rotation; one factor for all times keeps what is linear linear.
            let mean = Norms::of(moved, i).mean;
            moved.iter().flat_map(|g| std::array::from_fn::<f32, 4, _>(|k| quaternion(g, i)[k] / mean - start[k])).collect()
        }
        Head::Opacities => moved.iter().map(|g| sigmoid(g.opacity_logits[i]) - sigmoid(host.opacity_logits[i])).collect(),
        Head::Colors => {
            let rest = 3 * sh_rest_len(host.sh_degree);
            let of = |g: &HostGaussians| -> Vec<f32> { g.sh_dc[3 * i..3 * i + 3].iter().chain(&g.sh_rest[rest * i..rest * (i + 1)]).copied().collect() };
            let start = of(host);
            moved.iter().flat_map(|g| of(g).into_iter().zip(&start).map(|(a, b)| a - b).collect::<Vec<_>>()).collect()
        }
    }
}
