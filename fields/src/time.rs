//! Frequency encoding of time (paper eq. `time_encoding`).

use std::f64::consts::TAU;

/// Number of bands L for a sequence of `frames`: the highest frequency, 2^(L-1) cycles, is near half the frame count (8 for 300 frames, 10 for 1200, 6 for 50).
pub fn bands_for(frames: usize) -> usize {
    (frames.max(1) as f64).log2().round().clamp(1.0, 16.0) as usize
}

/// `[t, sin(2 pi t), cos(2 pi t), sin(4 pi t), …]` for t = `time_norm`: 1 + 2 `bands` values.
pub fn encode(time_norm: f32, bands: usize) -> Vec<f32> {
    let t = f64::from(time_norm);
    let mut out = vec![time_norm];
    for l in 0..bands {
        // Whole periods are removed before scaling by 2 pi, so that high bands keep their precision.
        let turns = (t * (l as f64).exp2()).fract();
        let (sin, cos) = (TAU * turns).sin_cos();
        out.extend([sin as f32, cos as f32]);
    }
    out
}

/// [`encode`] with bands of 1, 2, 4… times `cycles` cycles per sequence, whose amplitude is 2^-`falloff` times that of the next lower one. t stays t.
pub fn encode_scaled(time_norm: f32, bands: usize, cycles: f32, falloff: f32) -> Vec<f32> {
    let mut encoding = encode(time_norm * cycles, bands);
    encoding[0] = time_norm;
    for (band, pair) in encoding[1..].chunks_exact_mut(2).enumerate() {
        pair.iter_mut().for_each(|v| *v *= (-falloff * band as f32).exp2());
    }
    encoding
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_follow_the_frame_count() {
        assert_eq!([300, 1200, 50, 1, 0].map(bands_for), [8, 10, 6, 1, 1]);
    }

    #[test]
    fn the_encoding_is_the_papers() {
        let t = 0.3f32;
        let got = encode(t, 8);
        assert_eq!(got.len(), 17);
        assert_eq!(got[0], t);
        for l in 1..=8 {
            let angle = TAU * f64::from(1 << (l - 1)) * f64::from(t);
            assert!((f64::from(got[2 * l - 1]) - angle.sin()).abs() < 1e-6 && (f64::from(got[2 * l]) - angle.cos()).abs() < 1e-6);
        }
        assert_eq!(encode(0.0, 2), [0.0, 0.0, 1.0, 0.0, 1.0]);
    }

    #[test]
    fn one_cycle_without_falloff_is_the_papers_to_the_bit() {
        assert_eq!(encode_scaled(0.3, 8, 1.0, 0.0), encode(0.3, 8));
        let (half, of_half) = (encode_scaled(0.3, 3, 0.5, 1.0), encode(0.15, 3));
        assert_eq!((half.len(), half[0]), (7, 0.3));
        for (k, (got, plain)) in half.iter().zip(&of_half).skip(1).enumerate() {
            let octave = (k / 2) as f32;
            assert!((got - plain * (-octave).exp2()).abs() < 1e-6, "{half:?}");
        }
    }
}
