"""Checks of browser.py: the worker that sorts for WebGL2."""
from browser_pages import MODEL, say

# The canvas can be read only in the task that drew it.
STILL = """async () => {
    const { canvas } = cc4dgs.ui, copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
    cc4dgs.draw();
    copy.drawImage(canvas, 0, 0);
    const shown = copy.getImageData(0, 0, canvas.width, canvas.height).data, { data } = await cc4dgs.capture();
    return { settled: cc4dgs.gl.settled, pixels: data.length / 4, same: shown.length === data.length && shown.every((v, i) => v === data[i]),
        seen: data.some((v, i) => i % 4 < 3 && v !== data[i % 4]) };
}"""
MOVE = "([time, turn]) => { cc4dgs.seek(time); cc4dgs.gpu.orbit(turn, 0.1); cc4dgs.draw(); return cc4dgs.gl.settled; }"
SETTLED = "cc4dgs.gl.settled && !cc4dgs.dirty"
# Whether the order stays where φ of another head than the centres' changes, and where theirs does; null if the model has no such heads.
HEADS = """() => {
    const { gl, gpu } = cc4dgs, bytes = gpu.plainFrame().slice(), functions = gpu.plainFunctions(), heads = new Uint32Array(bytes.buffer, 176, 20);
    const other = [4, 8, 12, 16].find(head => heads[head + 3]);
    const stays = at => { functions[at] += 1; gl.order(bytes, functions, false); return gl.settled; };
    return heads[3] && other ? [stays(heads[other + 2]), stays(heads[2])] : null;
}"""
FAILURE = "cc4dgs.gl.sorter.worker.dispatchEvent(new ErrorEvent('error', { message: 'on purpose', cancelable: true }))"

# Draws frames of four times and views, each with its own order, and the last one again. Returns how often that allocates or writes memory of the graphics card.
WRITES = """() => {
    const { gl, sorter } = cc4dgs.gl, own = WebGL2RenderingContext.prototype, counts = {};
    const names = ["createTexture", "texImage2D", "texStorage2D", "createBuffer", "bufferData", "texSubImage2D", "bufferSubData"];
    for (const name of names) {
        counts[name] = 0;
        gl[name] = (...all) => { counts[name]++; return own[name].apply(gl, all); };
    }
    for (let k = 1; k < 5; k++) {
        cc4dgs.seek(k / 5), cc4dgs.gpu.orbit(0.3, 0);
        // Without an order the page sorts at once.
        sorter.order = null;
        cc4dgs.draw();
    }
    cc4dgs.draw();
    names.forEach(name => { delete gl[name]; });
    return counts;
}"""
CAPACITY = "[cc4dgs.gl.capacity, cc4dgs.facts.gaussians]"

# Milliseconds of a sort on the page's thread.
SORT = """() => { const { sorter } = cc4dgs.gl, began = performance.now();
    for (let i = 0; i < 5; i++) sorter.sort(sorter.view);
    return (performance.now() - began) / 5; }"""


def still(page, what):
    """Waits for the order of the current view, and compares the canvas with an exact capture."""
    page.wait_for_function(SETTLED)
    found = page.evaluate(STILL)
    assert found["settled"] and found["seen"] and found["same"], f"{what}: the image on the canvas is not the exact one: {found}"


def sorting(pages, page):
    """`page` shows the model with WebGL2 and stands still."""
    assert page.evaluate("!!cc4dgs.gl.sorter.worker"), "the page sorts without a worker"
    assert not page.evaluate(MOVE, [0.7, 0.9]), "the frame after a jump had its order at once: nothing was left to the worker"
    still(page, "after seeking and orbiting")
    page.evaluate("window.draws = 0; window.draw = cc4dgs.draw; cc4dgs.draw = function () { draws++; draw.call(this); }; 0")
    page.wait_for_timeout(500)
    assert page.evaluate("draws") == 0, "the page draws although nothing changes"
    page.evaluate("cc4dgs.draw = draw; 0")
    heads = page.evaluate(HEADS)
    assert heads == [True, False], f"the order does not follow the functions of the centres alone: {heads}"
    still(page, "after functions that were not the frame's")
    *allocations, textures, buffers = page.evaluate(WRITES).values()
    assert not any(allocations) and textures == buffers == 4, f"frames allocate memory {allocations} times, and write it {textures} and {buffers} times"
    still(page, "after frames that were written in turn")
    capacity, gaussians = page.evaluate(CAPACITY)
    assert capacity == gaussians, f"the order has a capacity of {capacity} for {gaussians} Gaussians"
    ms = page.evaluate(SORT)

    # Another model while an answer is under way.
    page.evaluate(MOVE, [0.2, -2.5])
    page.evaluate("address => cc4dgs.load(address).then(() => 0)", MODEL + "?again")
    still(page, "after a model that was loaded while the worker sorted")

    # A worker that fails, and the next model after it.
    page.evaluate(FAILURE)
    assert page.evaluate("cc4dgs.gl.sorter.worker") is None and page.evaluate(MOVE, [0.5, 0.6]), "without its worker the page does not sort by itself"
    still(page, "after the worker failed")
    page.evaluate("address => cc4dgs.load(address).then(() => 0)", MODEL)
    assert page.evaluate("!!cc4dgs.gl.sorter.worker"), "the next model has no worker"
    say(f"frames write to memory that is there; the worker sorts what is shown; still images are the exact ones, also after it failed; a sort takes {ms:.1f} ms")

    without = pages.open(f"?src={MODEL}&backend=webgl", before="delete self.Worker")
    assert without.evaluate("cc4dgs.gl.sorter.worker") is None and without.evaluate(MOVE, [0.4, 0.4])
    still(without, "without workers")
    without.close()
    pages.quiet("sorting")
    say("without workers the page sorts by itself")
