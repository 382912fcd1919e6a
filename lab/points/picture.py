"""The picture of the trade: what an albedo error of so many decibels costs (docs/pictures/tradeoff.png)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

PICTURE = Path("docs/pictures/tradeoff.png")
_FRONT, _OTHER, _RUN = "#0072b2", "#d55e00", "#b0b0b0"  # colour-blind safe (Okabe, Ito)


class Pooled(NamedTuple):
    """A variant over all rooms: geometric mean of its CPU seconds, mean of its albedo score in dB, and both in each room."""

    variant: str
    cpu_seconds: float
    albedo: float
    rooms: Mapping[str, Mapping[str, float]]


def draw(pooled: Sequence[Pooled], chosen: Sequence[Pooled], names: Sequence[str], others: Sequence[Pooled], path: Path) -> None:
    """Draw albedo over CPU time: the mean over the rooms large, and each room small.

    Args:
        pooled: all runs of this method.
        chosen: those that are points, and `names`, theirs.
        others: other methods, labelled by the name of their variant.
        path: PNG file that is written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rooms = list(pooled[0].rooms)
    figure, axes = plt.subplot_mosaic(
        [["mean"] * 2 + [room] for room in rooms], figsize=(9.6, 5.4), layout="constrained", width_ratios=[1, 1, 0.95]
    )
    of_mean = [[(one.cpu_seconds, one.albedo) for one in of] for of in (pooled, chosen, others)]
    _panel(axes["mean"], *of_mean, size=26)
    for name, one in zip(names, chosen, strict=True):
        axes["mean"].annotate(
            name, (one.cpu_seconds, one.albedo), xytext=(-4, 6), textcoords="offset points", ha="right", fontsize=8, color=_FRONT
        )
    for one in others:
        words = one.variant.replace("_", ", ") + " method"
        axes["mean"].annotate(
            words, (one.cpu_seconds, one.albedo), xytext=(-8, 8), textcoords="offset points", ha="right", fontsize=9, color=_OTHER
        )
    axes["mean"].set_title(f"mean of {len(rooms)} rooms", fontsize=10)
    for room in rooms:
        of_room = [[(one.rooms[room]["cpu_seconds"], one.rooms[room]["albedo"]) for one in of] for of in (pooled, chosen, others)]
        _panel(axes[room], *of_room, size=9)
        axes[room].set_title(room, fontsize=9)
    for key, panel in axes.items():
        if key in ("mean", rooms[-1]):
            panel.set_xlabel("CPU seconds of the fit, from photographs on", fontsize=9 if key == "mean" else 8)
    axes["mean"].set_ylabel("albedo PSNR, after one gain an image / dB", fontsize=9)
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)


Dots = Sequence[tuple[float, float]]
"""(CPU seconds, dB) of some runs."""


def _panel(axes: Any, runs: Dots, points: Dots, others: Dots, size: float) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axes.scatter(*zip(*runs, strict=True), s=size * 0.7, color=_RUN, zorder=1)
    axes.plot(*zip(*points, strict=True), "-", color=_FRONT, lw=1.2, zorder=2)
    axes.scatter(*zip(*points, strict=True), s=size, color=_FRONT, zorder=3)
    if others:
        axes.scatter(*zip(*others, strict=True), s=size * 1.5, marker="D", color=_OTHER, zorder=3)
    axes.set_xscale("log")
    axes.set_xticks([10, 20, 50, 100, 200, 500, 1000, 2000])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    every = [x for x, _ in (*runs, *points, *others)]
    axes.set_xlim(min(every) / 1.2, max(every) * 1.2)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=8)
