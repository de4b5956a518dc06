// The graphics device of a player: WebGPU or WebGL2, another one where it is lost, and images of what it draws.

import * as wasm from "./cc4dgs_player.js";
import { WebGl } from "./webgl.js";

// A lost device is replaced at most so often in a row; a device that was kept for so many milliseconds ends the row.
const MOST_RECOVERIES = 3;
const KEPT_MS = 60000;

/// Gives `player` a device: WebGPU where there is an adapter, else WebGL2. A canvas keeps the interface that it had first: WebGL2 stays on its own, and takes a new one
/// after WebGPU.
export async function startDevice(player) {
    const { ui, life } = player;
    const forced = player.backend === "webgl" || player.gl;
    if (!forced && await navigator.gpu?.requestAdapter()) {
        player.isWebGpus = true;
        try {
            player.gpu = await wasm.Player.create(ui.canvas);
            return;
        } catch (e) {
            // An adapter without the device that is needed.
            console.warn(`WebGPU: ${e.message}`);
        }
    }
    if (player.isWebGpus) {
        player.isWebGpus = false;
        ui.replaceCanvas();
    }
    // A lost context stays that of its canvas until the browser restores it.
    if (player.gl?.gl.isContextLost()) {
        const late = () => player.fail(new Error("The graphics device was lost, and the browser has not given WebGL2 back yet. Wait, or reload the page."));
        if (await player.gl.restored(late, life.signal)) ui.error(null);
    }
    player.gl?.free();
    player.gl = new WebGl(ui.canvas, () => { player.dirty = true; });
    player.gpu = wasm.Player.plain(ui.canvas.width, ui.canvas.height, player.gl.mostWords, player.gl.mostSide);
}

/// Whether the device of `player`, which has one, is lost.
export function isLost({ gl, gpu }) { return gl ? gl.lost : gpu.lost; }

/// Replaces the lost device of `player`, and loads the same model at the same time and pose.
export async function recover(player) {
    const { gpu: old, source, name } = player;
    // A model that nobody has seen yet starts as it would have.
    const first = player.shown?.source === source ? player.now : player.first;
    player.gpu = null;
    // What is still being loaded has nothing to go to; it begins anew.
    player.abort?.abort();
    const { abort } = player;
    const losses = player.losses = performance.now() - (player.keptSince ?? -Infinity) < KEPT_MS ? player.losses + 1 : 1;
    player.keptSince = Infinity;
    try {
        [player.facts, player.shown] = [null, null];
        old.free();
        if (losses > MOST_RECOVERIES) throw new Error(`The graphics device was lost ${losses} times in a row, most likely because the model is too large for it. Reload the page with another model, or open this one with \`cc4dgs view\`.`);
        await player.start();
        // Unless another model was opened meanwhile.
        if (source && player.abort === abort) await player.load(source, name, first);
        player.emit("recovered", {});
    } catch (e) {
        if (!player.gpu) player.ui.empty();
        player.fail(e);
    } finally {
        // A device that was lost meanwhile has a recovery of its own.
        if (player.losses === losses) player.keptSince = performance.now();
    }
}

/// Gives the device and the model of `gpu` back.
export function dispose(gpu) {
    // A panic leaves it borrowed.
    try { gpu?.loseDevice(); gpu?.free(); } catch (e) { console.warn(e); }
}

/// Gives everything back that `player` has on the graphics card, and its model.
export function release(player) {
    const { gpu, gl } = player;
    [player.gpu, player.gl] = [null, null];
    gl?.destroy();
    dispose(gpu);
}

/// The RGBA pixels of the current view of `player`, or of `camera` at `time`: `{ width, height, data }`.
export async function capture(player, camera, time) {
    const { gpu, gl } = player;
    const none = () => new Error("There is no graphics device to draw an image with. Wait for \"recovered\", or reload the page.");
    if (!gpu || isLost(player)) throw none();
    const json = camera ? JSON.stringify(camera) : undefined;
    if (gl) {
        const image = gl.capture(gpu, json, time);
        // A context that was lost meanwhile reports no error: the pixels are zeros.
        if (gl.lost) throw none();
        return image;
    }
    const image = await gpu.capture(json, time);
    const out = { width: image.width, height: image.height, data: image.rgba };
    image.free();
    return out;
}
