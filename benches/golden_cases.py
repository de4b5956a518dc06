#!/usr/bin/env python3
"""Golden fixtures of other sizes than the published ones, in NumPy: a deeper network (`nn_deep`) and Adam with other rates (`adam_wide`).

    python3 benches/golden_cases.py tests/fixtures/golden

Values are computed in float64 from inputs that float32 can hold; `noise_f32` is how far the same formulas in float32 are from that. Gradients are checked by
central differences before anything is written.
"""
import json
import pathlib
import struct
import sys

import numpy as np


def write(folder, name, arrays, facts):
    header, body = {}, b""
    for key, value in arrays.items():
        data = np.ascontiguousarray(value, dtype="<f8").tobytes()
        header[key] = {"dtype": "F64", "shape": list(value.shape), "data_offsets": [len(body), len(body) + len(data)]}
        body += data
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    (folder / f"{name}.f64.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + body)
    facts["tensors"] = {key: ["float64", list(value.shape)] for key, value in arrays.items()}
    (folder / f"{name}.json").write_text(json.dumps(facts, indent=1) + "\n")


def noise(narrow, wide):
    narrow = narrow.astype(np.float64)
    difference, norm = np.linalg.norm(narrow - wide), np.linalg.norm(wide)
    return {"max_abs": float(np.abs(narrow - wide).max()), "rel_l2": float(difference / norm) if norm > 0 else float(difference)}


def mish(x):
    soft = np.log1p(np.exp(-np.abs(x))) + np.maximum(x, x.dtype.type(0))
    return x * np.tanh(soft)


def mish_slope(x):
    soft = np.log1p(np.exp(-np.abs(x))) + np.maximum(x, x.dtype.type(0))
    tanh, one = np.tanh(soft), x.dtype.type(1)
    return tanh + x * (one - tanh * tanh) / (one + np.exp(-x))


def layer_norm(x):
    mean = x.mean(-1, keepdims=True, dtype=x.dtype)
    centred = x - mean
    deviation = np.sqrt((centred * centred).mean(-1, keepdims=True, dtype=x.dtype) + x.dtype.type(1e-5))
    return centred / deviation, deviation


def layer_norm_slope(upstream, normal, deviation):
    """Gradient of the input of a layer norm from that of its normalised output."""
    mean = lambda v: v.mean(-1, keepdims=True, dtype=v.dtype)
    return (upstream - mean(upstream) - normal * mean(upstream * normal)) / deviation


def network(x, weights, upstream):
    """Linear, LayerNorm, Mish; at last Linear. The output, and gradients of everything for the loss sum(out * upstream)."""
    kept, h = [], x
    hidden = sum(key.startswith("ln") and key.endswith("weight") for key in weights)
    for l in range(hidden):
        normal, deviation = layer_norm(h @ weights[f"lin{l}.weight"].T + weights[f"lin{l}.bias"])
        z = normal * weights[f"ln{l}.weight"] + weights[f"ln{l}.bias"]
        kept.append((h, normal, deviation, z))
        h = mish(z)
    out = h @ weights[f"lin{hidden}.weight"].T + weights[f"lin{hidden}.bias"]
    grads = {f"lin{hidden}.weight": upstream.T @ h, f"lin{hidden}.bias": upstream.sum(0, dtype=x.dtype)}
    d = upstream @ weights[f"lin{hidden}.weight"]
    for l in reversed(range(hidden)):
        before, normal, deviation, z = kept[l]
        d = d * mish_slope(z)
        grads[f"ln{l}.weight"], grads[f"ln{l}.bias"] = (d * normal).sum(0, dtype=x.dtype), d.sum(0, dtype=x.dtype)
        d = layer_norm_slope(d * weights[f"ln{l}.weight"], normal, deviation)
        grads[f"lin{l}.weight"], grads[f"lin{l}.bias"] = d.T @ before, d.sum(0, dtype=x.dtype)
        d = d @ weights[f"lin{l}.weight"]
    grads["x"] = d
    return out, grads


def check_slopes(x, weights, upstream):
    loss = lambda: float((network(x, weights, upstream)[0] * upstream).sum())
    grads = network(x, weights, upstream)[1]
    for name, array in {**weights, "x": x}.items():
        at, step = np.unravel_index(array.size // 3, array.shape), 1e-6
        start = array[at]
        array[at] = start + step
        up = loss()
        array[at] = start - step
        slope = (up - loss()) / (2 * step)
        array[at] = start
        assert abs(slope - grads[name][at]) < 1e-6 * (1 + abs(slope)), (name, slope, grads[name][at])


def nn_deep(folder, seed=7301, batch=13, sizes=(6, 24, 12, 20, 9), norm_shape=(5, 21)):
    rng = np.random.default_rng(seed)
    draw = lambda *shape, scale=1.0: (scale * rng.standard_normal(shape)).astype(np.float32).astype(np.float64)
    weights = {}
    for l in range(len(sizes) - 1):
        weights[f"lin{l}.weight"] = draw(sizes[l + 1], sizes[l], scale=sizes[l] ** -0.5)
        weights[f"lin{l}.bias"] = draw(sizes[l + 1], scale=0.1)
        if l < len(sizes) - 2:
            weights[f"ln{l}.weight"], weights[f"ln{l}.bias"] = 1 + draw(sizes[l + 1], scale=0.1), draw(sizes[l + 1], scale=0.1)
            weights[f"ln{l}.weight"] = weights[f"ln{l}.weight"].astype(np.float32).astype(np.float64)
    x, upstream = draw(batch, sizes[0]), draw(batch, sizes[-1])
    check_slopes(x, weights, upstream)
    scalar, scalar_upstream = draw(200, scale=4.0), draw(200)
    rows, gain, shift, row_upstream = draw(*norm_shape, scale=3.0), 1 + draw(norm_shape[1], scale=0.2), draw(norm_shape[1]), draw(*norm_shape)
    gain = gain.astype(np.float32).astype(np.float64)

    def run(kind):
        cast = lambda v: v.astype(kind)
        s, su, r, ru, g, b = map(cast, (scalar, scalar_upstream, rows, row_upstream, gain, shift))
        normal, deviation = layer_norm(r)
        out, grads = network(cast(x), {k: cast(v) for k, v in weights.items()}, cast(upstream))
        values = {"mish.out": mish(s), "mish.grad.x": mish_slope(s) * su, "layernorm.out": normal * g + b}
        values |= {"layernorm.grad.x": layer_norm_slope(ru * g, normal, deviation), "layernorm.grad.weight": (ru * normal).sum(0, dtype=kind)}
        values |= {"layernorm.grad.bias": ru.sum(0, dtype=kind), "mlp.out": out}
        return values | {f"mlp.grad.{name}": value for name, value in grads.items()}

    wide, narrow = run(np.float64), run(np.float32)
    arrays = {"mish.in.x": scalar, "mish.in.weights": scalar_upstream, "layernorm.in.x": rows, "layernorm.in.weight": gain, "layernorm.in.bias": shift}
    arrays |= {"layernorm.in.weights_loss": row_upstream, "mlp.in.x": x, "mlp.in.weights_loss": upstream}
    arrays |= {f"mlp.in.{name}": value for name, value in weights.items()} | wide
    what = "as nn, with layers of other widths; benches/golden_cases.py"
    write(folder, "nn_deep", arrays, {"what": what, "seed": seed, "noise_f32": {key: noise(narrow[key], wide[key]) for key in wide}})


def adam(kind, first, grads, rates, beta1, beta2, epsilon):
    b1, b2, p, m, v = kind(beta1), kind(beta2), first.astype(kind), np.zeros_like(first, dtype=kind), np.zeros_like(first, dtype=kind)
    out = {"params": [], "exp_avg": [], "exp_avg_sq": []}
    for t, (g, lr) in enumerate(zip(grads.astype(kind), rates), 1):
        m = b1 * m + kind(1 - beta1) * g
        v = b2 * v + kind(1 - beta2) * g * g
        p = p - kind(lr / (1 - beta1**t)) * m / (np.sqrt(v) / kind((1 - beta2**t) ** 0.5) + kind(epsilon))
        for key, value in (("params", p), ("exp_avg", m), ("exp_avg_sq", v)):
            out[key].append(value)
    return {key: np.stack(value) for key, value in out.items()}


def adam_wide(folder, seed=7302, steps=31, count=37):
    rng = np.random.default_rng(seed)
    single = lambda v: v.astype(np.float32).astype(np.float64)
    first, grads = single(rng.standard_normal(count)), single(rng.standard_normal((steps, count)) * 10.0 ** rng.uniform(-4, 2, count))
    grads[:, 0] = 0
    rates = single(2e-3 * 0.9 ** np.arange(steps))
    variants = {"fast": {"lr": float(np.float32(0.05)), "betas": [0.8, 0.95], "eps": 1e-6}, "slow": {"lr": float(np.float32(1.6e-4)), "betas": [0.9, 0.9995], "eps": 1e-12}}
    variants["falling"] = "lr of step t+1 = in.lr_schedule[t]; betas .9 .999, eps 1e-15"
    arrays, noises = {"in.p0": first, "in.grads": grads, "in.lr_schedule": rates}, {}
    for name, stated in variants.items():
        numbers = (rates, 0.9, 0.999, 1e-15) if isinstance(stated, str) else ([stated["lr"]] * steps, *stated["betas"], stated["eps"])
        wide, narrow = (adam(kind, first, grads, *numbers) for kind in (np.float64, np.float32))
        for key in wide:
            arrays[f"{name}.out.{key}"], noises[f"{name}.{key}"] = wide[key], noise(narrow[key], wide[key])
    write(folder, "adam_wide", arrays, {"what": "as adam, with other rates; benches/golden_cases.py", "variants": variants, "seed": seed, "noise_f32": noises})


def main():
    folder = pathlib.Path(sys.argv[1])
    nn_deep(folder)
    adam_wide(folder)


if __name__ == "__main__":
    main()
