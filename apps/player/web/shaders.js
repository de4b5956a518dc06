// The shaders of WebGL2. The formulas are those of src/shaders.

// Texels in a row of each texture. φ fits into one row: five heads have at most 255 functions each.
export const WIDTH = 2048;

const COMMON = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform vec4 frame[9];
uniform uvec4 counts, flags, heads[5];
const float ALPHA_MIN = 1.0 / 255.0;
`;

export const VERTEX = COMMON + `
uniform sampler2D gaussians, coefficients, functions;
uniform usampler2D harmonics, starts;
layout(location = 0) in uint index;
flat out vec4 a, b;
flat out vec3 color;

ivec2 at(uint i) { return ivec2(int(i % ${WIDTH}u), int(i / ${WIDTH}u)); }
float coefficient(uint i) { return texelFetch(coefficients, at(i >> 2u), 0)[i & 3u]; }
uint start(uint i) { return texelFetch(starts, at(i >> 2u), 0)[i & 3u]; }
float phi(uint i) { return texelFetch(functions, ivec2(int(i), 0), 0).r; }

vec4 offset(uint head, uint i, uint number, uint wanted) {
    vec4 sum = vec4(0.0);
    uint width = heads[head].w;
    if (width == 0u || i >= counts.y) return sum;
    uint first = start(heads[head].x + i), end = start(heads[head].x + i + 1u);
    for (uint k = first; k < end; k++) {
        uint c = heads[head].y + width * k + number;
        float f = phi(heads[head].z + k - first);
        for (uint n = 0u; n < wanted; n++) sum[n] += f * coefficient(c + n);
    }
    return sum;
}
float half_at(uint first, uint i) {
    uint word = first + i / 2u;
    vec2 pair = unpackHalf2x16(texelFetch(harmonics, at(word >> 2u), 0)[word & 3u]);
    return (i & 1u) == 1u ? pair.y : pair.x;
}
vec3 sh(uint i, uint number) {
    uint first = counts.z * i, c = 3u * (number - 1u);
    return vec3(half_at(first, c), half_at(first, c + 1u), half_at(first, c + 2u)) + offset(4u, i, 3u * number, 3u).xyz;
}
vec3 color_of(uint i, vec3 dc, vec3 d) {
    vec3 c = (dc + offset(4u, i, 0u, 3u).xyz) * 0.28209479 + 0.5;
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    if (counts.w > 0u) c += 0.48860251 * (-y * sh(i, 1u) + z * sh(i, 2u) - x * sh(i, 3u));
    if (counts.w > 1u) c += 1.0925484 * xy * sh(i, 4u) - 1.0925484 * yz * sh(i, 5u) + 0.31539157 * (2.0 * zz - xx - yy) * sh(i, 6u)
        - 1.0925484 * xz * sh(i, 7u) + 0.5462742 * (xx - yy) * sh(i, 8u);
    if (counts.w > 2u) c += -0.5900436 * y * (3.0 * xx - yy) * sh(i, 9u) + 2.8906114 * xy * z * sh(i, 10u)
        - 0.4570458 * y * (4.0 * zz - xx - yy) * sh(i, 11u) + 0.37317634 * z * (2.0 * zz - 3.0 * (xx + yy)) * sh(i, 12u)
        - 0.4570458 * x * (4.0 * zz - xx - yy) * sh(i, 13u) + 1.4453057 * z * (xx - yy) * sh(i, 14u) - 0.5900436 * x * (xx - 3.0 * yy) * sh(i, 15u);
    if (counts.w > 3u) {
        float s = 7.0 * zz;
        c += 2.5033429 * xy * (xx - yy) * sh(i, 16u) - 1.7701308 * yz * (3.0 * xx - yy) * sh(i, 17u) + 0.9461747 * xy * (s - 1.0) * sh(i, 18u)
            - 0.6690465 * yz * (s - 3.0) * sh(i, 19u) + 0.10578555 * (zz * (5.0 * s - 30.0) + 3.0) * sh(i, 20u) - 0.6690465 * xz * (s - 3.0) * sh(i, 21u)
            + 0.47308735 * (xx - yy) * (s - 1.0) * sh(i, 22u) - 1.7701308 * xz * (xx - 3.0 * yy) * sh(i, 23u)
            + 0.6258357 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)) * sh(i, 24u);
    }
    return max(c, vec3(0.0));
}
vec3 depth_color(float t) { return clamp(vec3(1.5 - abs(4.0 * t - 3.5), 1.5 - abs(4.0 * t - 2.2), 1.3 - abs(4.0 * t - 0.8)), 0.0, 1.0); }

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    a = b = vec4(0.0);
    color = vec3(0.0);
    uint i = index;
    vec4 g0 = texelFetch(gaussians, at(4u * i), 0), g1 = texelFetch(gaussians, at(4u * i + 1u), 0);
    vec4 g2 = texelFetch(gaussians, at(4u * i + 2u), 0), g3 = texelFetch(gaussians, at(4u * i + 3u), 0);
    float opacity = clamp(g0.w + offset(3u, i, 0u, 1u).x, 0.0, 1.0);
    if (opacity < ALPHA_MIN) return;
    vec3 mean = g0.xyz + offset(0u, i, 0u, 3u).xyz;
    vec3 point = vec3(dot(frame[0].xyz, mean) + frame[0].w, dot(frame[1].xyz, mean) + frame[1].w, dot(frame[2].xyz, mean) + frame[2].w);
    if (!(point.z > frame[6].z && point.z < frame[6].w)) return;
    vec3 scales = exp(g1.xyz + offset(1u, i, 0u, 3u).xyz) * frame[7].z;
    vec4 raw = g2 + offset(2u, i, 0u, 4u);
    float norm = dot(raw, raw);
    if (!(norm > 1e-30)) return;
    vec4 q = raw / sqrt(norm);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    vec3 m0 = vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y));
    vec3 m1 = vec3(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x));
    vec3 m2 = vec3(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y));
    vec3 t0 = (m0 * frame[0].x + m1 * frame[0].y + m2 * frame[0].z) * scales;
    vec3 t1 = (m0 * frame[1].x + m1 * frame[1].y + m2 * frame[1].z) * scales;
    vec3 t2 = (m0 * frame[2].x + m1 * frame[2].y + m2 * frame[2].z) * scales;
    vec2 ratio = point.xy / point.z;
    vec2 held = clamp(ratio, frame[5].xz, frame[5].yw);
    vec3 r0 = (t0 - held.x * t2) * (frame[4].x / point.z), r1 = (t1 - held.y * t2) * (frame[4].y / point.z);
    float raw_xx = dot(r0, r0), xy = dot(r0, r1), raw_yy = dot(r1, r1);
    vec3 normal = cross(r0, r1);
    float blur = frame[3].w, raw_determinant = dot(normal, normal), determinant = raw_determinant + (raw_xx + raw_yy) * blur + blur * blur;
    if (!(determinant > 0.0 && determinant < 1e30)) return;
    float xx = raw_xx + blur, yy = raw_yy + blur;
    if (flags.x == 1u) opacity *= sqrt(max(raw_determinant / determinant, 2.5e-5));
    float reach = 2.0 * (log(max(opacity * 255.0, 1e-30)) + 0.005);
    if (!(opacity >= ALPHA_MIN && reach > 0.0)) return;
    vec2 center = ratio * frame[4].xy + frame[4].zw;
    float radius = 0.0;
    if (flags.w == 1u) {
        float h = 0.5 * (xx - yy);
        radius = ceil(3.0 * sqrt(0.5 * (xx + yy) + sqrt(max(h * h + xy * xy, 0.1))));
    }
    float key = clamp((log(point.z) - frame[7].x) * frame[7].y, 0.0, 65535.0);
    color = flags.y == 1u ? depth_color(1.0 - key / 65535.0) : color_of(i, g3.xyz, normalize(mean - frame[3].xyz));
    if (flags.z == 1u && i < counts.y) color = mix(color, vec3(1.0, 0.25, 0.1), 0.65);
    // The exponent is a sum of squares, u^2 + t^2: a dx^2 + b dx dy + c dy^2 would cancel for long, thin footprints. The sides of the quad are along u and t.
    float root = sqrt(yy), l1 = 0.70710678 * root / sqrt(determinant);
    a = vec4(center, l1, -(xy / yy) * l1);
    b = vec4(0.70710678 / root, opacity, point.z, radius);
    vec2 side = (vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0) * sqrt(0.5 * reach);
    float dy = side.y / b.x;
    vec2 pixel = center + vec2((side.x - a.w * dy) / a.z, dy);
    gl_Position = vec4(2.0 * pixel.x / frame[6].x - 1.0, 1.0 - 2.0 * pixel.y / frame[6].y, 0.0, 1.0);
}`;

export const FRAGMENT = COMMON + `
flat in vec4 a, b;
flat in vec3 color;
out vec4 result;
bool in_square(float pixel, float center) {
    float tile = floor(pixel / 16.0);
    return tile >= floor((center - 0.5 - b.w) / 16.0) && tile < floor((center - 0.5 + b.w + 15.0) / 16.0);
}
void main() {
    vec2 pixel = vec2(gl_FragCoord.x, frame[6].y - gl_FragCoord.y), d = pixel - a.xy;
    float u = a.z * d.x + a.w * d.y, t = b.x * d.y, sigma = u * u + t * t, alpha = b.y * exp(-sigma);
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) discard;
    if (b.w > 0.0 && !(in_square(pixel.x, a.x) && in_square(pixel.y, a.y))) discard;
    float kept = min(alpha, frame[7].w);
    result = vec4(color * kept, kept);
}`;

export const COVER = COMMON + `
out vec2 uv;
void main() { uv = vec2(float((gl_VertexID << 1) & 2), float(gl_VertexID & 2)); gl_Position = vec4(2.0 * uv - 1.0, 0.0, 1.0); }`;

export const PRESENT = COMMON + `
uniform sampler2D image;
in vec2 uv;
out vec4 result;
void main() { vec4 seen = texture(image, uv); result = vec4(seen.rgb + (1.0 - seen.a) * frame[8].rgb, 1.0); }`;
