//! Operators over [`pulp`]'s vectors, so that kernels read like arithmetic. Everything inlines to single instructions.
//!
//! A kernel is a struct that implements [`pulp::WithSimd`]; [`dispatch`] runs it with the widest instruction set of the machine.

mod exponential;

use pulp::Simd;
use pulp::bytemuck::{bytes_of, pod_read_unaligned};
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Sub};

/// Runs `kernel` with the best instruction set found at run time (AVX-512, AVX2, NEON, scalar).
#[inline]
pub fn dispatch<K: pulp::WithSimd>(kernel: K) -> K::Output {
    pulp::Arch::new().dispatch(kernel)
}

/// Runs plain loops, compiled for the best instruction set found at run time. Write `vectorized(#[inline(always)] || …)`.
///
/// The loops are called as an `FnMut`. Called as an `FnOnce`, a closure that could be called twice goes through a shim, which is a function of its own and
/// compiled for the baseline processor: 4 lanes instead of 16.
#[inline(always)]
pub fn vectorized<R>(loops: impl FnMut() -> R) -> R {
    struct Loops<F>(F);
    impl<R, F: FnMut() -> R> pulp::NullaryFnOnce for Loops<F> {
        type Output = R;
        #[inline(always)]
        fn call(mut self) -> R {
            (self.0)()
        }
    }
    dispatch(Loops(loops))
}

/// Float32 lanes of the vectors that [`dispatch`] runs kernels with on this machine.
pub fn lanes_in_use() -> usize {
    struct Width;
    impl pulp::WithSimd for Width {
        type Output = usize;
        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> usize {
            S::F32_LANES
        }
    }
    dispatch(Width)
}

/// `[f(0), f(1), …]`, inlined as [`std::array::from_fn`] is not: a closure that stays a function of its own is compiled without the
/// instruction set of the kernel around it. Write `each(#[inline(always)] |k| …)`.
#[inline(always)]
pub fn each<T: Copy, const N: usize>(mut f: impl FnMut(usize) -> T) -> [T; N] {
    const { assert!(N > 0) };
    let mut out = [f(0); N];
    let mut k = 1;
    while k < N {
        out[k] = f(k);
        k += 1;
    }
    out
}

/// Prefetches `from[index]`, on processors that can.
#[inline(always)]
pub fn prefetch<T>(from: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if index < from.len() {
        // SAFETY: prefetching has no effect on memory, and the address is inside the slice.
        unsafe { std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(from.as_ptr().add(index).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (from, index);
}

/// A vector of float32.
#[derive(Clone, Copy, Debug)]
pub struct Lanes<S: Simd> {
    simd: S,
    raw: S::f32s,
}

/// One truth value per lane.
#[derive(Clone, Copy, Debug)]
pub struct Mask<S: Simd> {
    simd: S,
    raw: S::m32s,
}

macro_rules! binary {
    ($trait:ident, $method:ident, $op:ident) => {
        impl<S: Simd> $trait for Lanes<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self { simd: self.simd, raw: self.simd.$op(self.raw, other.raw) }
            }
        }
        impl<S: Simd> $trait<f32> for Lanes<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: f32) -> Self {
                self.$method(Self::splat(self.simd, other))
            }
        }
    };
}
binary!(Add, add, add_f32s);
binary!(Sub, sub, sub_f32s);
binary!(Mul, mul, mul_f32s);
binary!(Div, div, div_f32s);

impl<S: Simd> AddAssign for Lanes<S> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl<S: Simd> Neg for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self { simd: self.simd, raw: self.simd.neg_f32s(self.raw) }
    }
}

impl<S: Simd> Lanes<S> {
    /// Lanes per vector; divides 16 for every instruction set of [`pulp`].
    pub const COUNT: usize = S::F32_LANES;

    /// The same value in every lane.
    #[inline(always)]
    pub fn splat(simd: S, value: f32) -> Self {
        Self { simd, raw: simd.splat_f32s(value) }
    }
    /// A value splat with the instruction set of `self`.
    #[inline(always)]
    pub fn like(self, value: f32) -> Self {
        Self::splat(self.simd, value)
    }
    /// The first [`Lanes::COUNT`] values of `from`.
    #[inline(always)]
    pub fn load(simd: S, from: &[f32]) -> Self {
        assert!(from.len() >= S::F32_LANES);
        // SAFETY: the slice holds a whole vector, checked above; vectors are plain data.
        Self { simd, raw: unsafe { from.as_ptr().cast::<S::f32s>().read_unaligned() } }
    }
    /// Writes the lanes to the start of `to`.
    #[inline(always)]
    pub fn store(self, to: &mut [f32]) {
        assert!(to.len() >= S::F32_LANES);
        // SAFETY: the slice holds a whole vector, checked above.
        unsafe { to.as_mut_ptr().cast::<S::f32s>().write_unaligned(self.raw) }
    }
    /// The vector that starts at `from`.
    ///
    /// # Safety
    /// `from` must point to [`Lanes::COUNT`] readable values.
    #[inline(always)]
    pub unsafe fn load_ptr(simd: S, from: *const f32) -> Self {
        // SAFETY: the caller's promise.
        Self { simd, raw: unsafe { from.cast::<S::f32s>().read_unaligned() } }
    }
    /// Writes the vector that starts at `to`.
    ///
    /// # Safety
    /// `to` must point to [`Lanes::COUNT`] writable values.
    #[inline(always)]
    pub unsafe fn store_ptr(self, to: *mut f32) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<S::f32s>().write_unaligned(self.raw) }
    }
    /// self * factor + addend.
    #[inline(always)]
    pub fn fma(self, factor: Self, addend: Self) -> Self {
        Self { simd: self.simd, raw: self.simd.mul_add_e_f32s(self.raw, factor.raw, addend.raw) }
    }
    /// addend - self * factor.
    #[inline(always)]
    pub fn nfma(self, factor: Self, addend: Self) -> Self {
        Self { simd: self.simd, raw: self.simd.negate_mul_add_e_f32s(self.raw, factor.raw, addend.raw) }
    }
    /// The smaller value per lane.
    #[inline(always)]
    pub fn min(self, other: Self) -> Self {
        Self { simd: self.simd, raw: self.simd.min_f32s(self.raw, other.raw) }
    }
    /// The larger value per lane.
    #[inline(always)]
    pub fn max(self, other: Self) -> Self {
        Self { simd: self.simd, raw: self.simd.max_f32s(self.raw, other.raw) }
    }
    /// Square root per lane.
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self { simd: self.simd, raw: self.simd.sqrt_f32s(self.raw) }
    }
    /// self > other; false where either is NaN.
    #[inline(always)]
    pub fn gt(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, raw: self.simd.greater_than_f32s(self.raw, other.raw) }
    }
    /// self >= other; false where either is NaN.
    #[inline(always)]
    pub fn ge(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, raw: self.simd.greater_than_or_equal_f32s(self.raw, other.raw) }
    }
    /// self <= other; false where either is NaN.
    #[inline(always)]
    pub fn le(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, raw: self.simd.less_than_or_equal_f32s(self.raw, other.raw) }
    }
    /// self < other; false where either is NaN.
    #[inline(always)]
    pub fn lt(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, raw: self.simd.less_than_f32s(self.raw, other.raw) }
    }
    /// self == other; false where either is NaN.
    #[inline(always)]
    pub fn equal(self, other: Self) -> Mask<S> {
        Mask { simd: self.simd, raw: self.simd.equal_f32s(self.raw, other.raw) }
    }
    /// Compares the bit patterns as unsigned integers: with a positive limit this is `0 <= self <= limit` and false for NaN, in one test.
    #[inline(always)]
    pub fn bits_le(self, limit: Self) -> Mask<S> {
        let simd = self.simd;
        Mask { simd, raw: simd.less_than_or_equal_u32s(simd.transmute_u32s_f32s(self.raw), simd.transmute_u32s_f32s(limit.raw)) }
    }
    /// The sum of the lanes, in a fixed order.
    #[inline(always)]
    pub fn sum(self) -> f32 {
        self.simd.reduce_sum_f32s(self.raw)
    }
    /// The largest lane.
    #[inline(always)]
    pub fn largest(self) -> f32 {
        self.simd.reduce_max_f32s(self.raw)
    }
    /// 1 / self for normal numbers, relative error about 1e-7, exactly 1 for 1.
    #[inline(always)]
    pub fn reciprocal(self) -> Self {
        #[cfg(target_arch = "x86_64")]
        if const { size_of::<S::f32s>() == 64 && size_of::<S::m32s>() == 2 } {
            use std::arch::x86_64::{__m512, _mm512_rcp14_ps};
            // SAFETY: 16 lanes with bit masks exist only where the dispatcher found AVX-512F, and then the vector is an __m512.
            let rough = unsafe {
                let rough: __m512 = _mm512_rcp14_ps(std::mem::transmute_copy(&self.raw));
                Self { simd: self.simd, raw: std::mem::transmute_copy(&rough) }
            };
            // One Newton step doubles the 14 bits.
            return rough.fma(self.nfma(rough, self.like(1.0)), rough);
        }
        self.like(1.0) / self
    }
    /// Whether the value is neither infinite nor NaN.
    #[inline(always)]
    pub fn finite(self) -> Mask<S> {
        let zero = self.like(0.0);
        (self * zero).equal(zero)
    }
}

impl<S: Simd> Mask<S> {
    /// `yes` where the mask is set, `no` elsewhere.
    #[inline(always)]
    pub fn select(self, yes: Lanes<S>, no: Lanes<S>) -> Lanes<S> {
        Lanes { simd: self.simd, raw: self.simd.select_f32s(self.raw, yes.raw, no.raw) }
    }
    /// `yes` where the mask is set, zero elsewhere.
    #[inline(always)]
    pub fn keep(self, yes: Lanes<S>) -> Lanes<S> {
        self.select(yes, Lanes::splat(self.simd, 0.0))
    }
    /// Whether any lane is set.
    #[inline(always)]
    pub fn any(self) -> bool {
        let bytes = bytes_of(&self.raw);
        match bytes.len() {
            1 => bytes[0] != 0,
            2 => u16::from_ne_bytes([bytes[0], bytes[1]]) != 0,
            4 => pod_read_unaligned::<u32>(bytes) != 0,
            _ => bytes.chunks_exact(8).map(pod_read_unaligned::<u64>).fold(0, |all, word| all | word) != 0,
        }
    }
}

impl<S: Simd> BitAnd for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self { simd: self.simd, raw: self.simd.and_m32s(self.raw, other.raw) }
    }
}

impl<S: Simd> BitOr for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self { simd: self.simd, raw: self.simd.or_m32s(self.raw, other.raw) }
    }
}
