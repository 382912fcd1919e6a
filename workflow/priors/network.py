"""The network of prior `learned`: a U-Net over the inputs of one view, with M heads of which each is a hypothesis with scales.

Needs torch; nothing else of the workflow imports this module when it is loaded.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn import functional

OUTPUTS = 8
"""Numbers of a head: correction of log albedo (3), logits of roughness and metallic, log scales of the three."""
GROUPS = 8  # of the group norms
ALBEDO, LOG_SCALE = (-5.0, 0.05), (-6.5, 1.5)
"""Ranges of log albedo and log scales."""
QUOTIENT = (-4.6, 0.3)
"""Range in which log albedo starts from the quotient of photograph and light."""
ROUGHNESS_BIAS, METALLIC_BIAS, SCALE_BIAS = 0.5, -2.0, -1.5
"""What a head says when its last layer says 0: roughness .62, metallic .12, scales .22."""


class Block(nn.Module):
    """Two 3 x 3 convolutions with group norm, and a skip: (B, a, H, W) -> (B, b, H, W)."""

    def __init__(self, a: int, b: int):
        super().__init__()
        self.c1, self.c2 = nn.Conv2d(a, b, 3, padding=1), nn.Conv2d(b, b, 3, padding=1)
        self.n1, self.n2 = nn.GroupNorm(GROUPS, b), nn.GroupNorm(GROUPS, b)
        self.skip: nn.Module = nn.Identity() if a == b else nn.Conv2d(a, b, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = functional.silu(self.n1(self.c1(x)))
        return functional.silu(self.n2(self.c2(h)) + self.skip(x))


class PriorNetwork(nn.Module):
    """U-Net (Ronneberger et al. 2015) with one vector of context from its coarsest level.

    Args:
        channels: inputs, the first three of them the quotient y of photograph and light in log (`iif_core.priors.features`).
        widths: features of each level, each level half as wide in pixels as the one above; multiples of GROUPS.
        heads: hypotheses M.
    """

    def __init__(self, channels: int, widths: Sequence[int], heads: int):
        super().__init__()
        self.heads = heads
        self.inputs = nn.Conv2d(channels, widths[0], 1)
        self.down = nn.ModuleList(Block(a, b) for a, b in zip((widths[0], *widths[:-1]), widths, strict=True))
        self.up = nn.ModuleList(Block(a + b, b) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.context = nn.Linear(widths[-1], widths[-1])
        self.out = nn.Conv2d(widths[0], heads * OUTPUTS, 1)
        # Heads start nearly alike, at the quotient itself.
        nn.init.normal_(self.out.weight, std=0.02)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Predict (B, M, 8, H, W) float32 from inputs (B, C, H, W): log albedo (3), roughness, metallic, log scales of albedo (in
        log), roughness and metallic."""
        return self.read_out(self.features(x), x[:, :3].float())

    def features(self, x: torch.Tensor) -> torch.Tensor:
        """Compute the features (B, widths[0], H, W) that the heads read."""
        height, width = x.shape[-2:]
        step = 2 ** (len(self.down) - 1)
        pad = (-width % step, -height % step)
        f = self.inputs(functional.pad(x, (0, pad[0], 0, pad[1]), mode="replicate") if any(pad) else x)
        kept = []
        for level, block in enumerate(self.down):
            f = block(functional.avg_pool2d(f, 2) if level else f)
            kept.append(f)
        f = f + self.context(f.mean((-2, -1)))[..., None, None]
        for block, skip in zip(self.up, kept[-2::-1], strict=True):
            f = block(torch.cat([functional.interpolate(f, scale_factor=2, mode="nearest"), skip], 1))
        return f[..., :height, :width]

    def read_out(self, f: torch.Tensor, quotient: torch.Tensor) -> torch.Tensor:
        """Turn features into predictions: albedo is a correction of the quotient (B, 3, H, W)."""
        out = self.out(f).float().unflatten(1, (self.heads, OUTPUTS))
        albedo = (quotient.clamp(*QUOTIENT)[:, None] + out[:, :, :3]).clamp(*ALBEDO)
        roughness = torch.sigmoid(out[:, :, 3:4] + ROUGHNESS_BIAS)
        metallic = torch.sigmoid(out[:, :, 4:5] + METALLIC_BIAS)
        return torch.cat([albedo, roughness, metallic, (out[:, :, 5:] + SCALE_BIAS).clamp(*LOG_SCALE)], 2)
