//! Plain-slice kernels (rayon and SIMD) that serve every CPU backend.

pub mod tensor;
