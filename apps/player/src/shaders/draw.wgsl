// An instanced quad per visible Gaussian, farthest first, blended over what is there. The quad is the ellipse at which alpha falls to 1/255.

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
    // The covariance is the inverse of the conic. Eigenvalues and axis take no difference of nearly equal numbers: of a long, thin footprint rounding would leave little.
    let determinant = splat.c.w;
    let cov = vec3<f32>(2.0 * splat.b.x, -splat.a.w, 2.0 * splat.a.z) * determinant;
    let difference = 0.5 * (cov.x - cov.z);
    let spread = sqrt(difference * difference + cov.y * cov.y);
    let largest = 0.5 * (cov.x + cov.z) + spread;
    let reach = 2.0 * (log(max(splat.b.y * 255.0, 1.0)) + 0.005);
    let major = sqrt(reach * largest);
    let minor = sqrt(reach * determinant / largest);
    var axis = select(vec2<f32>(cov.y, spread - difference), vec2<f32>(spread + difference, cov.y), difference >= 0.0);
    if (dot(axis, axis) < 1e-12) { axis = vec2<f32>(1.0, 0.0); }
    axis = normalize(axis);
    let side = vec2<f32>(f32(corner & 1u) * 2.0 - 1.0, f32(corner >> 1u) * 2.0 - 1.0);
    let pixel = splat.a.xy + side.x * major * axis + side.y * minor * vec2<f32>(-axis.y, axis.x);
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
    let sigma = v.a.z * d.x * d.x + v.a.w * d.x * d.y + v.b.x * d.y * d.y;
    let alpha = v.b.y * exp(-sigma);
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) { discard; }
    if (v.b.w > 0.0 && !(in_square(v.position.x, v.a.x, v.b.w) && in_square(v.position.y, v.a.y, v.b.w))) { discard; }
    let kept = min(alpha, frame.depth.w);
    return vec4<f32>(v.color * kept, kept);
}
