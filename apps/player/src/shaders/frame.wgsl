// The uniforms of a frame; all shaders that read them begin with this file.

struct Frame {
    // Rows of world to camera; the fourth number is the translation.
    world_to_camera: array<vec4<f32>, 3>,
    // Camera centre, and what a pixel adds to both diagonal entries of the projected covariance in square pixels.
    center: vec4<f32>,
    // fx, fy, cx, cy in pixels.
    intrinsics: vec4<f32>,
    // Where x/z and y/z are clamped in the Jacobian: lower and upper, x then y.
    ratio_limits: vec4<f32>,
    // Width, height, near, far.
    size: vec4<f32>,
    // ln of the nearest depth of the keys, keys per ln of depth, factor of all scales, cap of alpha.
    depth: vec4<f32>,
    // Background.
    background: vec4<f32>,
    // Gaussians, moving ones (which come first), words of harmonics per Gaussian, degree to evaluate.
    counts: vec4<u32>,
    // Antialiasing, what is shown (0 colours, 1 depth), whether moving Gaussians are tinted, whether a square of 3 sigma limits footprints.
    flags: vec4<u32>,
    // By head: first index into starts, into coefficients and into functions; whether the head changes.
    heads: array<vec4<u32>, 5>,
}

const ALPHA_MIN: f32 = 1.0 / 255.0;
const HIDDEN: u32 = 0xffffffffu;
