//! Three and four numbers at a time, inside kernels.

use cubecl::prelude::*;

/// Three numbers.
#[derive(CubeType, Clone, Copy)]
pub struct V3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

/// A quaternion (w,x,y,z).
#[derive(CubeType, Clone, Copy)]
pub struct V4 {
    pub w: f32,
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

#[cube]
pub fn v3(x: f32, y: f32, z: f32) -> V3 {
    V3 { x, y, z }
}

/// Three numbers of `values` from `at`.
#[cube]
pub fn load3(values: &[f32], at: usize) -> V3 {
    V3 { x: values[at], y: values[at + 1], z: values[at + 2] }
}

/// Writes three numbers to `values` from `at`.
#[cube]
pub fn store3(values: &mut [f32], at: usize, v: V3) {
    values[at] = v.x;
    values[at + 1] = v.y;
    values[at + 2] = v.z;
}

#[cube]
pub fn dot(a: V3, b: V3) -> f32 {
    a.x * b.x + a.y * b.y + a.z * b.z
}

#[cube]
pub fn cross(a: V3, b: V3) -> V3 {
    V3 { x: a.y * b.z - a.z * b.y, y: a.z * b.x - a.x * b.z, z: a.x * b.y - a.y * b.x }
}

#[cube]
pub fn add(a: V3, b: V3) -> V3 {
    V3 { x: a.x + b.x, y: a.y + b.y, z: a.z + b.z }
}

#[cube]
pub fn scale(a: V3, s: f32) -> V3 {
    V3 { x: a.x * s, y: a.y * s, z: a.z * s }
}

#[cube]
pub fn times(a: V3, b: V3) -> V3 {
    V3 { x: a.x * b.x, y: a.y * b.y, z: a.z * b.z }
}

/// a x + b y + c z for rows a, b, c.
#[cube]
pub fn combine(a: V3, x: f32, b: V3, y: f32, c: V3, z: f32) -> V3 {
    add(add(scale(a, x), scale(b, y)), scale(c, z))
}

// The translated forms hold handles of values, which may be used again and again.
impl Clone for V3Expand {
    fn clone(&self) -> Self {
        *self
    }
}
impl Copy for V3Expand {}

impl Clone for V4Expand {
    fn clone(&self) -> Self {
        *self
    }
}
impl Copy for V4Expand {}
