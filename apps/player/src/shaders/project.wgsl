// A thread per Gaussian: motion, activation, projection, culling, colour; a screen record and a depth key per visible Gaussian, and how many of each workgroup are
// visible.

struct Gaussian {
    mean_opacity: vec4<f32>,
    log_scales: vec4<f32>,
    // w, x, y, z of a unit quaternion.
    quaternion: vec4<f32>,
    dc: vec4<f32>,
}

struct Splat {
    // Centre in pixels; l1 and l2 of the exponent sigma = (l1 dx + l2 dy)^2 + (l3 dy)^2.
    a: vec4<f32>,
    // l3, opacity, depth, radius of the square that limits it (0: none).
    b: vec4<f32>,
    // Red, green, blue; nothing.
    c: vec4<f32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
@group(0) @binding(2) var<storage, read> harmonics: array<u32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> coefficients: array<f32>;
@group(0) @binding(5) var<storage, read> functions: array<f32>;
@group(0) @binding(6) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> visible_of_block: array<u32>;

const MEANS: u32 = 0u;
const LOG_SCALES: u32 = 1u;
const ROTATIONS: u32 = 2u;
const OPACITIES: u32 = 3u;
const COLORS: u32 = 4u;
const MIN_COMPENSATION: f32 = 0.005;
const CUTOFF_MARGIN: f32 = 0.005;

var<workgroup> visible_count: atomic<u32>;

// First and end sum of ranks of a moving Gaussian in a head.
fn ranks(head: u32, i: u32) -> vec2<u32> {
    let at = frame.heads[head].x + i;
    return vec2<u32>(starts[at], starts[at + 1u]);
}

fn offset3(head: u32, i: u32) -> vec3<f32> {
    var sum = vec3<f32>(0.0);
    if (frame.heads[head].w == 0u || i >= frame.counts.y) { return sum; }
    let range = ranks(head, i);
    for (var k = range.x; k < range.y; k++) {
        let at = frame.heads[head].y + 3u * k;
        sum += vec3<f32>(coefficients[at], coefficients[at + 1u], coefficients[at + 2u]) * functions[frame.heads[head].z + k - range.x];
    }
    return sum;
}

fn offset4(head: u32, i: u32) -> vec4<f32> {
    var sum = vec4<f32>(0.0);
    if (frame.heads[head].w == 0u || i >= frame.counts.y) { return sum; }
    let range = ranks(head, i);
    for (var k = range.x; k < range.y; k++) {
        let at = frame.heads[head].y + 4u * k;
        sum += vec4<f32>(coefficients[at], coefficients[at + 1u], coefficients[at + 2u], coefficients[at + 3u]) * functions[frame.heads[head].z + k - range.x];
    }
    return sum;
}

fn offset1(head: u32, i: u32) -> f32 {
    var sum = 0.0;
    if (frame.heads[head].w == 0u || i >= frame.counts.y) { return sum; }
    let range = ranks(head, i);
    for (var k = range.x; k < range.y; k++) {
        sum += coefficients[frame.heads[head].y + k] * functions[frame.heads[head].z + k - range.x];
    }
    return sum;
}

// Offset of the spherical-harmonics coefficient `number` (0 is degree 0).
fn color_offset(i: u32, number: u32) -> vec3<f32> {
    var sum = vec3<f32>(0.0);
    if (frame.heads[COLORS].w == 0u || i >= frame.counts.y) { return sum; }
    let range = ranks(COLORS, i);
    // The w of the head is its width.
    let width = frame.heads[COLORS].w;
    for (var k = range.x; k < range.y; k++) {
        let at = frame.heads[COLORS].y + width * k + 3u * number;
        sum += vec3<f32>(coefficients[at], coefficients[at + 1u], coefficients[at + 2u]) * functions[frame.heads[COLORS].z + k - range.x];
    }
    return sum;
}

fn half_at(first: u32, index: u32) -> f32 {
    let pair = unpack2x16float(harmonics[first + index / 2u]);
    return select(pair.x, pair.y, (index & 1u) == 1u);
}

// Coefficient `number` (1 and up) of Gaussian `i`, as it is now.
fn coefficient(i: u32, number: u32) -> vec3<f32> {
    let first = frame.counts.z * i;
    let at = 3u * (number - 1u);
    return vec3<f32>(half_at(first, at), half_at(first, at + 1u), half_at(first, at + 2u)) + color_offset(i, number);
}

fn color_of(i: u32, dc: vec3<f32>, d: vec3<f32>) -> vec3<f32> {
    var color = (dc + color_offset(i, 0u)) * 0.28209479 + 0.5;
    let degree = frame.counts.w;
    let x = d.x; let y = d.y; let z = d.z;
    if (degree > 0u) {
        color += 0.48860251 * (-y * coefficient(i, 1u) + z * coefficient(i, 2u) - x * coefficient(i, 3u));
    }
    let xx = x * x; let yy = y * y; let zz = z * z; let xy = x * y; let yz = y * z; let xz = x * z;
    if (degree > 1u) {
        color += 1.0925484 * xy * coefficient(i, 4u) - 1.0925484 * yz * coefficient(i, 5u) + 0.31539157 * (2.0 * zz - xx - yy) * coefficient(i, 6u)
            - 1.0925484 * xz * coefficient(i, 7u) + 0.5462742 * (xx - yy) * coefficient(i, 8u);
    }
    if (degree > 2u) {
        color += -0.5900436 * y * (3.0 * xx - yy) * coefficient(i, 9u) + 2.8906114 * xy * z * coefficient(i, 10u)
            - 0.4570458 * y * (4.0 * zz - xx - yy) * coefficient(i, 11u) + 0.37317634 * z * (2.0 * zz - 3.0 * (xx + yy)) * coefficient(i, 12u)
            - 0.4570458 * x * (4.0 * zz - xx - yy) * coefficient(i, 13u) + 1.4453057 * z * (xx - yy) * coefficient(i, 14u)
            - 0.5900436 * x * (xx - 3.0 * yy) * coefficient(i, 15u);
    }
    if (degree > 3u) {
        let s = 7.0 * zz;
        color += 2.5033429 * xy * (xx - yy) * coefficient(i, 16u) - 1.7701308 * yz * (3.0 * xx - yy) * coefficient(i, 17u)
            + 0.9461747 * xy * (s - 1.0) * coefficient(i, 18u) - 0.6690465 * yz * (s - 3.0) * coefficient(i, 19u)
            + 0.10578555 * (zz * (5.0 * s - 30.0) + 3.0) * coefficient(i, 20u) - 0.6690465 * xz * (s - 3.0) * coefficient(i, 21u)
            + 0.47308735 * (xx - yy) * (s - 1.0) * coefficient(i, 22u) - 1.7701308 * xz * (xx - 3.0 * yy) * coefficient(i, 23u)
            + 0.6258357 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)) * coefficient(i, 24u);
    }
    return max(color, vec3<f32>(0.0));
}

// Dark blue through green to red, for 0 to 1.
fn depth_color(v: f32) -> vec3<f32> {
    let t = clamp(v, 0.0, 1.0);
    return clamp(vec3<f32>(1.5 - abs(4.0 * t - 3.5), 1.5 - abs(4.0 * t - 2.2), 1.3 - abs(4.0 * t - 0.8)), vec3<f32>(0.0), vec3<f32>(1.0));
}

// Writes splat and key of Gaussian `i`; whether it is visible.
fn project(i: u32) -> bool {
    keys[i] = HIDDEN;
    let g = gaussians[i];
    let opacity_now = clamp(g.mean_opacity.w + offset1(OPACITIES, i), 0.0, 1.0);
    if (opacity_now < ALPHA_MIN) { return false; }
    let mean = g.mean_opacity.xyz + offset3(MEANS, i);
    let r0 = frame.world_to_camera[0]; let r1 = frame.world_to_camera[1]; let r2 = frame.world_to_camera[2];
    let point = vec3<f32>(dot(r0.xyz, mean) + r0.w, dot(r1.xyz, mean) + r1.w, dot(r2.xyz, mean) + r2.w);
    if (!(point.z > frame.size.z && point.z < frame.size.w)) { return false; }
    let scales = exp(g.log_scales.xyz + offset3(LOG_SCALES, i)) * frame.depth.z;
    let raw = g.quaternion + offset4(ROTATIONS, i);
    let norm_squared = dot(raw, raw);
    if (!(norm_squared > 1e-30)) { return false; }
    let q = raw / sqrt(norm_squared);
    let w = q.x; let x = q.y; let y = q.z; let z = q.w;
    let m0 = vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y));
    let m1 = vec3<f32>(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x));
    let m2 = vec3<f32>(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y));
    let t0 = (m0 * r0.x + m1 * r0.y + m2 * r0.z) * scales;
    let t1 = (m0 * r1.x + m1 * r1.y + m2 * r1.z) * scales;
    let t2 = (m0 * r2.x + m1 * r2.y + m2 * r2.z) * scales;
    let inverse_depth = 1.0 / point.z;
    let ratio = point.xy * inverse_depth;
    let clamped = vec2<f32>(clamp(ratio.x, frame.ratio_limits.x, frame.ratio_limits.y), clamp(ratio.y, frame.ratio_limits.z, frame.ratio_limits.w));
    let row0 = (t0 - clamped.x * t2) * (inverse_depth * frame.intrinsics.x);
    let row1 = (t1 - clamped.y * t2) * (inverse_depth * frame.intrinsics.y);
    let raw_xx = dot(row0, row0);
    let xy = dot(row0, row1);
    let raw_yy = dot(row1, row1);
    let normal = cross(row0, row1);
    let raw_determinant = dot(normal, normal);
    let blur = frame.center.w;
    let determinant = raw_determinant + (raw_xx + raw_yy) * blur + blur * blur;
    // Also refuses what overflowed.
    if (!(determinant > 0.0 && determinant < 1e30)) { return false; }
    let inverse = 1.0 / determinant;
    let xx = raw_xx + blur;
    let yy = raw_yy + blur;
    var opacity = opacity_now;
    if (frame.flags.x == 1u) { opacity *= sqrt(max(raw_determinant * inverse, MIN_COMPENSATION * MIN_COMPENSATION)); }
    let reach = (log(max(opacity * 255.0, 1e-30)) + CUTOFF_MARGIN) * 2.0;
    if (!(opacity >= ALPHA_MIN && reach > 0.0)) { return false; }
    let extent = sqrt(reach * vec2<f32>(xx, yy));
    let center = ratio * frame.intrinsics.xy + frame.intrinsics.zw;
    if (!(center.x + extent.x >= 0.5 && center.x - extent.x <= frame.size.x - 0.5 && center.y + extent.y >= 0.5 && center.y - extent.y <= frame.size.y - 0.5)) {
        return false;
    }
    var radius = 0.0;
    if (frame.flags.w == 1u) {
        let half = 0.5 * (xx - yy);
        radius = ceil(3.0 * sqrt(0.5 * (xx + yy) + sqrt(max(half * half + xy * xy, 0.1))));
    }
    let key = clamp((log(point.z) - frame.depth.x) * frame.depth.y, 0.0, 65535.0);
    var color: vec3<f32>;
    if (frame.flags.y == 1u) {
        color = depth_color(1.0 - key / 65535.0);
    } else {
        color = color_of(i, g.dc.xyz, normalize(mean - frame.center.xyz));
    }
    if (frame.flags.z == 1u && i < frame.counts.y) { color = mix(color, vec3<f32>(1.0, 0.25, 0.1), 0.65); }
    // A sum of squares: a dx^2 + b dx dy + c dy^2 would cancel for long, thin footprints.
    let root = sqrt(yy);
    let l1 = 0.70710678 * root / sqrt(determinant);
    splats[i] = Splat(vec4<f32>(center, l1, -(xy / yy) * l1), vec4<f32>(0.70710678 / root, opacity, point.z, radius), vec4<f32>(color, 0.0));
    keys[i] = u32(key);
    return true;
}

@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    if (id.x < frame.counts.x) {
        if (project(id.x)) { atomicAdd(&visible_count, 1u); }
    }
    workgroupBarrier();
    if (thread == 0u) { visible_of_block[group.x] = atomicLoad(&visible_count); }
}
