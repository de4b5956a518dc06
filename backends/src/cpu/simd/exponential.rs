//! Exponentials and logarithms of [`Lanes`].

use super::{Lanes, each};
use pulp::Simd;

const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// log2(e) minus its float32 value.
const LOG2_E_TAIL: f32 = 1.925_963e-8;
/// Adding and subtracting 1.5 * 2^23 rounds to the nearest integer and leaves it in the low bits.
const ROUND: f32 = 12_582_912.0;
/// Bits of 1 and of the square root of 1/2.
const ONE: u32 = 0x3f80_0000;
const HALF_ROOT: u32 = 0x3f35_04f3;
/// 2^f on [-1/2, 1/2] with value 1 at 0, largest relative error 9.2e-8 (fitted by iteratively reweighted least squares).
#[allow(clippy::approx_constant)] // A fitted coefficient near ln 2, not ln 2.
const EXP2_5: [f32; 5] = [0.693_147, 0.240_222_42, 0.055_507_337, 0.009_671_513, 0.001_326_472_7];
/// As [`EXP2_5`] with one term more, largest relative error 2e-9.
const EXP2_6: [f32; 6] = [std::f32::consts::LN_2, 0.240_226_48, 0.055_503_325, 0.009_618_437, 0.001_339_887_4, 0.000_153_533_6];

impl<S: Simd> Lanes<S> {
    /// exp(-x) of each of `x` for 0 <= x <= 87; relative error under 2e-7 where the result is over 1/255, exactly 1 at 0, garbage outside the range. Every step
    /// is taken for all of them before the next one: a processor does not look far enough ahead to find out that they do not depend on each other.
    #[inline(always)]
    pub fn exp_negated<const N: usize>(x: [Self; N]) -> [Self; N] {
        let like = |v: f32| x[0].like(v);
        let scaled = like(-LOG2_E);
        let rounded: [Self; N] = each(
            #[inline(always)]
            |k| x[k].fma(scaled, like(ROUND)),
        );
        let f: [Self; N] = each(
            #[inline(always)]
            |k| x[k].fma(scaled, -(rounded[k] - ROUND)),
        );
        let mut p = [like(EXP2_5[4]); N];
        for coefficient in [EXP2_5[3], EXP2_5[2], EXP2_5[1], EXP2_5[0], 1.0] {
            p = each(
                #[inline(always)]
                |k| p[k].fma(f[k], like(coefficient)),
            );
        }
        each(
            #[inline(always)]
            |k| p[k].times_power_of_two(rounded[k]),
        )
    }
    /// exp(self), the argument clamped to -87..88; relative error about 1e-7. A NaN gives a finite value: test the input.
    #[inline(always)]
    pub fn exp(self) -> Self {
        let x = self.max(self.like(-87.0)).min(self.like(88.0));
        let rounded = x.fma(self.like(LOG2_E), self.like(ROUND));
        let n = rounded - ROUND;
        let f = x.fma(self.like(LOG2_E_TAIL), x.fma(self.like(LOG2_E), -n));
        let mut p = self.like(EXP2_6[5]);
        for k in (0..5).rev() {
            p = p.fma(f, self.like(EXP2_6[k]));
        }
        p.fma(f, self.like(1.0)).times_power_of_two(rounded)
    }
    /// ln(self) for positive normal numbers, relative error under 3e-7, next to 1 too; garbage for all others.
    #[inline(always)]
    pub fn ln(self) -> Self {
        let simd = self.simd;
        let of = |raw| Self { simd, raw: simd.transmute_f32s_u32s(raw) };
        // Mantissas are in sqrt(1/2)..sqrt(2), so that next to 1 the exponent is 0 and nothing cancels.
        let bits = simd.add_u32s(simd.transmute_u32s_f32s(self.raw), simd.splat_u32s(ONE - HALF_ROOT));
        let exponent = of(simd.or_u32s(simd.wrapping_dyn_shr_u32s(bits, simd.splat_u32s(23)), simd.splat_u32s(0x4b00_0000))) - (8_388_608.0 + 127.0);
        let mantissa = of(simd.add_u32s(simd.and_u32s(bits, simd.splat_u32s(0x007f_ffff)), simd.splat_u32s(HALF_ROOT)));
        // atanh series: ln m = 2 (s + s^3/3 + s^5/5 + s^7/7 + s^9/9) with s = (m - 1) / (m + 1), |s| < 0.172.
        let s = (mantissa - 1.0) / (mantissa + 1.0);
        let s2 = s * s;
        let series = s2.fma(s2.fma(s2.fma(self.like(2.0 / 9.0), self.like(2.0 / 7.0)), self.like(0.4)), self.like(2.0 / 3.0));
        exponent.fma(self.like(std::f32::consts::LN_2), s2.fma(series, self.like(2.0)) * s)
    }
    /// ln(self) for positive normal numbers, absolute error under 1e-4: good for bounds, not for values.
    #[inline(always)]
    pub fn ln_rough(self) -> Self {
        let simd = self.simd;
        let bits = simd.transmute_u32s_f32s(self.raw);
        let of = |raw| Self { simd, raw: simd.transmute_f32s_u32s(raw) };
        // The exponent, turned into a float by putting it in the low bits of 2^23; the mantissa, in 1..2.
        let exponent = of(simd.or_u32s(simd.wrapping_dyn_shr_u32s(bits, simd.splat_u32s(23)), simd.splat_u32s(0x4b00_0000))) - (8_388_608.0 + 127.0);
        let mantissa = of(simd.or_u32s(simd.and_u32s(bits, simd.splat_u32s(0x007f_ffff)), simd.splat_u32s(0x3f80_0000)));
        // atanh series: ln m = ln sqrt(2) + 2 (s + s^3/3 + s^5/5) with s = (m - sqrt 2) / (m + sqrt 2), |s| < 0.172.
        let root = std::f32::consts::SQRT_2;
        let s = (mantissa - root) / (mantissa + root);
        let s2 = s * s;
        let series = s2.fma(s2.fma(self.like(0.4), self.like(2.0 / 3.0)), self.like(2.0)) * s;
        exponent.fma(self.like(std::f32::consts::LN_2), series + 0.5 * std::f32::consts::LN_2)
    }
    /// Adds the integer in the low bits of `rounded` to the exponent.
    #[inline(always)]
    fn times_power_of_two(self, rounded: Self) -> Self {
        let simd = self.simd;
        let shifted = simd.wrapping_dyn_shl_u32s(simd.transmute_u32s_f32s(rounded.raw), simd.splat_u32s(23));
        Self { simd, raw: simd.transmute_f32s_u32s(simd.add_u32s(simd.transmute_u32s_f32s(self.raw), shifted)) }
    }
}

#[cfg(test)]
mod tests {
    use super::super::dispatch;
    use super::*;

    struct Exponentials<'a>(&'a mut [f32], u8);
    impl pulp::WithSimd for Exponentials<'_> {
        type Output = ();
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            for chunk in self.0.chunks_exact_mut(16) {
                for part in chunk.chunks_exact_mut(S::F32_LANES) {
                    let x = Lanes::load(simd, part);
                    let y = match self.1 {
                        0 => x.exp(),
                        1 => Lanes::exp_negated([x])[0],
                        2 => x.ln(),
                        _ => x.ln_rough(),
                    };
                    y.store(part);
                }
            }
        }
    }

    fn worst(values: &[f32], results: &[f32], sign: f64) -> f64 {
        values.iter().zip(results).map(|(&x, &y)| (f64::from(y) / (sign * f64::from(x)).exp() - 1.0).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn exponentials_are_accurate() {
        let blend: Vec<f32> = (0..16_000).map(|i| 6.0 * i as f32 / 16_000.0).collect();
        let mut y = blend.clone();
        dispatch(Exponentials(&mut y, 1));
        assert_eq!(y[0], 1.0);
        let error = worst(&blend, &y, -1.0);
        assert!(error < 2.5e-7, "{error:e}");
        let wide: Vec<f32> = (0..16_000).map(|i| -87.0 + 175.0 * i as f32 / 16_000.0).collect();
        let mut y = wide.clone();
        dispatch(Exponentials(&mut y, 0));
        let error = worst(&wide, &y, 1.0);
        assert!(error < 2.5e-7, "{error:e}");
        let mut logs = y.clone();
        dispatch(Exponentials(&mut logs, 3));
        let error = wide.iter().zip(&logs).map(|(&x, &l)| (x.clamp(-87.0, 88.0) - l).abs()).fold(0.0, f32::max);
        assert!(error < 1e-4, "{error:e}");
    }

    #[test]
    fn logarithms_are_accurate() {
        // All magnitudes, then both sides of 1, where logarithms are small.
        let wide = (0..16_000).map(|i| (-87.0 + 175.0 * i as f32 / 16_000.0).exp());
        let near = (0..16_000).map(|i| 1.0 + (i as f32 - 8000.0) * 1e-5);
        let values: Vec<f32> = wide.chain(near).collect();
        let mut logs = values.clone();
        dispatch(Exponentials(&mut logs, 2));
        let pairs = values.iter().zip(&logs).filter(|(x, _)| **x != 1.0);
        let error = pairs.map(|(&x, &l)| (f64::from(l) / f64::from(x).ln() - 1.0).abs()).fold(0.0, f64::max);
        assert!(error < 3e-7, "{error:e}");
        assert_eq!(logs[16_000 + 8000], 0.0);
    }
}
