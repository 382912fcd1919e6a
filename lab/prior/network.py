"""The network that is trained: the product's, with weights that may come from an earlier training."""

from __future__ import annotations

import torch

from workflow.priors.network import GROUPS, PriorNetwork

HEAD = (
    "log_albedo_r",
    "log_albedo_g",
    "log_albedo_b",
    "roughness",
    "metallic",
    "scale_albedo",
    "scale_roughness",
    "scale_metallic",
)
"""What each head of the product's network predicts, in this order; scales are logarithms."""


_WIDER_NOISE = 0.02
"""Spread of the factors that make copies of a feature differ, so that training pulls them apart."""


def load_weights(network: PriorNetwork, arrays: dict[str, torch.Tensor]) -> None:
    """Load weights of the same layers and the same or smaller widths.

    A wider network starts where the narrower one ended (Net2Net; Chen, Goodfellow and Shlens 2016). Its new features are copies
    of old ones of the same group of a group norm, and what reads a feature reads the mean over its copies. Copies differ by a
    relative noise of `_WIDER_NOISE`, and a group norm weights features anew, so predictions are close but not equal.

    Raises:
        ValueError: weights of other layers, or of larger sizes.
    """
    own = network.state_dict()
    strange = [
        name
        for name, array in arrays.items()
        if name not in own or any(a > b for a, b in zip(array.shape, own[name].shape, strict=True))
    ]
    if strange or len(arrays) < len(own):
        named = strange or sorted(set(own) - set(arrays))
        raise ValueError(f"these weights are for another network: {', '.join(named[:4])}; give its widths and heads")
    wide = [own[f"down.{i}.c1.bias"].numel() for i in range(len(network.down))]
    narrow = [arrays[f"down.{i}.c1.bias"].numel() for i in range(len(network.down))]
    copied = [_copies(a, b) for a, b in zip(narrow, wide, strict=True)]
    noise = torch.Generator().manual_seed(0)
    network.load_state_dict({name: _widened(name, array.float(), narrow, copied, noise) for name, array in arrays.items()})


def _copies(narrow: int, wide: int) -> torch.Tensor:
    """(wide,) which old feature each new one copies; groups keep their features, followed by the copies."""
    own, new = narrow // GROUPS, wide // GROUPS
    return torch.cat([group * own + torch.arange(new) % own for group in range(GROUPS)])


def _widened(
    name: str, array: torch.Tensor, narrow: list[int], copied: list[torch.Tensor], noise: torch.Generator
) -> torch.Tensor:
    """Return the array of a layer for wider features: rows are copied, columns share the old weight."""
    written, read = _features_of(name, narrow, copied)
    out = array if written is None else array[written]
    if array.ndim > 1 and read is not None:
        out = out[:, read] / torch.bincount(read)[read].reshape(1, -1, *[1] * (array.ndim - 2))
    if out.shape == array.shape:
        return array
    return out * (1 + _WIDER_NOISE * torch.randn(out.shape, generator=noise))


def _features_of(name: str, narrow: list[int], copied: list[torch.Tensor]) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """The old feature of each new one that a layer writes and reads; None where no width counts (inputs and predictions)."""
    part, *rest = name.split(".")
    last = len(copied) - 1
    if part == "inputs":
        return copied[0], None
    if part == "out":
        return None, copied[0]
    if part == "context":
        return copied[last], copied[last]
    level = int(rest[0]) if part == "down" else last - 1 - int(rest[0])
    first = rest[1] in ("c1", "skip")
    if not first:
        return copied[level], copied[level]
    if part == "down":
        return copied[level], copied[max(level - 1, 0)]
    return copied[level], torch.cat([copied[level + 1], narrow[level + 1] + copied[level]])
