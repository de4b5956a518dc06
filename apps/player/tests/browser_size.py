"""Checks of browser.py: canvases and images of more pixels than the device draws, and what an image leaves on the graphics card."""
from browser_pages import MODEL, say

# Notes what the console warns of.
WARNED = "() => { window.warned = []; const { warn } = console; console.warn = (...all) => { warned.push(String(all[0])); warn.apply(console, all); }; }"
# Textures of `side` pixels each way, and no more.
WEBGPU = "side => { Object.defineProperty(GPUSupportedLimits.prototype, 'maxTextureDimension2D', { get: () => side }); }"
WEBGL = """side => { const own = WebGL2RenderingContext.prototype, { getParameter } = own;
    own.getParameter = function (name) { return name === this.MAX_TEXTURE_SIZE ? side : getParameter.call(this, name); }; }"""
# Memory for images of `side` times `side` pixels, and no more.
MEMORY = """side => { const own = WebGL2RenderingContext.prototype, { texImage2D, checkFramebufferStatus } = own;
    let pixels = 0;
    own.texImage2D = function (...all) { pixels = all[3] * all[4]; return texImage2D.apply(this, all); };
    own.checkFramebufferStatus = function (...all) { return pixels > side * side ? this.FRAMEBUFFER_UNSUPPORTED : checkFramebufferStatus.apply(this, all); }; }"""
# Draws at twice the resolution. Returns the sizes of canvas and image, whether the image shows something, and what was said of its size.
DRAWN = """async () => { cc4dgs.set("resolution", 2), cc4dgs.draw();
    const { canvas } = cc4dgs.ui, { width, height, data } = await cc4dgs.capture();
    return [[canvas.width, canvas.height], [width, height], data.some(v => v > 60 && v < 255), warned.filter(text => text.includes("pixels instead of"))]; }"""
# Counts the textures and buffers that an image makes, and those that are given back.
FREED = """async () => { const own = GPUDevice.prototype, { createTexture, createBuffer } = own, counts = [0, 0];
    const counted = make => function (descriptor) {
        const made = make.call(this, descriptor), { destroy } = made;
        if (descriptor.label === "capture") {
            counts[0]++;
            made.destroy = () => { counts[1]++; destroy.call(made); };
        }
        return made;
    };
    [own.createTexture, own.createBuffer] = [counted(createTexture), counted(createBuffer)];
    await cc4dgs.capture();
    Object.assign(own, { createTexture, createBuffer });
    return counts; }"""
# Loses the device where no adapter is left, while the view has the focus.
NO_ADAPTER = """async () => { const recovered = new Promise(done => cc4dgs.on("recovered", done));
    navigator.gpu.requestAdapter = async () => null;
    cc4dgs.ui.canvas.focus(), cc4dgs.gpu.loseDevice();
    await recovered;
    return [!!cc4dgs.gl, document.activeElement === cc4dgs.ui.canvas, document.querySelectorAll("canvas").length]; }"""


def sizes(pages):
    """What is too large is drawn with fewer pixels, in the same shape, and the console says so once."""
    for query, script in (("", WEBGPU), ("&backend=webgl", WEBGL), ("&backend=webgl", MEMORY)):
        page = pages.open(f"?src={MODEL}{query}", before=f"({WARNED})(); ({script})(512)")
        canvas, image, seen, said = page.evaluate(DRAWN)
        assert bool(query) == page.evaluate("!!cc4dgs.gl"), "small textures lead to WebGL2"
        largest = [512, 320]
        fits = image[0] * image[1] <= 512 * 512 if script is MEMORY else image == canvas == largest
        assert fits and abs(image[0] / image[1] - 1280 / 800) < 0.01 and seen, [canvas, image, seen]
        assert len(said) == 1 and "lower resolution" in said[0], said
        page.close()
    pages.quiet("images that are too large")
    say(f"images that are too large are drawn with fewer pixels: {said[0]}")


def freed(pages):
    """An image of WebGPU leaves nothing on the graphics card; the view keeps the focus where WebGL2 takes the place of WebGPU."""
    page = pages.open(f"?src={MODEL}")
    made, given_back = page.evaluate(FREED)
    assert made == given_back == 2, f"an image makes {made} textures and buffers, and gives {given_back} back"
    found = page.evaluate(NO_ADAPTER)
    assert found == [True, True, 1], f"after WebGPU is lost, [WebGL2, focus, canvases] are {found}"
    page.close()
    pages.quiet("what images leave")
    say("an image leaves nothing on the graphics card, and the view keeps the focus where its device is replaced by WebGL2")
