// The blended image over the background, at the size of the target.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var image: texture_2d<f32>;
@group(0) @binding(2) var linear: sampler;

struct Vertex {
    @builtin(position) position: vec4<f32>,
    @location(0) at: vec2<f32>,
}

@vertex
fn vertex(@builtin(vertex_index) i: u32) -> Vertex {
    // One triangle that covers the target.
    let at = vec2<f32>(f32((i << 1u) & 2u), f32(i & 2u));
    var out: Vertex;
    out.position = vec4<f32>(2.0 * at.x - 1.0, 1.0 - 2.0 * at.y, 0.0, 1.0);
    out.at = at;
    return out;
}

@fragment
fn fragment(v: Vertex) -> @location(0) vec4<f32> {
    let seen = textureSampleLevel(image, linear, v.at, 0.0);
    return vec4<f32>(seen.rgb + (1.0 - seen.a) * frame.background.rgb, 1.0);
}
