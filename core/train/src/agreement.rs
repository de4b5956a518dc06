//! Whether devices draw the same images of one model.

use burn::tensor::Device;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::metrics::{Metric, Rounding};
use cc4dgs_core::{Event, EventSink, Image8, Registry, Result, Scene};
use cc4dgs_play::{Model, Player};
use serde::Serialize;

/// One level of an 8-bit image.
const LEVEL: f32 = 1.0 / 255.0;
/// Differences are counted per tenth of a level up to this many levels.
const COUNTED_LEVELS: usize = 4;
const BINS: usize = 10 * COUNTED_LEVELS;

/// One device's images against those of the first.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// Device by name.
    pub device: String,
    /// Views drawn.
    pub views: usize,
    /// Mean PSNR of 8-bit images against the truth.
    pub psnr_db: f64,
    /// That minus the first device's.
    pub psnr_difference_db: f64,
    /// Largest difference of a channel of a pixel from the first device's, images in 0..1, before rounding to 8 bits; infinite where a value is no number.
    pub max_difference: f32,
    /// Mean difference.
    pub mean_difference: f64,
    /// Differences below which this share lies, to a tenth of an 8-bit level, and the largest one where that is over four levels: 0.5, 0.99, 0.9999, 0.999999.
    pub quantiles: [f32; 4],
    /// Values compared.
    pub values: u64,
    /// Of which differ by more than one 8-bit level.
    pub over_one_level: u64,
    #[serde(skip)]
    bins: Vec<u64>,
}

impl Agreement {
    fn new(device: &str) -> Self {
        Self {
            device: device.into(),
            views: 0,
            psnr_db: 0.0,
            psnr_difference_db: 0.0,
            max_difference: 0.0,
            mean_difference: 0.0,
            quantiles: [0.0; 4],
            values: 0,
            over_one_level: 0,
            bins: vec![0; BINS + 1],
        }
    }
    fn add(&mut self, truth: &[f32], found: &[f32]) {
        for (a, b) in truth.iter().zip(found) {
            // What a screen shows; a NaN stays one.
            let difference = (a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).abs();
            let difference = if difference.is_nan() { f32::INFINITY } else { difference };
            self.max_difference = self.max_difference.max(difference);
            self.mean_difference += f64::from(difference);
            self.over_one_level += u64::from(difference > LEVEL);
            self.bins[((difference / LEVEL * 10.0) as usize).min(BINS)] += 1;
        }
        self.values += truth.len() as u64;
    }
    fn finish(&mut self) {
        self.mean_difference /= self.values.max(1) as f64;
        self.psnr_db /= self.views.max(1) as f64;
        self.quantiles = [0.5, 0.99, 0.9999, 0.999_999].map(|share: f64| {
            let wanted = (share * self.values as f64).ceil() as u64;
            let mut seen = 0;
            let bin = self.bins.iter().position(|count| {
                seen += count;
                seen >= wanted
            });
            // The last bin has all larger differences.
            bin.filter(|bin| *bin < BINS).map_or(self.max_difference, |bin| ((bin + 1) as f32 * 0.1 * LEVEL).min(self.max_difference))
        });
    }
}

/// Draws `views` of `scene` with one model per device, and compares all with the first.
pub fn agreement(models: &[(String, Device, Model)], scene: &Scene, views: &[usize], registry: &Registry, events: &dyn EventSink) -> Result<Vec<Agreement>> {
    let psnr = Metric::psnr(Rounding::EightBit);
    let mut players = models.iter().map(|(_, device, model)| Ok(Player::new(model, registry, device)?.on(scene.background))).collect::<Result<Vec<_>>>()?;
    let mut found: Vec<Agreement> = models.iter().map(|(name, _, _)| Agreement::new(name)).collect();
    for (done, &view) in views.iter().enumerate() {
        let camera = scene.camera(view);
        let frame = scene.frame(view)?;
        let mut first: Option<Vec<f32>> = None;
        for ((player, agreement), (_, _, model)) in players.iter_mut().zip(&mut found).zip(models) {
            let (output, _) = player.render(camera, scene.views[view].time_norm)?;
            let image = to_vec(output.image(), "render")?;
            let truth = Image8::from_planes(&frame.to_planes(model.background_on(scene.background)), camera.width, camera.height);
            agreement.psnr_db += psnr.score_images(&truth, &Image8::from_planes(&image, camera.width, camera.height))?;
            agreement.views += 1;
            agreement.add(first.get_or_insert_with(|| image.clone()), &image);
        }
        events.emit(&Event::Progress { task: "compare".into(), done: done as u64 + 1, total: views.len() as u64 });
    }
    for agreement in &mut found {
        agreement.finish();
    }
    if let Some(reference) = found.first().map(|a| a.psnr_db) {
        for agreement in &mut found {
            agreement.psnr_difference_db = agreement.psnr_db - reference;
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_counted_in_levels() {
        let mut a = Agreement::new("x");
        a.add(&[0.0, 0.5, 1.0, 0.2], &[0.0, 0.5 + 0.55 * LEVEL, 1.5, 0.2 + 2.0 * LEVEL]);
        a.finish();
        assert_eq!((a.values, a.over_one_level), (4, 1));
        assert!((a.max_difference - 2.0 * LEVEL).abs() < 1e-6 && (a.quantiles[0] - 0.1 * LEVEL).abs() < 1e-6, "{a:?}");
        a.add(&[f32::NAN], &[0.0]);
        assert_eq!(a.max_difference, f32::INFINITY);
    }

    #[test]
    fn quantiles_are_not_below_what_they_stand_for() {
        let mut a = Agreement::new("x");
        a.add(&[0.0; 10], &[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 0.5]);
        a.finish();
        assert_eq!(a.quantiles, [0.1 * LEVEL, 0.5, 0.5, 0.5]);
    }
}
