//! The search for the quality: the largest step factor whose loss or size is allowed.

use super::importance::Importance;
use super::settings::Settings;
use super::{Attempt, Job, allocate, read};
use cc4dgs_format::{CodecContext, Error, Event, HostGaussians, RenderModel, Result, TrainingViews};

/// Views on which the loss is measured.
const VIEWS: usize = 16;
/// Attempts of a search.
const ATTEMPTS: usize = 7;
/// Factors by which steps grow in search of a limit: at first, and near to it.
const WIDE: f64 = 2.0;
const NARROW: f64 = 1.2;
/// Parameters of a Gaussian that are not rounded to zero, for the estimate of the error.
const PARAMETERS: f64 = 20.0;
/// A file of this share of the limit is good enough.
const GOOD_SIZE: f64 = 0.985;

/// The root-mean-square error of a value's contribution to images that gives the estimated `psnr_db`.
pub fn estimate(psnr_db: f64, importance: &Importance) -> f64 {
    let error = libm::pow(10.0, -0.1 * psnr_db) * importance.samples;
    (12.0 * error / (PARAMETERS * importance.weights.len().max(1) as f64)).sqrt()
}

/// The streams that the settings ask for.
pub fn search(job: &mut Job, settings: &Settings, context: &CodecContext) -> Result<Attempt> {
    let start = estimate(settings.psnr_db, job.importance);
    let object = "codec compact";
    let services = context.views.filter(|v| !v.is_empty()).zip(context.renderer);
    let allocation = services.filter(|_| settings.allocate && !job.gaussians.is_empty());
    if settings.max_size_mb > 0.0 {
        if let Some((views, renderer)) = allocation {
            job.factors = allocate::allocate(job, start, views, renderer, context)?;
        }
        let job = &*job;
        let limit = settings.max_size_mb * 1e6;
        let found =
            bisect(job, (start, WIDE), (-1.0, ATTEMPTS), |attempt| Ok(attempt.bytes as f64 <= limit), |attempt| attempt.bytes as f64 >= GOOD_SIZE * limit)?;
        if found.bytes as f64 > limit {
            let remedy = "Allow more, or remove Gaussians with `cc4dgs prune`";
            return Err(Error::parameter(object, format!("{} bytes are the least that it reached", found.bytes), remedy));
        }
        note(
            context,
            format!(
                "{:.4} MB of Gaussians of {} MB allowed, steps {:.3} times the estimated ones",
                found.bytes as f64 / 1e6,
                settings.max_size_mb,
                found.quality / start
            ),
        );
        return Ok(found);
    }
    let Some((views, renderer)) = services else {
        if settings.drop_wanted {
            let problem = "a loss of PSNR is measured on training views, and there are none";
            return Err(Error::parameter(object, problem, "Give the dataset with --scene, or choose compact:psnr=50dB or compact:max-size=5MB"));
        }
        return job.attempt(start);
    };
    if settings.max_drop_db == 0.0 || job.gaussians.is_empty() {
        return job.attempt(start);
    }
    let before = Losses::of(job.gaussians, views, renderer)?;
    let drop_of =
        |attempt: &Attempt| Ok::<_, Error>(before.mean - Losses::of(&read::read(&attempt.streams, &context_without(context))?, views, renderer)?.mean);
    let best = std::cell::Cell::new((0.0, f64::NAN));
    let allowed = |attempt: &Attempt| {
        let drop = drop_of(attempt)?;
        if drop <= settings.max_drop_db && attempt.quality > best.get().0 {
            best.set((attempt.quality, drop));
        }
        Ok(drop <= settings.max_drop_db)
    };
    let mut found = bisect(job, (start, WIDE), (1.0, ATTEMPTS), allowed, |_| false)?;
    if allocation.is_some() {
        job.factors = allocate::allocate(job, found.quality, views, renderer, context)?;
        let factors = job.factors;
        note(context, format!("steps of means, log-scales, quaternions, opacities, degree 0 and higher degrees times {factors:.2?}"));
        let (first, drop) = (found, best.replace((0.0, f64::NAN)));
        found = bisect(job, (first.quality, NARROW), (1.0, ATTEMPTS), allowed, |_| false)?;
        // Small models may gain nothing.
        if first.bytes <= found.bytes || best.get().0 == 0.0 {
            found = first;
            best.set(drop);
        }
    }
    let (kept, mut drop) = best.get();
    if kept == 0.0 {
        drop = drop_of(&found)?;
        if drop > settings.max_drop_db {
            let problem = format!("the finest steps tried lose {drop:.3} dB on training views, {} dB are allowed", settings.max_drop_db);
            if settings.drop_wanted {
                return Err(Error::parameter(object, problem, "Allow more, or choose compact:psnr=70dB or the codec raw"));
            }
            context.events.emit(&Event::Warning { object: object.into(), message: problem });
        }
    }
    note(
        context,
        format!(
            "{:.4} MB of Gaussians, PSNR {:.3} dB lower on {} training views ({} dB allowed), steps {:.3} times the estimated ones",
            found.bytes as f64 / 1e6,
            drop,
            views.len().min(VIEWS),
            settings.max_drop_db,
            found.quality / start
        ),
    );
    Ok(found)
}

fn context_without<'a>(context: &CodecContext<'a>) -> CodecContext<'a> {
    CodecContext::new(context.seed, context.limits, context.events)
}

fn note(context: &CodecContext, message: String) {
    context.events.emit(&Event::Note { object: "codec compact".into(), message });
}

/// The attempt with the largest steps (`direction` 1) or the smallest (-1) that is `allowed`, by bisection of the logarithm; an attempt far on the other side
/// if none is.
fn bisect(
    job: &Job,
    (start, growth): (f64, f64),
    (direction, attempts): (f64, usize),
    allowed: impl Fn(&Attempt) -> Result<bool>,
    good: impl Fn(&Attempt) -> bool,
) -> Result<Attempt> {
    let (mut best, mut refused): (Option<Attempt>, Option<f64>) = (None, None);
    let mut quality = start;
    for attempt in 0..attempts {
        let found = job.attempt(quality)?;
        if allowed(&found)? {
            if good(&found) {
                return Ok(found);
            }
            best = Some(found);
        } else {
            refused = Some(quality);
        }
        // Where nothing was allowed yet, later attempts go farther.
        quality = match (&best, refused) {
            (Some(best), Some(refused)) => (best.quality * refused).sqrt(),
            (Some(best), None) => best.quality * libm::pow(growth, direction),
            (None, _) => quality / libm::pow(growth * (1.0 + 0.25 * attempt as f64), direction),
        };
    }
    match best {
        Some(attempt) => Ok(attempt),
        None => job.attempt(quality),
    }
}

/// PSNR of renders against the recorded images.
struct Losses {
    mean: f64,
}

impl Losses {
    fn of(gaussians: &HostGaussians, views: &dyn TrainingViews, renderer: &dyn RenderModel) -> Result<Self> {
        let chosen = views.len().min(VIEWS);
        let mut sum = 0.0;
        for k in 0..chosen {
            let index = k * views.len() / chosen;
            let (camera, time_norm) = views.view(index);
            let drawn = renderer.render(gaussians, camera, time_norm)?;
            let image = views.image(index)?;
            let truth = image.to_planes(renderer.background());
            let error: f64 = truth.iter().zip(&drawn.planes).map(|(a, b)| f64::from(a - b.clamp(0.0, 1.0)).powi(2)).sum::<f64>() / truth.len().max(1) as f64;
            sum += -10.0 * libm::log10(error.max(1e-12));
        }
        Ok(Self { mean: sum / chosen.max(1) as f64 })
    }
}
