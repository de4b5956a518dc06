//! Mu-law companding, as in the paper for dynamic scores: fine steps near zero, coarse steps for large values.

/// The companding constant of the archive's dynamic scores.
pub const MU: f64 = 255.0;

/// sign(x) ln(1 + mu |x|) / ln(1 + mu), for x in -1..1.
pub fn compress(x: f64, mu: f64) -> f64 {
    libm::copysign(libm::log1p(mu * x.abs()) / libm::log1p(mu), x)
}

/// The inverse of [`compress`].
pub fn expand(y: f64, mu: f64) -> f64 {
    libm::copysign(libm::expm1(y.abs() * libm::log1p(mu)) / mu, y)
}

/// The largest signed code of `bits` bits (2 to 16).
pub fn peak_code(bits: u8) -> i32 {
    (1 << (bits.clamp(2, 16) - 1)) - 1
}

/// The signed code of x in -1..1: [`peak_code`] times the companded value, halves away from zero.
pub fn encode(x: f64, bits: u8) -> i32 {
    libm::round(f64::from(peak_code(bits)) * compress(x, MU)) as i32
}

/// The value in -1..1 of a code.
pub fn decode(code: i32, bits: u8) -> f64 {
    expand(f64::from(code) / f64::from(peak_code(bits)), MU)
}
