// Fetches a model and shows what has arrived: poster, then the Gaussians in colours of degree 0, layer by layer, then their motion, then the harmonics, degree by degree.
// Ranges where the server has them, else the whole file; streams that only the desktop needs are not fetched.

const FIRST = 65536;
// All layers, or all degrees.
const ALL = 255;
// Largest file in bytes: `LIMITS` of src/web/mod.rs.
const MOST_BYTES = 2 ** 30;
const MAGIC = [0x89, 0x43, 0x43, 0x34, 0x44, 0x0d, 0x0a, 0x1a];

/// A connection that broke.
class Broken extends Error {}

/// What `read` reads of the response for `name`.
async function received(name, read) {
    try { return await read(); } catch (e) {
        if (e.name === "AbortError") throw e;
        throw new Broken(`${name} arrived in part: the connection broke (${e.message}). Load it again.`);
    }
}

/// `run()`, and a second time where the connection breaks.
async function twice(run) {
    try { return await run(); } catch (e) {
        if (!(e instanceof Broken)) throw e;
        console.warn(`${e.message} The page tries once more.`);
    }
    await new Promise(done => setTimeout(done, 500));
    return run();
}

/// Frees `download`, unless a panic has left it borrowed: that is an error already.
function free(download) {
    try { download.free(); } catch (e) { console.warn(e); }
}

/// Calls `sink(offset, bytes)` with all that arrives of `response` for `name`, which begins at byte `offset`, until it returns false.
async function drain(name, response, offset, sink) {
    if (!response.body) {
        const bytes = new Uint8Array(await received(name, () => response.arrayBuffer()));
        sink(offset, bytes);
        return offset + bytes.length;
    }
    const reader = response.body.getReader();
    for (;;) {
        const { done, value } = await received(name, () => reader.read());
        if (done) return offset;
        let go = false;
        // Where showing it fails, too, the rest is not fetched.
        try { go = sink(offset, value); } finally {
            // A connection that breaks now harms nothing.
            if (go === false) await reader.cancel().catch(() => {});
        }
        offset += value.length;
        if (go === false) return offset;
    }
}

/// What of an archive has arrived, and what can be shown of it.
class Progress {
    constructor(wasm, name, total, show) {
        this.download = new wasm.Download(name, total);
        this.name = name;
        this.show = show;
        this.total = total;
        this.arrived = 0;
        this.header = 0;
        this.streams = null;
        this.shown = { poster: false, layer: -1, motion: false, degree: 0 };
        // The degree that waits to be shown, since when, and how long showing took at most, in milliseconds.
        this.waiting = { degree: 0, since: 0 };
        this.took = 0;
    }
    /// The last stage of `kind` of which, and of those before, everything is there: `none` for none, ALL for all.
    reached(kind, none) {
        const streams = this.streams.filter(s => s.kind === kind);
        const missing = streams.filter(s => this.arrived < s.offset + s.bytes).map(s => s.stage);
        if (!missing.length) return ALL;
        const first = Math.min(...missing);
        return Math.max(none, ...streams.filter(s => s.stage < first).map(s => s.stage));
    }
    end(kind) { return Math.max(0, ...this.streams.filter(s => s.kind === kind).map(s => s.offset + s.bytes)); }
    /// Bytes that a player needs; the rest of the file is not fetched.
    get needed() { return this.streams ? Math.max(this.header, ...["canonical", "playback", "harmonics"].map(kind => this.end(kind))) : this.total; }
    put(offset, bytes) {
        this.download.put(offset, bytes);
        this.arrived = Math.max(this.arrived, offset + bytes.length);
        return this.advance();
    }
    /// Shows what newly can be; false once nothing more is needed.
    advance() {
        if (!this.header && this.arrived >= Math.min(24, this.total)) this.header = this.download.headerEnd();
        if (this.header && !this.streams && this.arrived >= Math.min(this.header, this.total)) this.streams = JSON.parse(this.download.streams());
        if (!this.streams) return true;
        const { shown, show, download } = this, has = kind => this.arrived >= this.end(kind);
        if (!shown.poster && this.end("poster") && has("poster")) { shown.poster = true; show.poster(download.poster()); }
        show.progress(this.arrived / this.needed, this.arrived);
        // All that has arrived at once is shown at once: a file that is there as a whole is decoded once.
        const motion = has("canonical") && has("playback"), layer = this.reached("canonical", -1), degree = layer === ALL ? this.reached("harmonics", 0) : 0;
        if (motion && !shown.motion || layer > shown.layer) {
            this.timed(() => show.part(download, layer, motion, degree, shown.layer < 0));
            Object.assign(shown, { layer, motion, degree });
        } else if (degree > shown.degree && this.isDue(degree)) {
            this.timed(() => show.harmonics(download, degree));
            shown.degree = degree;
        }
        return this.arrived < this.needed;
    }
    timed(run) {
        const began = performance.now();
        run();
        this.took = Math.max(this.took, performance.now() - began);
    }
    /// Whether the harmonics up to `degree` are shown now. That decodes all that has arrived, so a degree waits for as long as showing takes, and gives way to the
    /// next one where that is there by then.
    isDue(degree) {
        const now = performance.now();
        if (degree !== this.waiting.degree) this.waiting = { degree, since: now };
        return degree === ALL || now - this.waiting.since >= this.took;
    }
    finish() {
        if (!this.shown.motion || this.shown.degree < ALL) throw new Error(`${this.name} arrived in part: ${this.arrived} of ${this.total} bytes. Load it again; where that does not help, check the file on its server.`);
    }
}

/// The last part of an address; what is not encoded as addresses are stays as it is.
export function nameOf(path) {
    const last = path.split(/[?#]/)[0].split("/").pop() || "model";
    try { return decodeURIComponent(last); } catch { return last; }
}

/// Refuses a file that is too large for the page before it is in memory.
export function checkSize(name, bytes) {
    if (bytes > MOST_BYTES) throw new Error(`${name} has ${(bytes / 1e9).toFixed(2)} GB, more than the ${(MOST_BYTES / 1e9).toFixed(2)} GB that the page opens. Open it on the desktop: cc4dgs view FILE`);
}

/// The bytes of `file`, a File or another Blob, for `name`.
export async function bytesOf(name, file) {
    try { return await file.arrayBuffer(); } catch (e) {
        throw new Error(`${name} could not be read (${e.message}). Choose a file, not a folder; where it was moved or changed meanwhile, choose it again.`);
    }
}

function isArchive(bytes) { return MAGIC.every((b, i) => bytes[i] === b); }

/// Loads `url`; `show` has poster(bytes), part(download, layer, motion, degree, first), harmonics(download, degree), whole(name, bytes), progress(share, bytes).
export async function loadUrl(wasm, url, show, signal) {
    const name = nameOf(url);
    const get = async headers => {
        let response;
        try { response = await fetch(url, { headers, signal }); } catch (e) {
            if (e.name === "AbortError") throw e;
            throw new Broken(`${name} could not be fetched (${e.message}). Check the address; the server must allow this page to read it.`);
        }
        // No byte of what is asked for exists.
        if (response.status === 416) throw new Error(`${name} is empty, or was replaced by a shorter file on its server while it was loaded. Check the file there, and load it again.`);
        if (!response.ok) throw new Error(`${name} could not be fetched: the server answered ${response.status}. Check the address.`);
        return response;
    };
    // The whole file, of which `response` may be there.
    const body = response => twice(async () => {
        const own = response ?? await get({});
        response = null;
        return loadBody(wasm, name, own, show);
    });
    const sizeOf = response => (response.status === 206 ? Number(/\/(\d+)$/.exec(response.headers.get("Content-Range") || "")?.[1] ?? NaN) : NaN);
    let first, start;
    try {
        [first, start] = await twice(async () => {
            const response = await get({ Range: `bytes=0-${FIRST - 1}` });
            return [response, sizeOf(response) >= 0 ? new Uint8Array(await received(name, () => response.arrayBuffer())) : null];
        });
    } catch (e) {
        // Browsers refuse a compressed answer to a request for a part.
        if (e instanceof Broken) return body(null);
        throw e;
    }
    if (!start) {
        if (first.status !== 206) return body(first);
        // Another site need not tell how long the file is, and a part of unknown length is no file.
        await first.body?.cancel().catch(() => {});
        return body(null);
    }
    const total = sizeOf(first);
    if (!isArchive(start)) {
        if (start.length >= total) return show.whole(name, start);
        checkSize(name, total);
        return body(null);
    }
    const condition = unchanged(first);
    const progress = new Progress(wasm, name, total, show);
    let whole = null;
    try {
        let more = progress.put(0, start);
        while (more && progress.arrived < total) {
            const before = progress.arrived;
            whole = await twice(async () => {
                // The header first, then everything that is needed.
                const end = progress.streams ? progress.needed : Math.max(progress.header, 24), { arrived } = progress;
                const part = await get({ ...condition, Range: `bytes=${arrived}-${Math.max(end, arrived + 1) - 1}` });
                if (part.status !== 206) return part;
                if (sizeOf(part) !== total) throw new Error(`${name} was replaced on its server while it was loaded. Load it again.`);
                await drain(name, part, arrived, (offset, bytes) => (more = progress.put(offset, bytes)));
                return null;
            });
            if (whole || progress.arrived === before) break;
        }
        if (!whole) progress.finish();
    } finally { free(progress.download); }
    // A server that stops answering with ranges, or has another file by now, sends the whole file.
    if (whole) return body(whole);
}

/// Headers that make a server answer with a part only of the file that `response` is of. Other sites would have to allow the header.
function unchanged(response) {
    if (response.type === "cors") return {};
    const tag = response.headers.get("ETag"), version = tag && !tag.startsWith("W/") ? tag : response.headers.get("Last-Modified");
    return version ? { "If-Range": version } : {};
}

/// The whole file in one answer.
async function loadBody(wasm, name, response, show) {
    // Of a compressed answer it is the compressed length, and another site need not tell that it compresses.
    const encoded = response.type === "cors" || response.headers.get("Content-Encoding");
    const total = encoded ? 0 : Number(response.headers.get("Content-Length")) || 0;
    const pieces = [];
    let progress = null, size = 0;
    checkSize(name, total);
    try {
        await drain(name, response, 0, (offset, bytes) => {
            size += bytes.length;
            if (!progress && offset === 0 && total && isArchive(bytes)) progress = new Progress(wasm, name, total, show);
            if (progress) return progress.put(offset, bytes);
            checkSize(name, size);
            pieces.push(bytes);
            show.progress(total ? size / total : 0.5, size);
            return true;
        });
        if (progress) return progress.finish();
    } finally { if (progress) free(progress.download); }
    show.whole(name, new Uint8Array(await new Blob(pieces).arrayBuffer()));
}
