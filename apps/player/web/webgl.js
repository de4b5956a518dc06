// Drawing with WebGL2, for browsers without WebGPU. Motion, projection and colour are computed in the vertex shader from data textures; the order, nearest last, comes
// from sort.js. The formulas are those of src/shaders.

import { Sorter, sortable } from "./sort.js";

const WIDTH = 2048;
// How long a lost context is waited for before the page says so, in milliseconds.
const PATIENCE_MS = 5000;

const COMMON = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform vec4 frame[9];
uniform uvec4 counts, flags, heads[5];
const float ALPHA_MIN = 1.0 / 255.0;
`;

const VERTEX = COMMON + `
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
    a = vec4(center, 0.5 * yy / determinant, -xy / determinant);
    b = vec4(0.5 * xx / determinant, opacity, point.z, radius);
    // Eigenvalues and axis take no difference of nearly equal numbers: of a long, thin footprint rounding would leave little.
    float difference = 0.5 * (xx - yy), spread = sqrt(difference * difference + xy * xy), largest = 0.5 * (xx + yy) + spread;
    vec2 axis = difference >= 0.0 ? vec2(spread + difference, xy) : vec2(xy, spread - difference);
    if (dot(axis, axis) < 1e-12) axis = vec2(1.0, 0.0);
    axis = normalize(axis);
    vec2 side = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
    vec2 pixel = center + side.x * sqrt(reach * largest) * axis + side.y * sqrt(reach * determinant / largest) * vec2(-axis.y, axis.x);
    gl_Position = vec4(2.0 * pixel.x / frame[6].x - 1.0, 1.0 - 2.0 * pixel.y / frame[6].y, 0.0, 1.0);
}`;

const FRAGMENT = COMMON + `
flat in vec4 a, b;
flat in vec3 color;
out vec4 result;
bool in_square(float pixel, float center) {
    float tile = floor(pixel / 16.0);
    return tile >= floor((center - 0.5 - b.w) / 16.0) && tile < floor((center - 0.5 + b.w + 15.0) / 16.0);
}
void main() {
    vec2 pixel = vec2(gl_FragCoord.x, frame[6].y - gl_FragCoord.y), d = pixel - a.xy;
    float sigma = a.z * d.x * d.x + a.w * d.x * d.y + b.x * d.y * d.y, alpha = b.y * exp(-sigma);
    if (!(sigma >= 0.0 && alpha >= ALPHA_MIN)) discard;
    if (b.w > 0.0 && !(in_square(pixel.x, a.x) && in_square(pixel.y, a.y))) discard;
    float kept = min(alpha, frame[7].w);
    result = vec4(color * kept, kept);
}`;

const COVER = COMMON + `
out vec2 place;
void main() { place = vec2(float((gl_VertexID << 1) & 2), float(gl_VertexID & 2)); gl_Position = vec4(2.0 * place - 1.0, 0.0, 1.0); }`;

const PRESENT = COMMON + `
uniform sampler2D image;
in vec2 place;
out vec4 result;
void main() { vec4 seen = texture(image, place); result = vec4(seen.rgb + (1.0 - seen.a) * frame[8].rgb, 1.0); }`;

const NONE = new Uint32Array(0);

export class WebGl {
    /// Calls `changed` when a newer order has arrived, so that the frame is worth drawing again.
    constructor(canvas, changed) {
        const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
        if (!gl) throw new Error("This browser has neither WebGPU nor WebGL2. Use a current browser, or open the file with `cc4dgs view`.");
        if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
            throw new Error("This graphics driver cannot blend in half floats. Use another browser, or open the file with `cc4dgs view`.");
        }
        this.gl = gl;
        this.canvas = canvas;
        // 2048 is what every WebGL2 has; a lost context tells nothing.
        const most = name => gl.getParameter(gl[name]) || 2048;
        /// Numbers of an array at most, and pixels of an image each way.
        this.mostWords = 4 * WIDTH * most("MAX_TEXTURE_SIZE");
        this.mostSide = Math.min(most("MAX_TEXTURE_SIZE"), most("MAX_RENDERBUFFER_SIZE"), ...(gl.getParameter(gl.MAX_VIEWPORT_DIMS) ?? []));
        // A browser may restore a lost context before anybody looks; what was made in it is gone all the same.
        canvas.addEventListener("webglcontextlost", () => { this.wasLost = true; }, { once: true });
        this.changed = changed;
        this.draws = this.program(VERTEX, FRAGMENT);
        this.presents = this.program(COVER, PRESENT);
        this.indices = gl.createBuffer();
        this.array = gl.createVertexArray();
        gl.bindVertexArray(this.array);
        gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
        gl.enableVertexAttribArray(0);
        gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
        gl.vertexAttribDivisor(0, 1);
        this.empty = gl.createVertexArray();
        this.textures = {};
        this.sorter = null;
        // The order in `indices`.
        this.uploaded = null;
        // Gaussians of the last interactive frame, and whether it had the order of its own view.
        [this.visible, this.settled] = [0, false];
    }
    /// Ends the worker. The context stays that of the canvas.
    free() { this.sorter?.close(); }
    /// Gives the context up too.
    destroy() {
        this.free();
        if (!this.gl.isContextLost()) this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    }
    get name() {
        const info = this.gl.getExtension("WEBGL_debug_renderer_info");
        return `WebGL2 ${info ? this.gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : ""}`;
    }
    get lost() { return !!this.wasLost || this.gl.isContextLost(); }
    /// Waits until the browser restores a lost context. Calls `late` where that takes long, and resolves to whether it did; rejects where `signal` aborts.
    async restored(late, signal) {
        let told = false;
        const timer = setTimeout(() => { told = true; late(); }, PATIENCE_MS);
        try {
            await new Promise((done, stop) => {
                this.canvas.addEventListener("webglcontextrestored", done, { once: true, signal });
                signal.addEventListener("abort", () => stop(signal.reason), { once: true });
            });
        } finally { clearTimeout(timer); }
        return told;
    }
    /// Refuses `what` where the memory of the graphics card has no room for it. Waits for the driver.
    check(what) {
        const { gl } = this;
        // A lost context has an error of its own.
        for (let error; (error = gl.getError()) !== gl.NO_ERROR;) {
            if (error === gl.OUT_OF_MEMORY) throw new Error(`The memory of the graphics card has no room for ${what}. Close other pages, or open the file with \`cc4dgs view\`.`);
        }
    }
    program(vertex, fragment) {
        const { gl } = this, program = gl.createProgram();
        for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
            const shader = gl.createShader(type);
            gl.shaderSource(shader, source);
            gl.compileShader(shader);
            gl.attachShader(program, shader);
            if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(`a shader does not compile: ${gl.getShaderInfoLog(shader)}`);
        }
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(`the shaders do not link: ${gl.getProgramInfoLog(program)}`);
        return { program, at: name => gl.getUniformLocation(program, name) };
    }
    texture(name, data, [internal, format, type], channels, width = WIDTH) {
        const { gl } = this;
        const texels = Math.max(1, Math.ceil(data.length / channels)), height = Math.ceil(texels / width);
        // A lost context knows no limits.
        if (height > (gl.getParameter(gl.MAX_TEXTURE_SIZE) ?? Infinity)) throw new Error(`The model is too large for this graphics driver (${height} rows of ${name}). Use a browser with WebGPU.`);
        const padded = new data.constructor(width * height * channels);
        padded.set(data);
        if (this.textures[name]) gl.deleteTexture(this.textures[name]);
        const texture = this.textures[name] = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, padded);
        this.filter(gl.NEAREST);
    }
    filter(kind) {
        const { gl } = this;
        for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, kind);
        for (const which of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, which, gl.CLAMP_TO_EDGE);
    }
    /// Uploads the scene of `player`, of whose Gaussians the first `moving` move.
    load(player, moving) {
        const { gl } = this;
        this.sorter?.close();
        this.sorter = null;
        const floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT], words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
        const gaussians = player.plainFloats(0), coefficients = player.plainFloats(1), starts = player.plainWords(1);
        this.texture("gaussians", gaussians, floats, 4);
        this.texture("coefficients", coefficients, floats, 4);
        this.texture("starts", starts, words, 4);
        this.loadHarmonics(player);
        const { model, tracks } = sortable(gaussians, starts, coefficients, player.plainWords(2), moving);
        this.tracks = tracks;
        this.sorter = new Sorter(model, this.changed);
    }
    /// Uploads the harmonics of `player` alone.
    loadHarmonics(player) {
        const { gl } = this;
        this.texture("harmonics", player.plainWords(0), [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT], 4);
        this.check("the model");
    }
    target(width, height) {
        const { gl } = this;
        if (this.size?.[0] === width && this.size[1] === height) return;
        if (this.image) { gl.deleteTexture(this.image); gl.deleteFramebuffer(this.buffer); }
        this.size = null;
        this.image = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, this.image);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
        this.filter(gl.LINEAR);
        this.buffer = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
        const what = `an image of ${width}x${height} pixels`;
        this.check(what);
        if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
            throw new Error(`This graphics driver cannot draw ${what}. Use another browser, or open the file with \`cc4dgs view\`.`);
        }
        this.size = [width, height];
    }
    uniforms({ at }, bytes) {
        const { gl } = this;
        const floats = new Float32Array(bytes.buffer, bytes.byteOffset, 36), words = new Uint32Array(bytes.buffer, bytes.byteOffset + 144, 28);
        gl.uniform4fv(at("frame"), floats);
        gl.uniform4uiv(at("counts"), words.subarray(0, 4));
        gl.uniform4uiv(at("flags"), words.subarray(4, 8));
        gl.uniform4uiv(at("heads"), words.subarray(8, 28));
    }
    /// The order for the frame with the uniforms `bytes`: its own where it is a capture, else the newest that there is.
    order(bytes, functions, capture) {
        if (!this.sorter) return NONE;
        const floats = new Float32Array(bytes.buffer, 0, 36), heads = new Uint32Array(bytes.buffer, 176, 20), [start, , first, width] = heads;
        // φ of the centres alone, up to that of the next head: what only opacity or colour change leaves the order as it is.
        const next = [4, 8, 12, 16].find(head => heads[head + 3]), end = width ? heads[next + 2] ?? functions.length : first;
        const view = { row: floats.slice(8, 12), near: floats[26], track: width ? this.tracks.get(start) : -1, functions: functions.slice(first, end) };
        if (capture) return this.sorter.sort(view);
        const order = this.sorter.newest(view);
        [this.visible, this.settled] = [order.length, this.sorter.has(view)];
        return order;
    }
    /// Draws the view of `player` to the canvas; or a capture through a camera at a time to `output`.
    draw(player, camera, time, output = null, size = [this.canvas.width, this.canvas.height]) {
        const { gl } = this;
        const bytes = player.plainFrame(camera, time).slice();
        const shape = new Float32Array(bytes.buffer, 96, 2);
        this.target(shape[0], shape[1]);
        const functions = player.plainFunctions(time), order = this.order(bytes, functions, output !== null);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
        gl.viewport(0, 0, shape[0], shape[1]);
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT);
        if (order.length > 0 && this.textures.gaussians) {
            if (functions.length) this.texture("functions", functions, [gl.R32F, gl.RED, gl.FLOAT], 1);
            else if (!this.textures.functions) this.texture("functions", new Float32Array(1), [gl.R32F, gl.RED, gl.FLOAT], 1);
            gl.useProgram(this.draws.program);
            this.uniforms(this.draws, bytes);
            ["gaussians", "coefficients", "functions", "harmonics", "starts"].forEach((name, unit) => {
                gl.activeTexture(gl.TEXTURE0 + unit);
                gl.bindTexture(gl.TEXTURE_2D, this.textures[name]);
                gl.uniform1i(this.draws.at(name), unit);
            });
            gl.bindVertexArray(this.array);
            gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
            if (this.uploaded !== order) gl.bufferData(gl.ARRAY_BUFFER, order, gl.STREAM_DRAW);
            this.uploaded = order;
            gl.enable(gl.BLEND);
            gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
            gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
            gl.disable(gl.BLEND);
        }
        gl.bindFramebuffer(gl.FRAMEBUFFER, output);
        gl.viewport(0, 0, size[0], size[1]);
        gl.useProgram(this.presents.program);
        this.uniforms(this.presents, bytes);
        gl.activeTexture(gl.TEXTURE0);
        gl.bindTexture(gl.TEXTURE_2D, this.image);
        gl.uniform1i(this.presents.at("image"), 0);
        gl.bindVertexArray(this.empty);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    /// RGBA pixels, the upper row first.
    capture(player, camera, time) {
        const { gl } = this;
        const shape = new Float32Array(player.plainFrame(camera, time).slice().buffer, 96, 2);
        const [width, height] = shape;
        const texture = gl.createTexture(), buffer = gl.createFramebuffer();
        gl.activeTexture(gl.TEXTURE0);
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
        gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        this.draw(player, camera, time, buffer, [width, height]);
        const raw = new Uint8Array(4 * width * height), data = new Uint8ClampedArray(raw.length);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, raw);
        for (let y = 0; y < height; y++) data.set(raw.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
        gl.deleteFramebuffer(buffer);
        gl.deleteTexture(texture);
        this.check(`an image of ${width}x${height} pixels`);
        return { width, height, data };
    }
}
