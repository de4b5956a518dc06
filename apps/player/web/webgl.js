// Drawing with WebGL2, for browsers without WebGPU. Motion, projection and colour are computed in the vertex shader from data textures; the order, nearest last, comes
// from sort.js. What changes from frame to frame is written to memory that is allocated once per model.

import { COVER, FRAGMENT, PRESENT, VERTEX, WIDTH } from "./shaders.js";
import { Sorter, sortable } from "./sort.js";

// Floats of a Gaussian in its texture.
const GAUSSIAN_FLOATS = 16;
// How long a lost context is waited for before the page says so, in milliseconds.
const PATIENCE_MS = 5000;

const NONE = new Uint32Array(0);

/// Two copies of what changes from frame to frame, written in turn, since the driver may still read the one that was drawn from last.
class Pair {
    /// `same(a, b)` says whether two values are equal.
    constructor(copies, same) {
        [this.copies, this.same, this.last] = [copies, same, 0];
        this.clear();
    }
    /// The copy that holds `value`. If none does, the one that was not taken last, after `write(copy)`.
    take(value, write) {
        const found = this.copies.findIndex(copy => copy.value && this.same(copy.value, value));
        this.last = found < 0 ? 1 - this.last : found;
        const copy = this.copies[this.last];
        if (found < 0) {
            write(copy);
            copy.value = value;
        }
        return copy;
    }
    /// Neither copy holds a value any more.
    clear() { this.copies.forEach(copy => { copy.value = null; }); }
}

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
        /// The order, as buffers of `capacity` indices each.
        this.orders = new Pair([this.indices(), this.indices()], (a, b) => a === b);
        this.capacity = 0;
        this.empty = gl.createVertexArray();
        /// Textures by name, and their `rows`.
        this.textures = {};
        /// φ, as one row of a texture each.
        this.functions = new Pair([{ name: "functions 0" }, { name: "functions 1" }], (a, b) => a.length === b.length && a.every((v, i) => v === b[i]));
        this.sorter = null;
        // Gaussians of the last interactive frame, and whether it had the order of its own view.
        [this.visible, this.settled] = [0, false];
    }
    /// Ends the worker, and gives back the memory of the model and of its image. The context stays that of the canvas.
    free() {
        this.sorter?.close();
        this.forget();
        this.forgetImage();
    }
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
    /// Refuses `what` where the graphics card has too little free memory for it. Waits for the driver.
    check(what) {
        const { gl } = this;
        // A lost context has an error of its own.
        for (let error; (error = gl.getError()) !== gl.NO_ERROR;) {
            if (error === gl.OUT_OF_MEMORY) throw new Error(`The graphics card has too little free memory for ${what}. Close other pages, or open the file with \`cc4dgs view\`.`);
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
    /// A buffer of indices, and the vertex array that reads it once per instance.
    indices() {
        const { gl } = this, buffer = gl.createBuffer(), array = gl.createVertexArray();
        gl.bindVertexArray(array);
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.enableVertexAttribArray(0);
        gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
        gl.vertexAttribDivisor(0, 1);
        return { buffer, array };
    }
    /// Allocates the buffers of the order for `count` indices each, unless they have that capacity. What they held is lost.
    reserve(count) {
        const { gl, orders } = this;
        orders.clear();
        if (count === this.capacity) return;
        for (const { buffer } of orders.copies) {
            gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
            gl.bufferData(gl.ARRAY_BUFFER, 4 * count, gl.DYNAMIC_DRAW);
        }
        this.capacity = count;
    }
    /// Writes `data` to the texture `name`, from its first texel on, in rows of WIDTH texels. Storage is allocated where the texture has another number of rows.
    texture(name, data, [internal, format, type], channels) {
        const { gl } = this, row = WIDTH * channels, whole = Math.floor(data.length / row), rows = Math.max(1, Math.ceil(data.length / row));
        // A lost context knows no limits.
        if (rows > (gl.getParameter(gl.MAX_TEXTURE_SIZE) ?? Infinity)) throw new Error(`The model is too large for this graphics driver (${rows} rows of ${name}). Use a browser with WebGPU.`);
        if (this.textures[name]?.rows !== rows) {
            this.remove(name);
            this.textures[name] = { texture: gl.createTexture(), rows };
            gl.bindTexture(gl.TEXTURE_2D, this.textures[name].texture);
            gl.texStorage2D(gl.TEXTURE_2D, 1, internal, WIDTH, rows);
            this.filter(gl.NEAREST);
        } else gl.bindTexture(gl.TEXTURE_2D, this.textures[name].texture);
        if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, whole, format, type, data);
        const rest = data.subarray(whole * row), texels = Math.ceil(rest.length / channels);
        if (!texels) return;
        // Zeros complete the last texel.
        const padded = new data.constructor(texels * channels);
        padded.set(rest);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, texels, 1, format, type, padded);
    }
    remove(name) {
        if (this.textures[name]) this.gl.deleteTexture(this.textures[name].texture);
        delete this.textures[name];
    }
    /// Gives back the memory of the model.
    forget() {
        Object.keys(this.textures).forEach(name => this.remove(name));
        this.functions.clear();
        this.reserve(0);
    }
    filter(kind) {
        const { gl } = this;
        for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, kind);
        for (const which of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, which, gl.CLAMP_TO_EDGE);
    }
    /// Uploads the scene of `player`, of whose Gaussians the first `moving` move. Where that fails, nothing of a model stays on the graphics card.
    load(player, moving) {
        const { gl } = this;
        this.sorter?.close();
        this.sorter = null;
        const floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT], words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
        const gaussians = player.plainFloats(0), coefficients = player.plainFloats(1), starts = player.plainWords(1);
        try {
            this.texture("gaussians", gaussians, floats, 4);
            this.texture("coefficients", coefficients, floats, 4);
            this.texture("starts", starts, words, 4);
            this.reserve(gaussians.length / GAUSSIAN_FLOATS);
            this.loadHarmonics(player);
            const { model, tracks } = sortable(gaussians, starts, coefficients, player.plainWords(2), moving);
            this.tracks = tracks;
            this.sorter = new Sorter(model, this.changed);
        } catch (e) {
            this.forget();
            throw e;
        }
    }
    /// Uploads the harmonics of `player` alone.
    loadHarmonics(player) {
        const { gl } = this;
        this.texture("harmonics", player.plainWords(0), [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT], 4);
        // Storage that could not be allocated is not written to later.
        try { this.check("the model"); } catch (e) { this.remove("harmonics"); throw e; }
    }
    forgetImage() {
        this.gl.deleteFramebuffer(this.buffer ?? null);
        this.gl.deleteTexture(this.image ?? null);
        this.buffer = this.image = this.size = null;
    }
    target(width, height) {
        const { gl } = this;
        if (this.size?.[0] === width && this.size[1] === height) return;
        this.forgetImage();
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
    /// The uniforms of a frame, and columns and rows of its image.
    frame(player, camera, time) {
        const bytes = player.plainFrame(camera, time).slice();
        return { bytes, shape: new Float32Array(bytes.buffer, 96, 2) };
    }
    /// The frame of what the canvas shows, with its target: of fewer pixels where there is no memory for all.
    interactive(player) {
        for (;;) {
            const frame = this.frame(player);
            try {
                this.target(...frame.shape);
                return frame;
            } catch (e) {
                if (!player.drawFewer()) throw e;
            }
        }
    }
    /// Draws the view of `player` to the canvas; or a capture of `size` through a camera at a time to `output`.
    draw(player, camera, time, output = null, size = null) {
        const { gl } = this;
        const { bytes, shape } = output ? this.frame(player, camera, time) : this.interactive(player);
        if (output) this.target(...shape);
        const functions = player.plainFunctions(time), order = this.order(bytes, functions, output !== null);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
        gl.viewport(0, 0, shape[0], shape[1]);
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT);
        if (order.length > 0 && this.textures.gaussians) {
            const { name } = this.functions.take(functions, copy => this.texture(copy.name, functions, [gl.R32F, gl.RED, gl.FLOAT], 1));
            const { array } = this.orders.take(order, ({ buffer }) => {
                gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
                gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
            });
            gl.useProgram(this.draws.program);
            this.uniforms(this.draws, bytes);
            const samplers = { gaussians: "gaussians", coefficients: "coefficients", functions: name, harmonics: "harmonics", starts: "starts" };
            Object.entries(samplers).forEach(([sampler, name], unit) => {
                gl.activeTexture(gl.TEXTURE0 + unit);
                gl.bindTexture(gl.TEXTURE_2D, this.textures[name]?.texture ?? null);
                gl.uniform1i(this.draws.at(sampler), unit);
            });
            gl.bindVertexArray(array);
            gl.enable(gl.BLEND);
            gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
            gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
            gl.disable(gl.BLEND);
        }
        gl.bindFramebuffer(gl.FRAMEBUFFER, output);
        // A browser may give a large canvas fewer pixels than it has columns and rows.
        gl.viewport(0, 0, ...(size ?? [gl.drawingBufferWidth, gl.drawingBufferHeight]));
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
        const [width, height] = this.frame(player, camera, time).shape;
        const raw = new Uint8Array(4 * width * height), data = new Uint8ClampedArray(raw.length), texture = gl.createTexture(), buffer = gl.createFramebuffer();
        try {
            gl.activeTexture(gl.TEXTURE0);
            gl.bindTexture(gl.TEXTURE_2D, texture);
            gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
            gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
            gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
            this.draw(player, camera, time, buffer, [width, height]);
            gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, raw);
        } finally {
            gl.deleteFramebuffer(buffer);
            gl.deleteTexture(texture);
        }
        for (let y = 0; y < height; y++) data.set(raw.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
        this.check(`an image of ${width}x${height} pixels`);
        return { width, height, data };
    }
}
