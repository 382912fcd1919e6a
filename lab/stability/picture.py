"""The picture of lab/notebook/stability.md: which error of the input, and which setting, costs most albedo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lab.stability.page import ranked
from workflow.settings.names import REPOSITORY

if TYPE_CHECKING:
    import pandas as pd

PICTURE = REPOSITORY / "lab/notebook/pictures/sensitivity.png"
_COLOURS = ("#0072b2", "#d55e00", "#009e73")  # colour-blind safe (Okabe, Ito)


def draw(frame: pd.DataFrame, path: Path, score: str = "albedo") -> None:
    """Draw mean sizes of the elementary effects with their intervals, a bar for each factor and room, the largest above.

    Args:
        frame: rows of the study.
        path: PNG file that is written.
        score: which score.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rooms = list(dict.fromkeys(frame[frame["part"] == "sensitivity"]["subject"]))
    order = [f"{factor}, {levels}" for factor, levels, *_ in ranked(frame, rooms[-1], score)]
    figure, axes = plt.subplots(figsize=(9, 0.17 * len(rooms) * len(order) + 1), layout="constrained")
    height = 0.8 / len(rooms)
    for number, room in enumerate(reversed(rooms)):
        found = {f"{factor}, {levels}": (size, error) for factor, levels, _, size, error in ranked(frame, room, score)}
        places = [len(order) - 1 - i + (0.5 - number) * height for i in range(len(order))]
        sizes, errors = zip(*(found[name] for name in order), strict=True)
        axes.barh(places, sizes, height, xerr=errors, color=_COLOURS[number], label=room, error_kw={"lw": 0.8, "capsize": 2})
    axes.set_yticks(range(len(order)), list(reversed(order)), fontsize=8)
    axes.set_xlabel("mean size of the effect on albedo PSNR over the whole range / dB", fontsize=9)
    axes.set_xlim(left=0)
    axes.grid(axis="x", alpha=0.3)
    axes.legend(fontsize=9)
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)
