"""The optimiser's step on a texture of cells by automatic differentiation, against which the closed forms are tested."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from iif_core.fusion.problem import LOWEST
from lab.published.fusion.sgd.kernels import LOCATION, SCALE
from lab.published.fusion.sgd.options import SgdOptions
from lab.published.fusion.sgd.pool import IDENTITY, TERMS, Pool, Step, softmax, start_values

_PROPERTY_OF_CHANNEL = [0, 0, 0, 1, 2]


class TorchBatch(NamedTuple):
    """Pixels of a batch."""

    raw: torch.Tensor
    """(N, 10) raw outputs of the texture, any real type."""
    values: torch.Tensor
    """(N, K, 5) predictions."""
    segment: torch.Tensor
    """(N,) int64."""
    share: torch.Tensor
    """(N,) weights of the pixels, sum 1."""


class TorchTables(NamedTuple):
    """Maps and selection of every segment and prediction."""

    affine: torch.Tensor
    """(S, K, 16)."""
    z: torch.Tensor
    """(S, K, 3) logits."""
    usable: torch.Tensor
    """(S, K) bool."""
    fixed: torch.Tensor | None = None
    """(S, K, 3) selection weights in place of the logits."""


class TorchEngine:
    """Engine whose methods and attributes are those of sgd.engine.Engine."""

    grid = None

    def __init__(self, pool: Pool, options: SgdOptions, n_cells: int, threads: int):
        self.pool, self.options = pool, options
        s, k = pool.usable.shape
        self.values = torch.from_numpy(pool.values.view(np.float16) if pool.values.dtype == np.uint16 else pool.values)
        self.segment, self.cell = (torch.from_numpy(a.astype(np.int64)) for a in (pool.segment, pool.cell))
        self.usable = torch.from_numpy(pool.usable)
        self.table, self.affine = start_values(pool, n_cells, options), np.tile(IDENTITY, (s, k, 1))
        self.z = torch.zeros((s, k, 3), requires_grad=True)
        self.fixed = None
        # tensors that share the memory of the arrays, which Adam therefore updates
        self.texture, self.maps = (torch.from_numpy(a).requires_grad_() for a in (self.table, self.affine))
        self.optimiser = torch.optim.Adam([self.texture, self.maps, self.z], lr=options.learning_rate)

    def close(self) -> None:
        pass

    def losses(self, pixels: torch.Tensor, raw: torch.Tensor, temperature: float) -> dict[str, torch.Tensor]:
        segment = self.segment[pixels]
        batch = TorchBatch(raw, self.values[pixels].to(torch.float32), segment, torch.full((len(pixels),), 1 / len(pixels)))
        tables = TorchTables(self.maps, self.z, self.usable, self.fixed)
        found = torch_losses(batch, tables, temperature, temperature, self.options)
        if self.fixed is not None:
            found["label"] = torch.zeros_like(found["label"])  # a fixed selection has no label loss
        return found

    def step(self, step: Step) -> NDArray:
        pixels = torch.from_numpy(step.pixels.astype(np.int64))
        found = self.losses(pixels, self.texture[self.cell[pixels]], step.temperature)
        o = self.options
        loss = o.data_weight * found["data"] + o.regulariser * found["regulariser"] + o.label_weight * found["label"]
        self.optimiser.zero_grad(set_to_none=False)
        loss.backward()
        self.optimiser.param_groups[0]["lr"] = step.learning_rate
        self.optimiser.step()
        return torch.stack([found[name].detach() for name in TERMS]).numpy().astype(np.float64)

    def errors(self, temperature: float) -> NDArray:
        total = np.zeros((*self.pool.usable.shape, 3))
        with torch.no_grad():
            for low in range(0, len(self.pool), self.options.batch):
                rows = torch.arange(low, min(low + self.options.batch, len(self.pool)))
                found = self.losses(rows, self.texture[self.cell[rows]], temperature)["error"]
                np.add.at(total, self.pool.segment[rows.numpy()], found.numpy())
        return total

    def weights(self, temperature: float) -> tuple[NDArray, NDArray]:
        if self.fixed is not None:
            alpha = self.fixed.numpy()
            return alpha, np.log(alpha, out=np.zeros_like(alpha), where=alpha > 0)
        return softmax(self.z.detach().numpy(), temperature, self.pool.usable)

    def fix(self, alpha: NDArray) -> None:
        self.fixed = torch.from_numpy(np.asarray(alpha, np.float32))


def torch_losses(
    batch: TorchBatch, tables: TorchTables, temperature: float, divisor: float, options: SgdOptions
) -> dict[str, torch.Tensor]:
    """Compute the terms of the loss of a batch in differentiable torch operations (Eqs. F.1 to F.15).

    Args:
        batch: pixels; tables: maps and selection, of the same real type and device.
        temperature: of the errors; divisor: of the logits; options: choices of the loss.

    Returns:
        data, label, regulariser (without its weight), entropy and gain: scalars; error: (N, K, 3) L1 errors without graph.
    """
    raw, values, segment, share = batch
    low = torch.as_tensor(LOWEST, device=raw.device).to(raw.dtype)
    use, t = tables.usable[segment], tables.affine[segment]
    n_used = use.sum(1)
    mu, b = _texture(raw, low, options)
    corrected = _clamped(_corrected(values, t), low, options.clamp_gradient)
    alpha, log_alpha = _selection(tables, divisor, raw.dtype)
    alpha_n = alpha[segment]
    mixed = (alpha_n[..., _PROPERTY_OF_CHANNEL] * corrected).sum(1)
    b_ref = _reference_scale((mixed[:, None] - corrected).abs(), use, n_used).clamp_min(options.scale_floor)
    if not options.median_gradient:
        b_ref = b_ref.detach()
    d = (mixed - mu).abs()
    kl = (b / b_ref).log() + (d + b_ref * (-d / b_ref).exp()) / b - 1
    data = (share * kl.mean(1)).sum()

    with torch.no_grad():
        off = (corrected - mu[:, None]).abs()
        error = torch.stack([off[..., :3].mean(-1), off[..., 3], off[..., 4]], -1)
        nearest = torch.where(use[..., None], error, torch.inf).amin(1, keepdim=True)
        q = ((nearest - error) / temperature).masked_fill(~use[..., None], -torch.inf).softmax(1)
    label = -(share[:, None, None] * q * torch.where(q > 0, log_alpha[segment], 0)).sum() / 3
    regulariser = (share * (_distance_from_identity(t) * use).sum(1) / n_used).sum()

    with torch.no_grad():
        entropy = -(share * (alpha * log_alpha).sum((1, 2))[segment]).sum() / 3
        gain = (share * (alpha_n[..., 0] * (t[..., 0] + t[..., 5] + t[..., 10])).sum(1)).sum() / 3
        error = error * use[..., None]
    return {"data": data, "label": label, "regulariser": regulariser, "entropy": entropy, "gain": gain, "error": error}


def _texture(raw: torch.Tensor, low: torch.Tensor, options: SgdOptions) -> tuple[torch.Tensor, torch.Tensor]:
    """Location and Laplace scale (N, 5) of raw outputs (Eqs. F.50, F.51)."""
    floor = options.scale_floor
    sigmoid = raw.sigmoid()
    mu = low + (1 - low) * sigmoid[:, LOCATION]
    b = sigmoid[:, SCALE]
    return mu, (b * b + floor**2).sqrt() if options.scale_floor_kind == "smooth" else b.clamp_min(floor)


def _corrected(values: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Predictions (N, K, 5) under the maps of their segments (N, K, 16), before the clamp."""
    albedo = t[..., :12].unflatten(-1, (3, 4))
    return torch.cat(
        [
            (albedo[..., :3] * values[..., None, :3]).sum(-1) + albedo[..., 3],
            t[..., 12:13] * values[..., 3:4] + t[..., 13:14],
            t[..., 14:15] * values[..., 4:] + t[..., 15:],
        ],
        -1,
    )


def _selection(tables: TorchTables, divisor: float, real: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """alpha and log alpha (S, K, 3), 0 where a prediction is not usable (Eq. F.2)."""
    if tables.fixed is not None:
        alpha = tables.fixed.to(real)
        return alpha, torch.where(alpha > 0, alpha, 1.0).log()
    z, off = tables.z, ~tables.usable[..., None]
    y = (z - z.masked_fill(off, -torch.inf).amax(1, keepdim=True).clamp_min(-1e30).detach()) / divisor
    log_alpha = y.masked_fill(off, -torch.inf).log_softmax(1).masked_fill(off, 0)
    return log_alpha.exp() * tables.usable[..., None], log_alpha


def _reference_scale(spread: torch.Tensor, use: torch.Tensor, n_used: torch.Tensor) -> torch.Tensor:
    """Lower median (N, 5) of the deviations (N, K, 5) of usable predictions; its gradient reaches the first that equals it."""
    ranked = torch.where(use[..., None], spread.detach(), torch.inf).sort(dim=1).values
    median = ranked.gather(1, ((n_used - 1).clamp_min(0) // 2)[:, None, None].expand(-1, 1, 5))
    index = torch.arange(use.shape[1], device=spread.device)[None, :, None]
    is_median = (spread.detach() == median) & use[..., None]
    first = torch.where(is_median, index, use.shape[1] - 1).amin(1, keepdim=True)
    return spread.gather(1, first)[:, 0]


def _distance_from_identity(t: torch.Tensor) -> torch.Tensor:
    """Identity regulariser (N, K) of maps (N, K, 16) (Eq. F.14)."""
    albedo = t[..., :12].unflatten(-1, (3, 4))
    a, identity = albedo[..., :3], torch.eye(3, dtype=t.dtype, device=t.device)
    penalty = ((a - identity) ** 2).sum((-1, -2)) + (albedo[..., 3] ** 2).sum(-1)
    penalty = penalty + ((a @ a.mT - identity) ** 2).sum((-1, -2))
    return penalty + ((t[..., 12:] - torch.tensor([1.0, 0.0, 1.0, 0.0], device=t.device)) ** 2).sum(-1)


def _clamped(x: torch.Tensor, low: torch.Tensor, gradient: str) -> torch.Tensor:
    """x clamped to [low, 1], with the gradient that SgdOptions.clamp_gradient names."""
    clamped = torch.maximum(torch.minimum(x, torch.ones_like(x)), low.expand_as(x))
    outside = x.detach() - clamped.detach()
    dead = torch.where(outside == 0, x, clamped.detach())
    if gradient == "dead" or not x.requires_grad:
        return dead
    inward = clamped.detach() + (x - x.detach())
    inward.register_hook(lambda slope: torch.where((outside == 0) | (outside * slope > 0), slope, 0))
    return inward
