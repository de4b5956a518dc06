//! How much images depend on each weight of a deformer.

use crate::archive::{load_weights, weights_of};
use crate::codec_services::{ModelServices, rand_signs};
use crate::model::Model;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Event, EventSink, Registry, Result, Seed, TrainingViews};
use std::ops::RangeInclusive;

/// Images whose derivatives are averaged: as many as draw so many Gaussians, within the range.
const IMAGES: RangeInclusive<usize> = 24..=128;
const WORK: usize = 1_500_000;

/// The mean over `views`, for each weight of each array of the deformer, of the sum over pixels and channels of the squared derivative of the image by it.
///
/// Each image estimates it by the square of the derivative of a sum with random signs (Hutchinson 1989). Other images may depend on weights on which
/// none of these does, so every weight has at least the share 1 / images² of the mean of its array.
///
/// # Errors
/// What the deformer and the device report.
pub(crate) fn weight_importance(
    model: &Model,
    views: &dyn TrainingViews,
    seed: Seed,
    registry: &Registry,
    device: &Device,
    events: &dyn EventSink,
) -> Result<Vec<Vec<f32>>> {
    let Some(of) = &model.field else { return Ok(Vec::new()) };
    let weights = weights_of(of.field.as_ref())?;
    if weights.is_empty() {
        return Ok(Vec::new());
    }
    let mut sums: Vec<Vec<f64>> = weights.iter().map(|array| vec![0.0; array.values.len()]).collect();
    let images = if views.is_empty() { 0 } else { (WORK / model.gaussians.len().max(1)).clamp(*IMAGES.start(), *IMAGES.end()) };
    let mut deformer = registry.build_deformer(&of.section, &of.context, device)?;
    load_weights("weights", deformer.as_mut(), weights, device)?;
    for parameter in deformer.parameters_mut() {
        parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
    }
    let tracked = device.clone().autodiff();
    let services = ModelServices::new(model, registry, &tracked)?.with_deformer(deformer.as_ref());
    for k in 0..images {
        let (camera, time_norm) = views.view(k * views.len() / images);
        let planes = services.image(&model.gaussians, camera, time_norm)?;
        // Images where nothing moves do not depend on weights.
        if planes.is_tracked() {
            let shape = planes.dims();
            let signs = Tensor::<3>::from_data(TensorData::new(rand_signs(seed.index(k as u64), shape.iter().product()), shape), &tracked);
            let gradients = (planes * signs).sum().backward();
            for (sums, parameter) in sums.iter_mut().zip(deformer.parameters()) {
                // An array that no pixel depends on has no gradient.
                let Some(gradient) = parameter.value.grad(&gradients) else { continue };
                let found = to_vec(gradient, "derivatives by weights of the deformer")?;
                sums.iter_mut().zip(found).filter(|(_, v)| v.is_finite()).for_each(|(sum, v)| *sum += f64::from(v).powi(2));
            }
        }
        events.emit(&Event::Progress { task: "importance of weights".into(), done: k as u64 + 1, total: images as u64 });
    }
    let mean = |sums: Vec<f64>| {
        let (count, images) = (sums.len().max(1) as f64, images.max(1) as f64);
        let least = sums.iter().sum::<f64>() / (count * images * images);
        sums.into_iter().map(|sum| ((sum + least) / images).min(f64::from(f32::MAX)) as f32).collect()
    };
    Ok(sums.into_iter().map(mean).collect())
}
