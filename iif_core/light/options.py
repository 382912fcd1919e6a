"""Options of cached light, apart from its code, so that reading them loads no compiler."""

from __future__ import annotations

from dataclasses import dataclass

SEEDS = 0x736861  # keeps these random streams apart from those of other stages


@dataclass(frozen=True)
class ShadingOptions:
    """How much light is traced.

    Attributes:
        seed: of the random streams.
        samples: paths of a pixel, over two halves, and of a cell to begin with.
        noise: relative error of diffuse light (median over an object) below which no more paths are added to cells.
        max_samples: largest number of paths of a cell.
        max_bounces: longest path, where the radiance cache holds no value.
        cell_edge: edge of the surface cells for which diffuse light is cached, metres.
    """

    seed: int
    samples: int = 32
    noise: float = 0.2
    max_samples: int = 512
    max_bounces: int = 6
    cell_edge: float = 0.03

    def of_view(self, view_id: int) -> int:
        """Return the seed of a view."""
        return ((self.seed << 32) | SEEDS) << 32 | view_id
