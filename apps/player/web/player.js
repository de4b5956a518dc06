// The player as a page and as a small library:
//
//     const player = await createPlayer(element, { src: "model.cc4d", autoplay: true });   // src: an address, a File, or bytes with { name }
//     player.on("time", ({ time, frame }) => …);  player.seek(0.5);  player.play();  await player.load("other.cc4d");
//     player.destroy();   // gives the device, memory and the element back
//     createPlayer(element, { src, remember: false });   // does not go on as it was where its page is loaded again
//
// Events: "time" { time, frame, seconds }, "loaded" facts, "play" and "pause", "error" and "warning" { message }, "progress" { share, bytes }, "recovered".
// Without options, the page's address says what to open: ?src=URL&autoplay, and #t=0.5&pose=… as share links have it; ?backend=webgl does without WebGPU.

import init, * as wasm from "./cc4dgs_player.js";
import { bytesOf, checkSize, loadUrl, nameOf } from "./loading.js";
import { addGestures, addKeys, commandsOf } from "./gestures.js";
import { capture, dispose, isLost, recover, release, startDevice } from "./device.js";
import { build, followLink, linkOf, remember, restore, savePng } from "./controls.js";

// What exports need of a page: raise it together with PAGE_VERSION in exporters/src/web/page.rs where archives need a newer one.
export const PAGE_VERSION = 4;

// An address as text; other sources as they are.
const addressed = source => (source instanceof URL ? source.href : source);

// The least and the largest value of the settings that are numbers.
const RANGES = { speed: [-Infinity, Infinity], scale: [0.01, 10], shDegree: [0, 4], resolution: [0.1, 2] };

const gone = () => new Error("This player was destroyed. Make another one with createPlayer.");

let ready;
// The player in each element.
const players = new WeakMap();

export async function createPlayer(container, options = {}) {
    const query = new URLSearchParams(location.search);
    const { src = query.get("src") ?? undefined, autoplay = query.has("autoplay"), backend = query.get("backend") } = options;
    // It would go on unseen, with its model on the graphics card.
    players.get(container)?.destroy();
    const player = new Page(container, backend);
    players.set(container, player);
    player.own = addressed(src);
    const view = options.remember === false ? null : restore(player);
    // Where there is no model, the link is for the file that is opened first.
    if (!src && location.hash) player.linked = {};
    try {
        // Where this player cannot fetch the module, the next one tries again.
        ready ??= init(options.wasm ? { module_or_path: options.wasm } : undefined).catch(e => {
            ready = undefined;
            throw new Error(`The player's module cc4dgs_player_bg.wasm could not be loaded (${e.message}). Reload the page; on a server of your own, put the file beside player.js.`);
        });
        await player.start(ready);
        const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
        const first = { playing: autoplay, ...view };
        if (!src) followLink(player);
        // A file that was opened while the module was loaded stays.
        else if (!player.abort) await player.load(src, options.name, { ...first, playing: first.playing && !still });
    } catch (e) {
        player.fail(e);
    }
    return player;
}

class Page {
    constructor(container, backend) {
        [this.container, this.backend] = [container, backend];
        this.listeners = {};
        this.gpu = null;
        this.facts = null;
        this.source = null;
        this.dirty = true;
        this.settings = { speed: 1, looping: true, scale: 1, shDegree: 4, resolution: 1, tint: false, depth: false };
        this.flying = false;
        // Index of the camera that the view is of: -1 is home, "" none.
        this.camera = -1;
        // Aborted when the player is destroyed.
        this.life = new AbortController();
        this.ui = build(container, this);
    }
    get destroyed() { return this.life.signal.aborted; }
    /// Starts on a graphics device once `module` is there. `starting` is the promise of it.
    start(module) { return this.starting = this.begin(module); }
    async begin(module) {
        await module;
        if (this.destroyed) throw gone();
        await startDevice(this);
        // Meanwhile it may have ended.
        if (this.destroyed) { release(this); throw gone(); }
        this.apply();
        const act = {
            mode: () => (this.flying ? "fly" : "orbit"),
            ...Object.fromEntries(["orbit", "look", "pan", "zoom", "fly"].map(name => [name, (...values) => { this.gpu?.[name](...values); this.moved(); }])),
        };
        const { canvas, embedded, root } = this.ui, { signal } = this.life;
        if (this.attached !== canvas) {
            this.attached = canvas;
            addGestures(canvas, act, signal);
            this.sizes ??= new ResizeObserver(() => this.resize());
            this.sizes.disconnect();
            this.sizes.observe(canvas);
            canvas.addEventListener("webglcontextlost", e => e.preventDefault(), { signal });
        }
        if (!this.flyKeys) {
            // On a page of its own the player has the keys before anything was clicked.
            this.flyKeys = addKeys(embedded ? root : document, act, commandsOf(this, act), signal);
            remember(this, signal);
            this.request = requestAnimationFrame(now => this.loop(now));
        }
        this.resize();
    }
    // Events
    on(name, listener) { (this.listeners[name] ??= new Set()).add(listener); return () => this.listeners[name].delete(listener); }
    /// What a listener throws is its own affair, and goes to the console.
    emit(name, detail) {
        this.listeners[name]?.forEach(listener => {
            try { listener(detail); } catch (e) { console.error(e); }
        });
    }
    fail(e) {
        // What `load` has told, its callers throw on.
        if (e?.name === "AbortError" || e === this.told || this.destroyed) return;
        this.told = e;
        const message = (e?.message || String(e)).trim();
        this.ui.error(message);
        this.emit("error", { message });
    }
    // Loading
    /// `first` says how a model starts: with `pose` and `time`, else those of the link; `playing` when it can. `back` is why another one failed, which stays said.
    async load(source, name, first = null) {
        if (this.destroyed) throw gone();
        source = addressed(source);
        const opens = typeof source === "string" || source?.byteLength >= 0 || typeof source?.arrayBuffer === "function";
        if (!opens) throw new Error(`The player opens an address (a text or a URL), a File, or bytes, and was given ${source === null ? "null" : typeof source}.`);
        this.abort?.abort();
        this.abort = new AbortController();
        const { signal } = this.abort;
        [first, this.linked] = [first ?? this.linked ?? null, null];
        const again = this.gpu && source === this.source && this.facts;
        // How things stood when the first of this model was opened. A model that is loaded again goes on from there.
        let before = null, played = false;
        const begin = () => {
            if (before || again && !first) this.first = this.now;
            before ??= this.now;
            played = this.playing;
            this.failure = null;
        };
        [this.source, this.name, this.first] = [source, name, first];
        this.ui.loading(true);
        // Reading bytes is not interrupted, and a listener may load another model, or destroy the player: what arrives from then on is not shown.
        const current = () => { if (signal.aborted) throw signal.reason; };
        const show = {
            poster: bytes => { current(); if (bytes && !this.facts) this.ui.poster(bytes); },
            part: (download, layer, motion, degree, starts) => {
                current();
                // A download that begins anew goes on with pose and time.
                const anew = starts && !before;
                if (anew) begin();
                this.loaded(JSON.parse(this.gpu.openPart(download, layer, motion, degree, anew)), anew, anew && played);
            },
            harmonics: (download, degree) => { current(); this.gpu.openHarmonics(download, degree); this.gl?.loadHarmonics(this.gpu); this.draw(); },
            whole: (name, bytes) => {
                current();
                begin();
                this.loaded(JSON.parse(this.gpu.open(name, bytes)), true, played);
            },
            progress: (share, bytes) => { current(); this.ui.progress(share); this.received = bytes; this.emit("progress", { share, bytes }); },
        };
        try {
            // The module is being loaded, or a lost device replaced, whose model gives way to this one.
            const problem = this.gpu ? null : await this.starting?.then(() => null, e => e);
            if (signal.aborted) return null;
            if (!this.gpu) throw problem ?? new Error("There is no graphics device to show it with. Reload the page, or open the file with `cc4dgs view`.");
            if (!again) this.facts = null;
            if (typeof source === "string") {
                this.ui.title(name ?? nameOf(source));
                await loadUrl(wasm, source, show, signal);
            } else {
                const label = name ?? source.name ?? "model";
                checkSize(label, source.size ?? source.byteLength ?? 0);
                const bytes = ArrayBuffer.isView(source) ? new Uint8Array(source.buffer, source.byteOffset, source.byteLength)
                    : new Uint8Array(await (source.arrayBuffer ? bytesOf(label, source) : source));
                if (signal.aborted) return null;
                this.ui.title(label);
                this.received = bytes.length;
                show.whole(label, bytes);
            }
            this.shown.ended = true;
            this.ui.error(this.problem);
            this.warn();
            this.emit("loaded", this.facts);
            return this.facts;
        } catch (thrown) {
            let e = thrown;
            if (e instanceof WebAssembly.RuntimeError) {
                // A panic: what was called is borrowed for ever, and nothing of it can be called again.
                console.error(e);
                this.gpu = null;
                e = new Error(`The player stopped while it opened ${this.title()} (${e.message}), most likely because its memory ran out. Reload the page, or open the file with \`cc4dgs view\`.`);
            } else if (signal.aborted) return null;
            // What is shown of it stays as it is. A model before is still there, if only in part where it was arriving or its memory was given to this one.
            if (this.shown?.source === source) this.shown.ended = true;
            const { ended, ...shown } = this.shown ?? { source: null, facts: null, first: null };
            Object.assign(this, shown);
            this.ui.poster(null);
            if (this.facts && this.gpu) { this.ui.facts(this.facts); this.ui.title(this.title()); } else this.ui.empty();
            this.fail(e);
            const torn = this.gpu && this.source && !ended && this.abort.signal === signal;
            if (torn) this.load(this.source, this.name, { ...(before ?? this.now), back: e.message }).catch(() => {});
            throw e;
        } finally {
            // A later load has a bar of its own.
            if (this.abort.signal === signal) this.ui.loading(false);
        }
    }
    /// What stays said while the model is shown.
    get problem() { return this.failure ?? this.first?.back ?? null; }
    /// Says what is not shown of the model.
    warn() {
        const message = this.facts.remarks.join(" ");
        if (message) { this.ui.note(message); this.emit("warning", { message }); }
    }
    /// Facts of the model that is drawn: while another one is fetched, those of the one before.
    get drawnFacts() { return this.facts ?? this.shown?.facts ?? null; }
    title() { return this.name ?? (typeof this.source === "string" ? nameOf(this.source) : this.source?.name ?? "model"); }
    /// A model is shown, or more of it; `anew` from its start. The one before `played`: its clock has ended.
    loaded(facts, anew, played) {
        this.facts = facts;
        if (this.shown) this.shown.ended = false;
        this.gl?.load(this.gpu, facts.moving);
        this.ui.facts(facts);
        this.ui.error(this.problem);
        this.ui.playing(this.gpu.playing);
        this.apply();
        if (anew) this.moved(-1);
        const { first } = this;
        this.shown = { source: this.source, name: this.name, facts, first };
        if (first && !first.seen) {
            first.seen = true;
            if (first.pose) { this.setPose(first.pose, first.camera); this.seek(first.time); } else followLink(this);
        }
        if (first?.playing && facts.frames > 1) { first.playing = false; this.play(); } else if (played) this.emit("pause", {});
        this.draw();
        this.ui.poster(null);
    }
    // Time
    get time() { return this.gpu?.time ?? 0; }
    get playing() { return this.gpu?.playing ?? false; }
    /// Where the model that is shown stands, and whether it plays as soon as it can.
    get now() { return { pose: this.gpu.pose, camera: this.camera, time: this.time, playing: this.playing || !!this.shown?.first?.playing }; }
    play() { this.setPlaying(true); }
    pause() { this.setPlaying(false); }
    toggle() { this.setPlaying(!this.playing); }
    setPlaying(on) {
        if (!this.gpu) return;
        this.gpu.playing = on && (this.drawnFacts?.frames ?? 1) > 1;
        this.ui.playing(this.gpu.playing);
        this.emit(this.gpu.playing ? "play" : "pause", {});
    }
    seek(time) { this.gpu?.seek(time); this.timeChanged(); }
    step(frames) { if (this.playing) this.pause(); this.gpu?.step(frames); this.timeChanged(); }
    timeChanged() {
        this.dirty = true;
        if (!this.gpu) return;
        const facts = this.drawnFacts, detail = { time: this.gpu.time, frame: this.gpu.frame, seconds: this.gpu.time * (facts?.seconds ?? 0) };
        this.ui.time(detail, facts);
        this.emit("time", detail);
    }
    // View
    reset() { this.gpu?.reset(); this.moved(-1); }
    goTo(index) {
        if (index < 0) return this.reset();
        // A camera that the model does not have leaves the view as it is.
        if (!this.drawnFacts || !(index < this.drawnFacts.cameras.length)) return;
        this.gpu?.goTo(index);
        this.moved(index);
    }
    setPose(pose, camera) {
        const before = String(this.gpu?.pose);
        if (this.gpu) this.gpu.pose = new Float64Array(pose);
        // So does a pose that sees nothing.
        if (camera !== undefined || String(this.gpu?.pose) !== before) this.moved(camera);
    }
    /// The view is another one: that of a camera, or of none.
    moved(camera = "") {
        if (camera !== this.camera) this.ui.camera(this.camera = camera);
        this.dirty = true;
    }
    set(name, value) {
        const names = [...Object.keys(this.settings), "flying"];
        if (!names.includes(name)) throw new Error(`The player has no setting ${name}. Use one of ${names.join(", ")}.`);
        const range = RANGES[name], number = Number.parseFloat(value);
        if (range && !Number.isFinite(number)) throw new Error(`The setting ${name} is a number, and ${String(value)} is none.`);
        const taken = range ? Math.min(Math.max(number, range[0]), range[1]) : !!value;
        if (name === "flying") this.flying = taken; else this.settings[name] = name === "shDegree" ? Math.round(taken) : taken;
        this.ui.settings({ ...this.settings, flying: this.flying });
        this.apply();
    }
    apply() { if (this.gpu) Object.assign(this.gpu, this.settings); this.dirty = true; }
    resize() {
        if (!this.gpu) return;
        const { canvas } = this.ui;
        this.ratio = window.devicePixelRatio;
        const ratio = Math.min(this.ratio || 1, 2);
        // What cannot be drawn becomes smaller.
        const [width, height] = this.gpu.resize(Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio));
        if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
        this.dirty = true;
        this.draw();
    }
    draw() { if (this.gl) { if (this.gpu && !this.gl.lost) this.gl.draw(this.gpu); } else this.gpu?.draw(); this.dirty = false; this.drawn = (this.drawn ?? 0) + 1; }
    loop(now) {
        try { this.advance(now); } catch (e) {
            // Nothing that would draw can be relied on any more. After a panic nothing of it can be called.
            console.error(e);
            if (!(e instanceof WebAssembly.RuntimeError)) {
                this.gl?.free();
                dispose(this.gpu);
            }
            this.gpu = null;
            this.fail(new Error(`The player has stopped (${e.message}). Reload the page.`));
            return;
        }
        // A listener may have ended it.
        if (!this.destroyed) this.request = requestAnimationFrame(next => this.loop(next));
    }
    advance(now) {
        const elapsed = Math.min((now - (this.last ?? now)) / 1000, 0.25);
        this.last = now;
        if (this.gpu && isLost(this)) recover(this);
        else if (this.gpu) {
            // A window that moves to another screen keeps its size in CSS pixels, which is all that an observer sees.
            if (this.ratio !== window.devicePixelRatio) this.resize();
            const was = this.gpu.playing;
            if (this.gpu.tick(elapsed)) this.timeChanged();
            if (was && !this.playing) { this.ui.playing(false); this.emit("pause", {}); }
            if (this.flyKeys(elapsed)) this.dirty = true;
            if (this.dirty) this.draw();
            this.statistics(now);
            const failure = this.gpu?.takeFailure();
            // Others follow from the first.
            if (failure && !this.failure) this.fail(new Error(this.failure = `The graphics device failed (${failure}), most likely because it has too little free memory for this model. Open a smaller one, or this one with \`cc4dgs view\`.`));
        }
    }
    statistics(now) {
        if (now - (this.counted ?? 0) < 1000) return;
        const rate = (this.drawn ?? 0) * 1000 / (now - (this.counted ?? now - 1000));
        [this.counted, this.drawn] = [now, 0];
        const facts = this.drawnFacts;
        if (facts && this.ui.wantsStatistics()) {
            (this.gl ? Promise.resolve(this.gl.visible) : this.gpu.countVisible()).then(visible => this.ui.statistics({ ...facts, rate, visible, received: this.received, adapter: this.gl?.name ?? this.gpu?.adapter }));
        }
    }
    /// Ends the player and empties its element. `load` and `capture` reject from then on, other calls do nothing.
    destroy() {
        if (this.destroyed) return;
        this.life.abort(gone());
        this.abort?.abort();
        cancelAnimationFrame(this.request);
        this.sizes?.disconnect();
        Object.values(this.listeners).forEach(listeners => listeners.clear());
        [this.source, this.own, this.facts, this.shown, this.first] = [null, null, null, null, null];
        release(this);
        this.ui.remove();
        if (players.get(this.container) === this) players.delete(this.container);
    }
    // Images and links
    async capture(camera, time) {
        if (this.destroyed) throw gone();
        return capture(this, camera, time);
    }
    async savePng() {
        if (!this.drawnFacts || !this.gpu) return;
        const name = `frame_${String(this.gpu.frame).padStart(4, "0")}.png`;
        try { await savePng(await this.capture(), name); } catch (e) { this.fail(e); }
    }
    link() { return linkOf(this); }
}
