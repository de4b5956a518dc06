//! Binary cross-entropy of logits, with its gradient.

use rayon::prelude::*;

/// Mean binary cross-entropy of logits against targets in 0..1, stable for logits of any size: max(x,0) - x z + ln(1 + e^-|x|).
/// With `gradient`, writes (sigmoid(x) - z) / n there.
pub fn bce_with_logits(logits: &[f32], targets: &[f32], gradient: Option<&mut [f32]>) -> f64 {
    const CHUNK: usize = 4096;
    if logits.is_empty() {
        return 0.0;
    }
    let n = logits.len() as f64;
    let loss = |x: f32, z: f32| x.max(0.0) - x * z + (-x.abs()).exp().ln_1p();
    let partial: Vec<f64> =
        logits.par_chunks(CHUNK).zip(targets.par_chunks(CHUNK)).map(|(x, z)| x.iter().zip(z).map(|(&x, &z)| f64::from(loss(x, z))).sum()).collect();
    if let Some(gradient) = gradient {
        let scale = (1.0 / n) as f32;
        gradient.par_chunks_mut(CHUNK).zip(logits.par_chunks(CHUNK)).zip(targets.par_chunks(CHUNK)).for_each(|((out, x), z)| {
            for ((out, &x), &z) in out.iter_mut().zip(x).zip(z) {
                // exp(-|x|) never overflows; both branches of the sigmoid are exact in it.
                let e = (-x.abs()).exp();
                let sigmoid = if x >= 0.0 { 1.0 / (1.0 + e) } else { e / (1.0 + e) };
                *out = scale * (sigmoid - z);
            }
        });
    }
    partial.iter().sum::<f64>() / n
}
