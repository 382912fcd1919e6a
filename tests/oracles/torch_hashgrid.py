"""The hash-grid texture as a part of a torch graph, with access to its parameters, gradients and moments."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lab.published.fusion.hashgrid.texture import HashGridTexture


class TorchTexture(HashGridTexture):
    """Texture on tensors; the graph's `backward` calls the texture's `backward`."""

    def __call__(self, u: torch.Tensor) -> torch.Tensor:
        return _Graph.apply(torch.zeros((), requires_grad=True), u, self)

    def at(self, u: torch.Tensor, chunk: int = 1 << 17) -> torch.Tensor:
        return torch.from_numpy(self.evaluate(u.numpy(), chunk))

    def gradients(self) -> dict[str, NDArray]:
        """Copies of the gradients of the last backward pass, by the names of `levels.initial`."""
        table = np.zeros_like(self.table)
        for number in range(len(self.levels)):
            self._scatter(number, *self.pending, table[self.rows(number)])
        return {"table": self._unpacked(table), **_copies("", self.network_gradient)}

    def state(self) -> dict[str, NDArray]:
        """Copies of parameters and Adam moments ("first.<name>", "second.<name>"), after the queued update of the table."""
        update, self.queued = self.queued, None
        for number in range(len(self.levels)):
            if update is not None:
                update.apply(self, number)
        out = {}
        tables = (("", self.table), ("first.", self.first), ("second.", self.second))
        networks = (self.network, self.network_first, self.network_second)
        for (prefix, table), network in zip(tables, networks, strict=True):
            out |= {prefix + "table": self._unpacked(table), **_copies(prefix, network)}
        return out

    def _unpacked(self, table: NDArray) -> NDArray:
        return np.concatenate([table[self.rows(number)] for number in range(len(self.levels))])


def _copies(prefix: str, network) -> dict[str, NDArray]:
    return {prefix + name: array.copy() for name, array in network.named().items()}


class _Graph(torch.autograd.Function):
    @staticmethod
    def forward(ctx, token, u, texture):
        output, ctx.kept = texture.forward(u.numpy())
        ctx.texture = texture
        return torch.from_numpy(output)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, slope):
        ctx.texture.backward(ctx.kept, slope.contiguous().numpy())
        return None, None, None
