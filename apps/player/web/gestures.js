// Mouse, touch and keyboard on the canvas.

/// `act` has orbit, look, pan, zoom, fly, and `mode()`, which is "orbit" or "fly". Until `signal` aborts.
export function addGestures(canvas, act, signal) {
    const listen = (name, run, options) => canvas.addEventListener(name, run, { signal, ...options });
    const pointers = new Map();
    let spread = 0, middle = null;
    const measure = () => {
        const [a, b] = [...pointers.values()];
        return { spread: Math.hypot(a.x - b.x, a.y - b.y), middle: { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 } };
    };
    listen("pointerdown", e => {
        canvas.focus({ preventScroll: true });
        canvas.setPointerCapture(e.pointerId);
        pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
        if (pointers.size === 2) ({ spread, middle } = measure());
    });
    listen("pointermove", e => {
        const last = pointers.get(e.pointerId);
        if (!last) return;
        const [dx, dy] = [e.clientX - last.x, e.clientY - last.y];
        pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
        const height = canvas.clientHeight || 1;
        // More than two fingers do what the first two of them do.
        if (pointers.size > 1) {
            const now = measure();
            if (spread > 0) act.zoom(now.spread / spread);
            act.pan(-(now.middle.x - middle.x) / height, -(now.middle.y - middle.y) / height);
            ({ spread, middle } = now);
        } else if (e.buttons & 6 || e.shiftKey) {
            act.pan(-dx / height, -dy / height);
        } else if (act.mode() === "fly") {
            act.look(-2 * dx / height, 2 * dy / height);
        } else {
            act.orbit(-4 * dx / height, 4 * dy / height);
        }
    });
    const up = e => {
        pointers.delete(e.pointerId);
        if (pointers.size > 1) ({ spread, middle } = measure());
    };
    listen("pointerup", up);
    listen("pointercancel", up);
    // Without the capture nobody tells that a pointer is up.
    listen("lostpointercapture", up);
    listen("contextmenu", e => e.preventDefault());
    listen("wheel", e => {
        e.preventDefault();
        // A notch of a wheel is about 100 pixels, 3 lines or a page.
        const pixels = e.deltaY * [1, 100 / 3, 100][e.deltaMode];
        // Pinching a touch pad is told as a wheel with Ctrl, in 100 times the logarithm of the zoom; so much at once is a real wheel.
        act.zoom(Math.exp(e.ctrlKey ? -0.01 * Math.max(-15, Math.min(15, pixels)) : -0.0015 * pixels));
    }, { passive: false });
    // Safari tells of a pinch on a touch pad by events of its own, and of one on a screen by these and by pointers.
    let scale = 1;
    listen("gesturestart", e => { e.preventDefault(); scale = e.scale; });
    listen("gesturechange", e => {
        e.preventDefault();
        if (!pointers.size) act.zoom(e.scale / scale);
        scale = e.scale;
    });
}

// Keys that switch something or save a file: held down, they do it once.
const ONCE = new Set([" ", "k", "f", "t", "z", "p", "?"]);
// Keys that move a slider.
const SLIDE = /^(Arrow(Left|Right|Up|Down)|Home|End|PageUp|PageDown)$/;
const FLY = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };

/// What `player` does at a key; `act` moves its camera.
export function commandsOf(player, act) {
    // A single frame has no first and last one.
    const go = time => { if (player.drawnFacts?.frames > 1) player.seek(time); };
    const turn = (right, upwards) => (act.mode() === "fly" ? act.look : act.orbit)(right, upwards);
    return {
        " ": () => player.toggle(), "k": () => player.toggle(), ",": () => player.step(-1), ".": () => player.step(1),
        ArrowLeft: () => turn(-0.08, 0), ArrowRight: () => turn(0.08, 0), ArrowUp: () => turn(0, 0.08), ArrowDown: () => turn(0, -0.08),
        "+": () => act.zoom(1.1), "=": () => act.zoom(1.1), "-": () => act.zoom(1 / 1.1), Home: () => go(0), End: () => go(1),
        "r": () => player.reset(), "f": () => player.set("flying", !player.flying), "t": () => player.set("tint", !player.settings.tint),
        "z": () => player.set("depth", !player.settings.depth), "p": () => player.savePng(), "Escape": () => player.ui.dismiss(),
        "?": () => player.ui.help(),
    };
}

/// What a key is called here: what it types, letters in lower case, or its name. On layouts without Latin letters it has the letter of its position (`code`), as in
/// the window of `cc4dgs view`.
function nameOfKey({ key, code }) {
    // Chromium tells of a field that it fills in by a key without a name.
    if (key?.length !== 1) return key ?? "";
    const letter = /^[!-~ ]$/.test(key) ? key : /^Key([A-Z])$/.exec(code)?.[1] ?? key;
    return letter.toLowerCase();
}

/// Keys, until `signal` aborts: held ones fly, others are commands by name. Returns a function that moves by the keys that are held for so many seconds; whether any
/// were.
export function addKeys(element, act, commands, signal) {
    // Names of the keys that are held, by position: the layout may change meanwhile, and with it what a key types.
    const held = new Map();
    const positionOf = e => e.code || nameOfKey(e);
    const listen = (target, name, run) => target.addEventListener(name, run, { signal });
    listen(element, "keydown", e => {
        // macOS tells of no key that is released while Cmd is held.
        if (e.metaKey) held.clear();
        // Another player, inside of this one's page, has acted on it.
        if (e.defaultPrevented || e.ctrlKey || e.metaKey || e.altKey) return;
        const key = nameOfKey(e);
        // Lists choose by letters, and a page may have text fields beside the player.
        const types = e.target.isContentEditable || e.target.closest("select, textarea, input:not([type=range]):not([type=checkbox]):not([type=file])");
        if (key !== "Escape" && types) return;
        if (FLY[key]) { held.set(positionOf(e), key); e.preventDefault(); return; }
        // Sliders keep the keys that move them, buttons and boxes those that press them.
        const own = e.target.matches("input[type=range]") ? SLIDE.test(key) : e.target.matches("button, input, summary") && (key === " " || key === "Enter");
        if (!commands[key] || own) return;
        if (!e.repeat || !ONCE.has(key)) commands[key]();
        e.preventDefault();
    });
    listen(element, "keyup", e => { if (e.key === "Meta") held.clear(); else held.delete(positionOf(e)); });
    listen(element, "focusout", () => held.clear());
    // Where nothing has the focus, nothing loses it with the window.
    listen(window, "blur", () => held.clear());
    return seconds => {
        for (const key of new Set(held.values())) act.fly(...FLY[key].map(v => v * seconds));
        return held.size > 0;
    };
}
