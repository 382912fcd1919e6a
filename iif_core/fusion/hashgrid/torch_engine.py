"""The engine for any device, in torch operations."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.hashgrid.levels import UPPER, HashGridOptions, Level, named_zeros, not_finite, packed, row_count, unpacked

if TYPE_CHECKING:
    import torch


class TorchEngine:
    """Engine in torch operations. Indices are int32 up to the look-up; their products wrap as the hash needs."""

    PRIMES = (1, 2654435761 - (1 << 32), 805459861)

    def __init__(self, options: HashGridOptions, levels: tuple[Level, ...], start: dict[str, NDArray], device: str):
        import torch

        self.device = torch.device(device)
        self.options, self.levels = options, levels
        if row_count(levels) * options.features >= 1 << 31:
            raise InputError(f"hash grid: {row_count(levels)} entries; int32 indices reach {(1 << 31) // options.features}")
        direct = [level for level in levels if not level.hashed]
        hashed = [level for level in levels if level.hashed]
        # A GPU is faster with few large operations, a CPU with small ones that stay in cache. Direct levels come first.
        together = [group for group in (direct, hashed) if group] if self.device.type != "cpu" else [[x] for x in levels]
        self.groups = [
            (
                group[0].hashed,
                torch.tensor([level.resolution for level in group], dtype=torch.int32, device=self.device),
                torch.tensor([level.start for level in group], dtype=torch.int32, device=self.device),
            )
            for group in together
        ]
        self.load_state({**start, "steps": 0})

    def apply(self, u: torch.Tensor) -> torch.Tensor:
        import torch

        if not bool(torch.isfinite(u).all()):
            raise not_finite()
        x = _torch_function().apply(self.parameters["table"], u.clamp(0, UPPER), self)
        for i in range(self.options.hidden_layers):
            x = torch.relu(torch.nn.functional.linear(x, self.parameters[f"weight_{i}"], self.parameters[f"bias_{i}"]))
        last = self.options.hidden_layers
        return torch.nn.functional.linear(x, self.parameters[f"weight_{last}"], self.parameters[f"bias_{last}"])

    def corners(self, u: torch.Tensor, group: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows of the table (8 * levels * N,) int32 and weights (8, levels, N) of the corners (Eqs. F.58, F.59)."""
        import torch

        hashed, resolution, start = group
        resolution = resolution[:, None]
        shape = (2, 2, 2, len(resolution), len(u))  # z, y, x
        rows, weights = [], []
        for axis in range(3):
            scaled = u[:, axis] * (resolution - 1).to(torch.float32)
            cell = torch.minimum(scaled.to(torch.int32), resolution - 2)
            upper = scaled - cell
            stride = self.PRIMES[axis] if hashed else resolution**axis
            cell = cell * stride
            place = [1, 1, 1, *shape[3:]]
            place[2 - axis] = 2
            rows.append(torch.stack([cell, cell + stride]).view(place))
            weights.append(torch.stack([1 - upper, upper]).view(place))
        if hashed:
            row = (rows[2] ^ rows[1] ^ rows[0]) & ((1 << self.options.log2_entries) - 1)
        else:
            row = rows[2] + rows[1] + rows[0]
        row += start[:, None]
        return row.view(-1), (weights[2] * weights[1] * weights[0]).view(8, *shape[3:])

    def encode(self, table: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        import torch

        parts = []
        for group in self.groups:
            row, weight = self.corners(u, group)
            value = table.index_select(0, row.long()).view(*weight.shape, self.options.features)
            parts.append((value * weight[..., None]).sum(0).transpose(0, 1).flatten(1))
        return torch.cat(parts, dim=1)

    def scatter(self, slope: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        import torch

        gradient = torch.zeros_like(self.parameters["table"])
        flat, features = gradient.view(-1), self.options.features
        slope = slope.t().contiguous()
        low = 0
        for group in self.groups:
            levels = len(group[1])
            part = slope[low : low + levels * features].view(levels, features, len(u))
            row, weight = self.corners(u, group)
            place = row.long() * features
            for feature in range(features):  # much faster on a CPU than whole rows
                flat.index_add_(0, place + feature, (weight * part[:, feature]).view(-1))
            low += levels * features
        return gradient

    def step(self, lr: float, beta1: float, beta2: float, eps: float) -> None:
        """Update network and table; Args: as in `HashGridTexture.step`."""
        import torch

        for parameter in self.parameters.values():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        self.optimiser.param_groups[0].update(lr=lr, betas=(beta1, beta2), eps=eps)
        self.optimiser.step()
        self.steps += 1
        self.zero_grad()

    def zero_grad(self) -> None:
        for parameter in self.parameters.values():
            parameter.grad = None

    def gradients(self) -> dict[str, NDArray]:
        import torch

        return self._numpy({name: torch.zeros_like(p) if p.grad is None else p.grad for name, p in self.parameters.items()})

    def _numpy(self, tensors: dict[str, torch.Tensor]) -> dict[str, NDArray]:
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}
        return {name: unpacked(self.levels, a) if name == "table" else a.copy() for name, a in arrays.items()}

    def state(self) -> dict[str, NDArray]:
        out = {"steps": np.int64(self.steps), **self._numpy(self.parameters)}
        for prefix, key in (("first.", "exp_avg"), ("second.", "exp_avg_sq")):
            moments = {name: self.optimiser.state[p][key] for name, p in self.parameters.items()}
            out |= {prefix + name: array for name, array in self._numpy(moments).items()}
        return out

    def load_state(self, state: dict[str, NDArray]) -> None:
        import torch

        def tensor(name: str) -> torch.Tensor:
            array = np.array(state[name], np.float32)
            if name.endswith("table"):
                array = packed(self.levels, array)
            return torch.from_numpy(array).to(self.device)

        self.steps = int(state["steps"])
        self.parameters = {name: tensor(name).requires_grad_() for name in named_zeros(self.options, self.levels)}
        self.optimiser = torch.optim.Adam(self.parameters.values(), fused=True)
        for name, parameter in self.parameters.items():
            first, second = (
                tensor(key) if (key := prefix + name) in state else torch.zeros_like(parameter, requires_grad=False)
                for prefix in ("first.", "second.")
            )
            step = torch.tensor(float(self.steps), dtype=torch.float32, device=self.device)
            self.optimiser.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}


@cache
def _torch_function():
    import torch

    class Encoding(torch.autograd.Function):
        @staticmethod
        def forward(ctx, table, u, engine):
            ctx.save_for_backward(u)
            ctx.engine = engine
            return engine.encode(table, u)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx, slope):
            return ctx.engine.scatter(slope, *ctx.saved_tensors), None, None

    return Encoding
