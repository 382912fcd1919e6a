"""The other ways to run a hash-grid texture that `hashgrid.py` measures: each a function that makes one iteration.

`OPTIONS[name](options, batches, threads)` returns `iterate(i)`: forward, mean |sigmoid(y) - 0.5|, backward, Adam on
batch i. All have the levels, the network and the loss of `lab.published.fusion.hashgrid`; Dr.Jit places its vertices its own way.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lab.published.fusion.hashgrid.levels import HashGridOptions, layout
from tests.oracles.torch_hashgrid import TorchTexture

RATE = 1e-2
Iterate = Callable[[int], None]

C_SOURCE = r"""
#include <math.h>
#include <stdint.h>
#define CELLS(BODY) \
  const float scale = resolution[l] - 1; const uint32_t r = resolution[l], mask = entries[l] - 1; \
  for (int i = 0; i < n; i++) { \
    uint32_t cell[3]; float w[3]; \
    for (int k = 0; k < 3; k++) { \
      float p = u[3 * i + k] * scale; cell[k] = (uint32_t)p; if (cell[k] > r - 2) cell[k] = r - 2; w[k] = p - cell[k]; } \
    for (int c = 0; c < 8; c++) { \
      uint32_t x = cell[0] + (c & 1), y = cell[1] + (c >> 1 & 1), z = cell[2] + (c >> 2); \
      uint32_t row = hashed[l] ? (x ^ y * 2654435761u ^ z * 805459861u) & mask : x + r * (y + r * z); \
      float f = (c & 1 ? w[0] : 1 - w[0]) * (c & 2 ? w[1] : 1 - w[1]) * (c & 4 ? w[2] : 1 - w[2]); \
      BODY } }
void encode(const float *u, int n, int levels, const int *resolution, const int *entries, const int *hashed,
            const int64_t *start, const float *table, float *out) {
#pragma omp parallel for schedule(dynamic, 1)
  for (int l = 0; l < levels; l++) {
    const float *t = table + 2 * start[l]; float *o = out + 2 * (int64_t)l * n;
    for (int64_t i = 0; i < 2 * (int64_t)n; i++) o[i] = 0;
    CELLS(o[2 * i] += f * t[2 * row]; o[2 * i + 1] += f * t[2 * row + 1];)
  }
}
void scatter(const float *u, int n, int levels, const int *resolution, const int *entries, const int *hashed,
             const int64_t *start, float *gradient, const float *slope) {
#pragma omp parallel for schedule(dynamic, 1)
  for (int l = 0; l < levels; l++) {
    float *t = gradient + 2 * start[l]; const float *o = slope + 2 * (int64_t)l * n;
    CELLS(t[2 * row] += f * o[2 * i]; t[2 * row + 1] += f * o[2 * i + 1];)
  }
}
void adam(float *p, float *g, float *m, float *v, int64_t n, float rate, float root, float b1, float b2, float eps) {
#pragma omp parallel for schedule(static)
  for (int64_t i = 0; i < n; i++) {
    float q = g[i]; g[i] = 0; m[i] += (1 - b1) * (q - m[i]); v[i] = b2 * v[i] + (1 - b2) * q * q;
    p[i] -= rate * m[i] / (root * sqrtf(v[i]) + eps);
  }
}
"""


def _loss(y):
    return (y.sigmoid() - 0.5).abs().mean()


def _network(options: HashGridOptions):
    import torch

    sizes = [2 * len(layout(options)), *[options.hidden] * options.hidden_layers, options.outputs]
    layers = [torch.nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False)]
    return torch.nn.Sequential(*[part for layer in layers for part in (layer, torch.nn.ReLU())][:-1])


def _table(options: HashGridOptions):
    import torch

    levels = layout(options)
    random = np.random.default_rng(0)
    values = random.uniform(-1e-4, 1e-4, (levels[-1].start + levels[-1].entries, 2))
    return torch.from_numpy(values.astype(np.float32))


def _corners(u, level):
    """Rows (N, 8) int64 and weights (N, 8) of one level, as one writes it in torch."""
    import torch

    position = u * (level.resolution - 1)
    cell = position.long().clamp(max=level.resolution - 2)
    weight = position - cell
    offset = torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])
    x, y, z = (cell[:, None, :] + offset).unbind(-1)
    if level.hashed:
        row = (x ^ (y * 2654435761) ^ (z * 805459861)) & (level.entries - 1)
    else:
        row = x + level.resolution * (y + level.resolution * z)
    return row + level.start, torch.where(offset == 1, weight[:, None, :], 1 - weight[:, None, :]).prod(-1)


def _ours(options: HashGridOptions, batches: list, threads: int) -> Iterate:
    texture = TorchTexture(options, threads=threads)

    def iterate(i: int) -> None:
        _loss(texture(batches[i])).backward()
        texture.step(RATE)

    return iterate


def _torch(encode_with, optimisers):
    """An option that encodes by `encode_with(options) -> (u, table) -> (N, 2 levels)`."""

    def make(options: HashGridOptions, batches: list, threads: int) -> Iterate:
        table, network, encode = _table(options).requires_grad_(), _network(options), encode_with(options)
        steps = optimisers(table, network)

        def iterate(i: int) -> None:
            for each in steps:
                each.zero_grad()
            _loss(network(encode(batches[i], table))).backward()
            for each in steps:
                each.step()

        return iterate

    return make


def _gather(options: HashGridOptions):
    import torch

    def encode(u, table):
        parts = []
        for level in layout(options):
            row, weight = _corners(u, level)
            parts.append((weight[..., None] * table[row]).sum(1))
        return torch.cat(parts, 1)

    return encode


def _function(options: HashGridOptions):
    import torch

    class Encode(torch.autograd.Function):
        @staticmethod
        def forward(ctx, u, table):
            ctx.shape, ctx.corners, parts = table.shape, [_corners(u, level) for level in layout(options)], []
            for row, weight in ctx.corners:
                value = table.index_select(0, row.view(-1)).view(*row.shape, 2)
                parts.append((weight[..., None] * value).sum(1))
            return torch.cat(parts, 1)

        @staticmethod
        def backward(ctx, slope):
            gradient = torch.zeros(ctx.shape)
            for number, (row, weight) in enumerate(ctx.corners):
                part = weight[..., None] * slope[:, None, 2 * number : 2 * number + 2]
                gradient.index_add_(0, row.view(-1), part.view(-1, 2))
            return None, gradient

    return Encode.apply


def _bag(sparse: bool):
    def encode_with(options: HashGridOptions):
        import torch

        def encode(u, table):  # one call for all levels: each call makes a gradient of the whole table
            rows, weights = zip(*(_corners(u, level) for level in layout(options)), strict=True)
            rows, weights = torch.stack(rows, 1).view(-1, 8), torch.stack(weights, 1).view(-1, 8)
            out = torch.nn.functional.embedding_bag(rows, table, mode="sum", per_sample_weights=weights, sparse=sparse)
            return out.view(len(u), -1)

        return encode

    return encode_with


def _adam(table, network):
    import torch

    return [torch.optim.Adam([table, *network.parameters()], lr=RATE)]


def _fused(table, network):
    import torch

    return [torch.optim.Adam([table, *network.parameters()], lr=RATE, fused=True)]


def _sparse(table, network):
    import torch

    return [torch.optim.SparseAdam([table], lr=RATE), torch.optim.Adam(network.parameters(), lr=RATE)]


def _drjit(half: bool):
    def make(options: HashGridOptions, batches: list, threads: int) -> Iterate:
        from workflow.runtime import native

        native.prepare()
        import drjit as dr
        import drjit.llvm.ad as ad
        from drjit import nn
        from drjit.opt import Adam

        dr.set_thread_count(threads)
        number, tensor = (ad.Float16, ad.TensorXf16) if half else (ad.Float, ad.TensorXf)
        grid = nn.HashGridEncoding(
            number,
            3,
            n_levels=options.levels,
            hashmap_size=1 << options.log2_entries,
            base_resolution=options.base_resolution,
            per_level_scale=options.growth,
            rng=dr.rng(seed=0),
        )
        layers = [part for _ in range(options.hidden_layers) for part in (nn.Linear(-1, options.hidden), nn.ReLU())]
        network = nn.Sequential(nn.Cast(number), *layers, nn.Linear(-1, options.outputs))
        network = network.alloc(tensor, 2 * options.levels, rng=dr.rng(seed=1))
        network = nn.pack(network, layout="training")
        optimiser = Adam(lr=RATE, params={"grid": grid.data, "network": network["weights"]})
        points = [[ad.Float(np.ascontiguousarray(u.numpy()[:, axis])) for axis in range(3)] for u in batches]
        dr.eval(points)

        def iterate(i: int) -> None:
            grid.data = number(optimiser["grid"])  # not .params: its setter fails
            network["weights"] = optimiser["network"]
            y = network(nn.CoopVec(grid(ad.ArrayXf(points[i]))))
            values = [ad.Float(value) for value in y]
            loss = dr.mean(sum(abs(1 / (1 + dr.exp(-value)) - 0.5) for value in values)) / len(values)
            dr.backward(loss)
            optimiser.step()
            dr.sync_thread()

        return iterate

    return make


def _c(options: HashGridOptions, batches: list, threads: int) -> Iterate:
    import torch

    levels = layout(options)
    with tempfile.TemporaryDirectory() as folder:
        (source := Path(folder) / "grid.c").write_text(C_SOURCE)
        library = Path(folder) / "grid.so"
        flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC"]
        subprocess.run(["gcc", *flags, str(source), "-o", str(library), "-lm"], check=True)
        c = ctypes.CDLL(str(library))
    table, network = _table(options), _network(options)
    gradient, first, second = (torch.zeros_like(table) for _ in range(3))
    resolution, entries, hashed, start = (
        torch.tensor([getattr(level, name) for level in levels], dtype=kind)
        for name, kind in (("resolution", torch.int32), ("entries", torch.int32), ("hashed", torch.int32), ("start", torch.int64))
    )
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    token = torch.zeros((), requires_grad=True)

    def at(*tensors):
        return [ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors]

    class Encode(torch.autograd.Function):
        @staticmethod
        def forward(ctx, u, token):
            ctx.u, out = u, torch.empty(len(levels), len(u), 2)
            c.encode(*at(u), len(u), len(levels), *at(resolution, entries, hashed, start, table, out))
            return out.permute(1, 0, 2).reshape(len(u), -1)

        @staticmethod
        def backward(ctx, slope):
            slope = slope.view(len(ctx.u), len(levels), 2).permute(1, 0, 2).contiguous()
            c.scatter(*at(ctx.u), len(ctx.u), len(levels), *at(resolution, entries, hashed, start, gradient, slope))
            return None, None

    done = 0

    def iterate(i: int) -> None:
        nonlocal done
        done += 1
        optimiser.zero_grad()
        _loss(network(Encode.apply(batches[i], token))).backward()
        optimiser.step()
        numbers = (RATE / (1 - 0.9**done), 1 / math.sqrt(1 - 0.999**done), 0.9, 0.999, 1e-8)
        arrays = at(table, gradient, first, second)
        c.adam(*arrays, ctypes.c_int64(table.numel()), *(ctypes.c_float(number) for number in numbers))

    return iterate


OURS = "ours, numba"
OPTIONS: dict[str, Callable[[HashGridOptions, list, int], Iterate]] = {
    OURS: _ours,
    "torch gather": _torch(_gather, _adam),
    "torch autograd function": _torch(_function, _fused),
    "torch embedding_bag": _torch(_bag(False), _fused),
    "torch embedding_bag, SparseAdam": _torch(_bag(True), _sparse),
    "drjit.nn f32": _drjit(False),
    "drjit.nn f16": _drjit(True),
}
if shutil.which("gcc"):
    OPTIONS["C/OpenMP encoder, torch network"] = _c
