// An instanced quad per visible Gaussian, farthest first, blended over what is there. The quad is the least around the ellipse at which alpha falls to 1/255 with
// sides along u and t, where the exponent is u^2 + t^2.

struct Splat {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
}
struct Work {
    sort: vec3<u32>,
    visible: u32,
    draw: vec4<u32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> pairs: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> work: Work;

struct Vertex {
    @builtin(position) position: vec4<f32>,
    @location(0) @interpolate(flat) a: vec4<f32>,
    @location(1) @interpolate(flat) b: vec4<f32>,
    @location(2) @interpolate(flat) color: vec3<f32>,
}

@vertex
fn vertex(@builtin(vertex_index) corner: u32, @builtin(instance_index) instance: u32) -> Vertex {
    // The list is nearest first.
    let splat = splats[pairs[work.visible - 1u - instance].y];
    let side = vec2<f32>(f32(corner & 1u) * 2.0 - 1.0, f32(corner >> 1u) * 2.0 - 1.0);
    let at = side * sqrt(log(max(splat.b.y * 255.0, 1.0)) + 0.005);
    let dy = at.y / splat.b.x;
    let pixel = splat.a.xy + vec2<f32>((at.x - splat.a.w * dy) / splat.a.z, dy);
    var out: Vertex;
    out.position = vec4<f32>(2.0 * pixel.x / frame.size.x - 1.0, 1.0 - 2.0 * pixel.y / frame.size.y, 0.5, 1.0);
    out.a = splat.a;
    out.b = splat.b;
    out.color = splat.c.rgb;
    return out;
}

// Whether a pixel lies in the tiles that Inria's square of 3 sigma meets, along one axis.
fn in_square(pixel: f32, center: f32, radius: f32) -> bool {
    let tile = floor(pixel / 16.0);
    return tile >= floor((center - 0.5 - radius) / 16.0) && tile < floor((center - 0.5 + radius + 15.0) / 16.0);
}

@fragment
fn fragment(v: Vertex) -> @location(0) vec4<f32> {
    let d = v.position.xy - v.a.xy;
    let u = v.a.z * d.x + v.a.w * d.y;
    let t = v.b.x * d.y;
    let sigma = u * u + t * t;
    let alpha = v.b.y * exp(-sigma);
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) { discard; }
    if (v.b.w > 0.0 && !(in_square(v.position.x, v.a.x, v.b.w) && in_square(v.position.y, v.a.y, v.b.w))) { discard; }
    let kept = min(alpha, frame.depth.w);
    return vec4<f32>(v.color * kept, kept);
}
