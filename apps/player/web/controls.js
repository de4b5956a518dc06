// The controls as HTML elements, and what a user takes along: images, links, and what a reload keeps.

function element(tag, properties = {}, ...children) {
    const { attributes = {}, ...own } = properties;
    const made = Object.assign(document.createElement(tag), own);
    Object.entries(attributes).forEach(([name, value]) => made.setAttribute(name, value));
    made.append(...children);
    return made;
}

const labelled = label => ({ attributes: { "aria-label": label }, title: label });
const megabytes = bytes => (bytes >= 1e6 ? `${(bytes / 1e6).toFixed(2)} MB` : `${(bytes / 1e3).toFixed(1)} kB`);

// What gestures and keys do.
const HELP = [
    ["Drag, one finger, arrow keys", "orbit, or look around when flying"], ["Wheel, pinch, + and −", "zoom"], ["Shift-drag, right button, two fingers", "pan"],
    ["W A S D Q E", "fly"], ["F", "switch between orbiting and flying"], ["R", "first view"],
    ["Space", "play and pause"], ["Comma, full stop", "a frame back, a frame on"], ["Home, End", "first and last frame"],
    ["T, Z", "tint what moves, show depth"], ["P", "save a PNG"], ["Escape", "close this"], ["?", "this list"],
];

/// Saves an image of RGBA pixels as the file `download`.
export async function savePng({ width, height, data }, download) {
    const canvas = element("canvas", { width, height });
    canvas.getContext("2d").putImageData(new ImageData(data, width, height), 0, 0);
    const image = await new Promise(done => canvas.toBlob(done, "image/png"));
    if (!image) throw new Error(`The image of ${width}x${height} pixels could not be saved as PNG. Choose a lower resolution.`);
    const href = URL.createObjectURL(image);
    element("a", { href, download }).click();
    setTimeout(() => URL.revokeObjectURL(href), 60000);
}

/// An address with source, time and pose of `player`.
export function linkOf(player) {
    const url = new URL(location.href), { gpu, source, time } = player;
    // A file that was dropped has no address.
    if (typeof source === "string") url.searchParams.set("src", source); else if (source) url.searchParams.delete("src");
    if (gpu) url.hash = `t=${Number(time.toPrecision(6))}&pose=${gpu.poseText}`;
    return url.href;
}

/// Takes time and pose of the page's address.
export function followLink(player) {
    const hash = new URLSearchParams(location.hash.slice(1));
    const pose = hash.get("pose")?.split(",").map(Number);
    // Another number of values than a pose has is ignored.
    if (pose) player.setPose(pose);
    if (hash.has("t")) player.seek(Number(hash.get("t")));
    player.dirty = true;
}

// This page and those of this site that it is a frame of, the innermost first: when each `began`, in milliseconds, and whether it was loaded `again`.
const around = [];
try {
    for (let page = window, inner = null; page !== inner; [page, inner] = [page.parent, page]) {
        // Chromium says "navigate" in a frame of a page that was reloaded.
        const type = page.performance.getEntriesByType("navigation")[0]?.type;
        around.push({ began: page.performance.timeOrigin, again: ["reload", "back_forward"].includes(type) });
    }
} catch { /* A page of another site does not tell. */ }

// Names of the players in this page: several may show the same model.
const names = new Set();

/// Names `player` by the model that it opens, its number among the players of that model, and that of this frame in its page. Until the player is destroyed.
function register({ own, life }) {
    const frame = Array.prototype.indexOf.call(window.parent, window), source = typeof own === "string" ? own : "";
    let name, number = 0;
    do name = `${frame} ${number++} ${source}`; while (names.has(name));
    names.add(name);
    life.signal.addEventListener("abort", () => names.delete(name));
    return name;
}

// Where the state of a player is kept: under the address of its page without time and pose, and its name.
const kept = ({ keptAs }) => `cc4dgs ${location.pathname}${location.search} ${keptAs}`;

/// Has `player` go on as it was after a reload, where it does, and follow links to the page that it is alone. Until `signal` aborts.
export function remember(player, signal) {
    const keep = () => {
        const { settings, flying, gpu, drawnFacts, source, own } = player;
        // The model that was opened last is not the one that a reload opens, unless it is that of the page.
        const view = gpu && drawnFacts && source === own ? { ...player.now, pose: Array.from(gpu.pose) } : null;
        const state = { settings, flying, view, began: around.map(page => page.began) };
        // Some pages have no storage, such as those in frames with `sandbox`.
        try { sessionStorage.setItem(kept(player), JSON.stringify(state)); } catch (e) { console.debug(e); }
    };
    if (player.keptAs) {
        window.addEventListener("pagehide", keep, { signal });
        // Phones end pages that nobody sees without another word.
        document.addEventListener("visibilitychange", () => { if (document.hidden) keep(); }, { signal });
    }
    // Where the page is open already, a link to it changes the hash alone. "Copy link" replaces the address, of which nobody is told.
    if (!player.ui.embedded) window.addEventListener("hashchange", () => followLink(player), { signal });
}

/// Gives `player` the settings that it had before its page was loaded again, once; returns how its model stood then, null where that is not known.
export function restore(player) {
    try {
        player.keptAs = register(player);
        const { settings, flying, view, began } = JSON.parse(sessionStorage.getItem(kept(player))) ?? {};
        if (!settings) return null;
        // A page that began at the same time is still the same: it made this player, or its frame, anew.
        if (!around.some((page, k) => page.again && page.began !== began[k])) return null;
        sessionStorage.removeItem(kept(player));
        for (const name of Object.keys(player.settings)) player.settings[name] = settings[name] ?? player.settings[name];
        player.set("flying", !!flying);
        return view ?? null;
    } catch (e) {
        console.debug(e);
        return null;
    }
}

export function build(container, player) {
    const button = (text, label, onclick) => element("button", { type: "button", textContent: text, onclick, ...labelled(label) });
    // An application gets the keys from screen readers.
    const about = "3D view. Drag or arrow keys orbit, wheel, pinch, plus and minus zoom, shift-drag or two fingers pan. The question mark lists all keys.";
    const canvas = element("canvas", { tabIndex: 0, attributes: { role: "application", "aria-label": about } });
    const poster = element("img", { className: "poster", alt: "", hidden: true });
    const title = element("div", { className: "title" });
    const file = element("input", { type: "file", accept: ".cc4d,.ply,.spz", ...labelled("Open a file"), onchange: () => { if (file.files[0]) open(file.files[0]); file.value = ""; } });
    const openLabel = element("label", { className: "open" }, "Open", file);
    const play = button("▶", "Play", () => player.toggle());
    const time = element("input", { type: "range", min: 0, max: 1, step: 0.0005, value: 0, className: "time", ...labelled("Time"), oninput: () => player.seek(Number(time.value)) });
    // A step of the slider is finer than a frame, so arrow keys would show no change.
    time.addEventListener("keydown", e => {
        const frames = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[e.key];
        if (!frames || e.ctrlKey || e.metaKey || e.altKey) return;
        player.step(frames);
        e.preventDefault();
    });
    // Screen readers would read it out with every frame.
    const clock = element("output", { textContent: "–", attributes: { "aria-live": "off" } });
    const speeds = [0.1, 0.25, 0.5, 1, 2, 4];
    // On phones the bar is too narrow for it.
    const [speed, narrowSpeed] = ["wide", ""].map(className => element("select", { className, ...labelled("Speed"), onchange: e => player.set("speed", Number(e.target.value)) },
        ...speeds.map(v => element("option", { value: v, textContent: `${v}×` }))));
    const loop = button("⟳", "Loop", () => player.set("looping", !player.settings.looping));
    const showPanel = on => { panel.hidden = !on; gear.setAttribute("aria-expanded", String(on)); };
    const gear = button("☰", "Settings and help", () => showPanel(panel.hidden));
    gear.setAttribute("aria-expanded", "false");
    const bar = element("div", { className: "bar", attributes: { role: "group", "aria-label": "Playback" } },
        play, button("‹", "One frame back", () => player.step(-1)), button("›", "One frame on", () => player.step(1)), time, clock, speed, loop);

    const slider = (label, name, min, max, step, text) => {
        const value = element("span");
        const input = element("input", { type: "range", min, max, step, value: player.settings[name], oninput: () => player.set(name, Number(input.value)) });
        return { row: element("label", {}, label, input, value), show: v => { input.value = v; value.textContent = text(v); input.setAttribute("aria-valuetext", text(v)); }, input };
    };
    const check = (label, name) => {
        const input = element("input", { type: "checkbox", onchange: () => player.set(name, input.checked) });
        return { row: element("label", { className: "check" }, input, label), show: v => { input.checked = v; } };
    };
    const controls = {
        scale: slider("Size", "scale", 0.1, 2, 0.05, v => `${Math.round(v * 100)} %`),
        shDegree: slider("SH degree", "shDegree", 0, 4, 1, v => String(v)),
        resolution: slider("Resolution", "resolution", 0.25, 2, 0.05, v => `${Math.round(v * 100)} %`),
        tint: check("Tint what moves", "tint"),
        depth: check("Depth", "depth"),
    };
    const camera = element("select", { ...labelled("Camera"), onchange: () => { player.goTo(Number(camera.value)); } });
    // Selected again, an entry tells nobody: a view that is of no camera has one of its own, which cannot be chosen.
    const cameras = names => {
        const at = camera.value, entry = (value, textContent) => element("option", { value, textContent });
        camera.replaceChildren(Object.assign(entry("", "Free view"), { hidden: true, disabled: true }), entry(-1, "Home"), ...names.map((name, i) => entry(i, name)));
        ui.camera(at);
    };
    const fly = button("Fly", "Fly with W A S D Q E, drag to look", () => player.set("flying", !player.flying));
    const share = button("Copy link", "Copy link with time and pose", async () => {
        const link = player.link();
        let failed = "In address bar";
        // A frame of `srcdoc` has no address to change.
        try { history.replaceState(history.state, "", link); } catch { failed = "Not copied"; }
        try { await navigator.clipboard.writeText(link); share.textContent = "Copied"; } catch { share.textContent = failed; }
        setTimeout(() => { share.textContent = "Copy link"; }, 1500);
        if (player.source instanceof Blob) ui.note("The link has time and pose, but not the file: who follows it has to open the file, too.");
    });
    // What it says after a click is its name then.
    share.removeAttribute("aria-label");
    const topic = element("summary", { textContent: "Keys and gestures" });
    const help = element("details", {}, topic, element("dl", {}, ...HELP.flatMap(([keys, does]) => [element("dt", { textContent: keys }), element("dd", { textContent: does })])));
    const stats = element("p", { className: "stats" });
    const panel = element("section", { className: "panel", hidden: true, ...labelled("Settings") },
        element("label", {}, "Camera", camera),
        element("div", { className: "row" }, button("Reset", "Reset to the first view", () => player.reset()), fly),
        element("label", { className: "narrow" }, "Speed", narrowSpeed),
        ...Object.values(controls).map(c => c.row),
        element("div", { className: "row" }, button("PNG", "Save the image as PNG", () => player.savePng()), share),
        help,
        stats);
    panel.removeAttribute("title");
    // Controls of time, which a model without motion does not need.
    const playable = on => [...bar.querySelectorAll("button, input, select"), narrowSpeed].forEach(c => { c.disabled = !on; });
    const note = element("div", { className: "note", attributes: { role: "status" } });
    const progress = element("div", { className: "progress", hidden: true, attributes: { role: "progressbar", "aria-label": "Loading" } });
    const top = element("div", { className: "top" }, title, openLabel, gear);
    const root = element("div", { className: "cc" }, canvas, poster, progress, top, panel, bar, note);
    container.replaceChildren(root);
    // A page that is not the player alone keeps its own look and title.
    const embedded = !container.matches("body > main");
    // One player that is the page alone keeps the page's look, whatever is added.
    document.documentElement.classList.toggle("cc-embedded", !document.querySelector("body > main > .cc"));

    const open = source => player.load(source).catch(() => {});
    const close = () => {
        if (note.hidden) return;
        note.hidden = true;
        ui.canvas.focus({ preventScroll: true });
    };
    const say = (text, error) => {
        note.hidden = !text;
        note.className = error ? "note error" : player.facts ? "note hint" : "note";
        note.setAttribute("role", error ? "alert" : "status");
        note.replaceChildren(element("p", { textContent: text ?? "" }), ...(text && player.facts ? [button("Close", "Close", close)] : []));
    };
    let depth = 0;
    const drag = (name, run) => root.addEventListener(name, e => { e.preventDefault(); run(e); root.classList.toggle("dropping", depth > 0); });
    drag("dragenter", () => depth++);
    drag("dragleave", () => depth--);
    drag("dragover", () => {});
    drag("drop", e => {
        depth = 0;
        const [dropped] = e.dataTransfer.files;
        if (dropped) open(dropped); else ui.note("Only files can be dropped here. Save it first, as a .cc4d, .ply or .spz file.");
    });

    const ui = {
        root, canvas, embedded,
        remove: () => { ui.poster(null); root.remove(); },
        replaceCanvas: () => {
            const old = ui.canvas, focused = root.getRootNode().activeElement === old;
            ui.canvas = old.cloneNode();
            old.replaceWith(ui.canvas);
            // What is removed loses the focus, and keys would reach the player no more.
            if (focused) ui.canvas.focus({ preventScroll: true });
        },
        title: text => { title.textContent = text; if (!embedded) document.title = `${text} – cc4dgs player`; },
        error: text => say(text, true),
        note: text => say(text, false),
        loading: on => { progress.hidden = !on; if (on) { progress.style.width = "2%"; progress.removeAttribute("aria-valuenow"); if (!player.facts) say("Loading …"); } },
        progress: share => { const percent = Math.round(100 * Math.min(share, 1)); progress.style.width = `${percent}%`; progress.setAttribute("aria-valuenow", percent); },
        poster: bytes => {
            if (poster.src) URL.revokeObjectURL(poster.src);
            poster.hidden = !bytes;
            if (bytes) { poster.src = URL.createObjectURL(new Blob([bytes])); note.hidden = true; } else poster.removeAttribute("src");
        },
        facts: facts => {
            note.hidden = true;
            const still = facts.frames < 2;
            playable(!still);
            time.step = still ? 1 : 0.0005;
            cameras(facts.cameras);
            // All degrees of one model mean all degrees of the next.
            const { input } = controls.shDegree, all = player.settings.shDegree >= Number(input.max);
            input.max = facts.shDegree;
            player.settings.shDegree = all ? facts.shDegree : Math.min(player.settings.shDegree, facts.shDegree);
            ui.settings({ ...player.settings, flying: player.flying });
            ui.time({ time: player.time, frame: player.gpu.frame, seconds: player.time * facts.seconds }, facts);
        },
        /// There is nothing to play or to look at.
        empty: () => {
            playable(false);
            cameras([]);
            clock.textContent = "–";
            stats.textContent = "";
            ui.playing(false);
        },
        time: ({ time: t, frame, seconds }, facts) => {
            if (document.activeElement !== time || Math.abs(time.value - t) > 0.001) time.value = t;
            const text = facts && facts.frames > 1 ? `${frame + 1} / ${facts.frames} · ${seconds.toFixed(2)} s` : "still";
            clock.textContent = text;
            time.setAttribute("aria-valuetext", `frame ${frame + 1}, ${seconds.toFixed(2)} seconds`);
        },
        playing: on => { play.textContent = on ? "❚❚" : "▶"; play.title = on ? "Pause" : "Play"; play.setAttribute("aria-label", play.title); },
        settings: values => {
            Object.entries(controls).forEach(([name, control]) => control.show(values[name]));
            loop.setAttribute("aria-pressed", String(values.looping));
            fly.setAttribute("aria-pressed", String(values.flying));
            [speed, narrowSpeed].forEach(select => { select.value = values.speed; });
        },
        /// Shows that the view is of the camera `index`: -1 is home, "" none.
        camera: index => {
            camera.value = index;
            if (camera.selectedIndex < 0) camera.value = "";
        },
        wantsStatistics: () => !panel.hidden,
        statistics: s => {
            stats.textContent = `${s.rate.toFixed(0)} frames/s, ${s.visible.toLocaleString("en")} of ${s.gaussians.toLocaleString("en")} Gaussians drawn\n` +
                `${s.moving.toLocaleString("en")} move, ${megabytes(s.received ?? s.bytes)} fetched of ${megabytes(s.bytes)}, ${megabytes(s.gpuBytes)} on the GPU\n${s.adapter ?? ""}`;
        },
        /// Closes the settings, else what is said over the model.
        dismiss: () => {
            // What is hidden loses the focus, and keys would reach the player no more.
            if (panel.contains(document.activeElement)) gear.focus();
            if (panel.hidden && player.facts) close();
            showPanel(false);
        },
        /// Shows the list of keys.
        help: () => {
            showPanel(true);
            help.open = true;
            topic.focus();
        },
    };
    ui.settings({ ...player.settings, flying: false });
    ui.empty();
    ui.camera(-1);
    say("Open a .cc4d, .ply or .spz file, or drop one here.");
    return ui;
}
