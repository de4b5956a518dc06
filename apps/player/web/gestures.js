// Mouse, touch and keyboard on the canvas.

/// `act` has orbit, look, pan, zoom, fly, and `mode()`, which is "orbit" or "fly".
export function addGestures(canvas, act) {
    const pointers = new Map();
    let spread = 0, middle = null;
    const measure = () => {
        const [a, b] = [...pointers.values()];
        return { spread: Math.hypot(a.x - b.x, a.y - b.y), middle: { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 } };
    };
    canvas.addEventListener("pointerdown", e => {
        canvas.focus({ preventScroll: true });
        canvas.setPointerCapture(e.pointerId);
        pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
        if (pointers.size === 2) ({ spread, middle } = measure());
    });
    canvas.addEventListener("pointermove", e => {
        const last = pointers.get(e.pointerId);
        if (!last) return;
        const [dx, dy] = [e.clientX - last.x, e.clientY - last.y];
        pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
        const height = canvas.clientHeight || 1;
        if (pointers.size === 2) {
            const now = measure();
            if (spread > 0) act.zoom(now.spread / spread);
            act.pan(-(now.middle.x - middle.x) / height, -(now.middle.y - middle.y) / height);
            ({ spread, middle } = now);
        } else if (e.buttons & 6 || e.shiftKey) {
            act.pan(-dx / height, -dy / height);
        } else if (act.mode() === "fly") {
            act.look(-2 * dx / height, -2 * dy / height);
        } else {
            act.orbit(-4 * dx / height, 4 * dy / height);
        }
    });
    const up = e => {
        pointers.delete(e.pointerId);
        if (pointers.size === 2) ({ spread, middle } = measure());
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("contextmenu", e => e.preventDefault());
    canvas.addEventListener("wheel", e => {
        e.preventDefault();
        // A notch of a wheel is about 100 pixels, 3 lines or a page.
        const pixels = e.deltaY * [1, 100 / 3, 100][e.deltaMode];
        act.zoom(Math.exp(-pixels * 0.0015));
    }, { passive: false });
}

const FLY = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };

/// Keys: held ones fly, others are commands by name. Returns a function that moves by the keys that are held for so many seconds; whether any were.
export function addKeys(element, act, commands) {
    const held = new Set();
    element.addEventListener("keydown", e => {
        if (e.ctrlKey || e.metaKey || e.altKey || e.target.closest("select, input:not([type=range]):not([type=checkbox]):not([type=file])")) return;
        const key = e.key.length === 1 ? e.key.toLowerCase() : e.key;
        if (FLY[key]) { held.add(key); e.preventDefault(); return; }
        // Buttons and sliders keep the keys they know.
        const own = e.target.matches("button, input") && (key === " " || key === "Enter" || key.startsWith("Arrow") || key === "Home" || key === "End");
        if (commands[key] && !own) { commands[key](); e.preventDefault(); }
    });
    element.addEventListener("keyup", e => held.delete(e.key.toLowerCase()));
    element.addEventListener("focusout", () => held.clear());
    // Where nothing has the focus, nothing loses it with the window.
    window.addEventListener("blur", () => held.clear());
    return seconds => {
        for (const key of held) act.fly(...FLY[key].map(v => v * seconds));
        return held.size > 0;
    };
}
