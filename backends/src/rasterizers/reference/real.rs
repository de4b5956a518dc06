//! Numbers the reference computes with: float32, float64, and float64 with derivatives carried along.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// A number; `value` decides every comparison.
pub trait Real: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self> {
    /// A constant.
    fn constant(value: f64) -> Self;
    /// The number itself.
    fn value(self) -> f64;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Natural exponential.
    fn exp(self) -> Self;
    /// The larger of the two.
    fn larger(self, other: Self) -> Self {
        if self.value() >= other.value() { self } else { other }
    }
    /// The smaller of the two.
    fn smaller(self, other: Self) -> Self {
        if self.value() <= other.value() { self } else { other }
    }
}

macro_rules! plain {
    ($type:ty) => {
        impl Real for $type {
            fn constant(value: f64) -> Self {
                value as Self
            }
            fn value(self) -> f64 {
                f64::from(self)
            }
            fn sqrt(self) -> Self {
                self.sqrt()
            }
            fn exp(self) -> Self {
                self.exp()
            }
        }
    };
}
plain!(f32);
plain!(f64);

/// A number and its derivatives with respect to N variables (forward-mode differentiation), in the precision T.
#[derive(Clone, Copy, Debug)]
pub struct Dual<const N: usize, T = f64> {
    /// The number.
    pub value: T,
    /// Its derivatives.
    pub slope: [T; N],
}

impl<const N: usize, T: Real> Dual<N, T> {
    /// Variable number `index`.
    pub fn variable(value: T, index: usize) -> Self {
        let mut slope = [T::constant(0.0); N];
        slope[index] = T::constant(1.0);
        Self { value, slope }
    }
    /// A function of `self` with this value and this derivative.
    fn chain(self, value: T, derivative: T) -> Self {
        Self { value, slope: self.slope.map(|d| d * derivative) }
    }
    /// a * self + b * other in the derivatives.
    fn mix(self, other: Self, value: T, a: T, b: T) -> Self {
        Self { value, slope: std::array::from_fn(|k| a * self.slope[k] + b * other.slope[k]) }
    }
}

impl<const N: usize, T: Real> Add for Dual<N, T> {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        let one = T::constant(1.0);
        self.mix(other, self.value + other.value, one, one)
    }
}
impl<const N: usize, T: Real> Sub for Dual<N, T> {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self.mix(other, self.value - other.value, T::constant(1.0), T::constant(-1.0))
    }
}
impl<const N: usize, T: Real> Mul for Dual<N, T> {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        self.mix(other, self.value * other.value, other.value, self.value)
    }
}
impl<const N: usize, T: Real> Div for Dual<N, T> {
    type Output = Self;
    fn div(self, other: Self) -> Self {
        let value = self.value / other.value;
        self.mix(other, value, T::constant(1.0) / other.value, -(value / other.value))
    }
}
impl<const N: usize, T: Real> Neg for Dual<N, T> {
    type Output = Self;
    fn neg(self) -> Self {
        self.chain(-self.value, T::constant(-1.0))
    }
}

impl<const N: usize, T: Real> Real for Dual<N, T> {
    fn constant(value: f64) -> Self {
        Self { value: T::constant(value), slope: [T::constant(0.0); N] }
    }
    fn value(self) -> f64 {
        self.value.value()
    }
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        // Where the argument is constant, so is the root, even at zero.
        if self.slope.iter().all(|&d| d.value() == 0.0) { Self { value: root, slope: self.slope } } else { self.chain(root, T::constant(0.5) / root) }
    }
    fn exp(self) -> Self {
        let value = self.value.exp();
        self.chain(value, value)
    }
}
