// The order in which WebGL2 blends Gaussians. Interactive frames take it from a worker, so that the page stays smooth with hundreds of thousands of them; exact captures
// sort at once.

/// Indices of the Gaussians before the camera, farthest first; of equal keys the later Gaussian first, as on the GPU. Keys are 16 bits of the logarithm of depth.
/// `model` is what `sortable` returns. `view` has `row`, the third row of world to camera, the `near` plane, and of the centres' head the `track` (-1: none) and φ as
/// `functions`. Refers to nothing outside itself: the worker runs its text.
export function sortByDepth(model, view) {
    const { means, starts, coefficients, moving } = model, { near, track, functions } = view, [x, y, z, w] = view.row;
    const LAST_KEY = 65535;
    const count = means.length / 3, depths = new Float32Array(count);
    let low = Infinity, high = 0, visible = 0;
    for (let i = 0; i < count; i++) {
        let depth = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w;
        if (track >= 0 && i < moving) {
            const end = starts[track + i + 1];
            for (let c = starts[track + i], f = 0; c < end; c++, f++) {
                depth += functions[f] * (x * coefficients[3 * c] + y * coefficients[3 * c + 1] + z * coefficients[3 * c + 2]);
            }
        }
        depth = Math.fround(depth);
        // What is not finite, too near or behind keeps depth 0, and is left out.
        if (!(depth > near && depth < Infinity)) continue;
        depths[i] = depth;
        low = Math.min(low, depth);
        high = Math.max(high, depth);
        visible++;
    }
    const perLn = LAST_KEY / Math.max(Math.log(high / low), 1e-6);
    const keys = new Uint16Array(count), next = new Uint32Array(LAST_KEY + 2);
    for (let i = 0; i < count; i++) {
        if (depths[i] === 0) continue;
        keys[i] = LAST_KEY - Math.min(LAST_KEY, Math.floor(Math.log(depths[i] / low) * perLn));
        next[keys[i] + 1]++;
    }
    for (let k = 0; k <= LAST_KEY; k++) next[k + 1] += next[k];
    const order = new Uint32Array(visible);
    for (let i = count - 1; i >= 0; i--) if (depths[i] !== 0) order[next[keys[i]]++] = i;
    return order;
}

/// What sorting needs of a model: the centres, and starts and coefficients of their tracks alone. `gaussians` has 16 floats each, `starts` and `coefficients` hold all
/// heads; `offsets` has, per segment, where starts and coefficients of the centres begin (both all ones: they do not move). `track` in `tracks` is found by the first start.
export function sortable(gaussians, starts, coefficients, offsets, moving) {
    const means = new Float32Array(3 * gaussians.length / 16);
    for (let i = 0, at = 0; at < means.length; i += 16, at += 3) [means[at], means[at + 1], means[at + 2]] = [gaussians[i], gaussians[i + 1], gaussians[i + 2]];
    const own = [];
    for (let k = 0; k < offsets.length; k += 2) if (offsets[k] !== 0xffffffff) own.push([offsets[k], offsets[k + 1]]);
    const length = own.reduce((sum, [start]) => sum + starts[start + moving], 0);
    const out = { means, moving, starts: new Uint32Array(own.length * (moving + 1)), coefficients: new Float32Array(3 * length) };
    const tracks = new Map();
    let at = 0, end = 0;
    for (const [start, coefficient] of own) {
        tracks.set(start, at);
        for (let i = 0; i <= moving; i++) out.starts[at++] = end + starts[start + i];
        const ranks = starts[start + moving];
        out.coefficients.set(coefficients.subarray(coefficient, coefficient + 3 * ranks), 3 * end);
        end += ranks;
    }
    return { model: out, tracks };
}

const WORKER = `const sort = ${sortByDepth};
let model;
onmessage = ({ data }) => {
    if (data.model) { model = data.model; return; }
    const order = sort(model, data.view);
    postMessage(order, [order.buffer]);
};`;

function same(a, b) {
    const equal = (p, q) => p.length === q.length && p.every((v, i) => v === q[i]);
    return a !== null && b !== null && a.near === b.near && a.track === b.track && equal(a.row, b.row) && equal(a.functions, b.functions);
}

/// Orders of one model. A later model gets another sorter, so that a late answer cannot reach it.
export class Sorter {
    /// Calls `changed` when the worker has answered, or has failed and the page sorts by itself from now on.
    constructor(model, changed) {
        this.model = model;
        this.changed = changed;
        this.order = null;
        // The views of `order` and of the request that the worker has not answered yet.
        this.view = this.asked = null;
        this.worker = this.start();
    }
    /// A worker that has the model; null where the browser allows none. Its text is an address of its own, so pages that were opened from disk can start it.
    start() {
        let address, worker;
        try {
            address = URL.createObjectURL(new Blob([WORKER], { type: "text/javascript" }));
            worker = new Worker(address);
            worker.onmessage = ({ data }) => this.answered(data);
            worker.onerror = worker.onmessageerror = e => { e.preventDefault(); this.fail(e.message); };
            worker.postMessage({ model: this.model });
            return worker;
        } catch (e) {
            console.warn(`Sorting in a worker: ${e.message}`);
            // It has started where only the model is too large to be sent.
            worker?.terminate();
            return null;
        } finally {
            if (address) setTimeout(() => URL.revokeObjectURL(address), 60000);
        }
    }
    /// The order of `view`, now.
    sort(view) { return sortByDepth(this.model, view); }
    /// The newest order for interactive frames. Where it is not that of `view`, the worker is asked for it, unless it is still busy.
    newest(view) {
        if (same(view, this.view)) return this.order;
        if (!this.order || !this.worker) [this.order, this.view] = [this.sort(view), view];
        else if (!this.asked) {
            this.asked = view;
            this.worker.postMessage({ view });
        }
        return this.order;
    }
    /// Whether the newest order is that of `view`.
    has(view) { return same(view, this.view); }
    answered(order) {
        if (!this.asked) return;
        [this.order, this.view, this.asked] = [order, this.asked, null];
        this.changed();
    }
    fail(problem) {
        if (!this.worker) return;
        console.warn(`Sorting in a worker: ${problem || "it failed"}. The page sorts by itself.`);
        this.close();
        this.changed();
    }
    close() {
        this.worker?.terminate();
        this.worker = this.asked = null;
    }
}
