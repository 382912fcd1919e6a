"""Pictures of studies. Error bars are standard deviations over the seeds; diamonds are the paper's numbers (other scenes)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.evaluation.catalogue import METRICS, PROTOCOLS
from lab.studies.files import Study

if TYPE_CHECKING:
    import pandas as pd

_MARKERS = {"raw": "o", "gain": "v", "scaled": "^", "oracle_affine": "s"}
_LINES = {"raw": "-", "gain": "-.", "scaled": ":", "oracle_affine": "--"}
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")  # colour-blind safe (Okabe, Ito)
_PANEL = (3.1, 2.9)  # inches


def draw(study: Study, frame: pd.DataFrame, histories: Mapping[Any, list[dict[str, float]]], path: Path) -> None:
    """Draw a study as PNG: a row of panels for each scene, a panel for each metric.

    Args:
        study: what to draw.
        frame: table of the study.
        histories: cell -> history of its solver, for `plot.kind: history`.
        path: file that is written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    frame = frame[frame["status"] == "ok"]
    scenes = [scene for scene in study.scenes if (frame["scene"] == scene).any()]
    keys = [key for key in study.show if len(_of(frame, key))]
    if not scenes or not keys:
        figure, axes = plt.subplots(figsize=(5, 2))
        axes.text(0.5, 0.5, "nothing was scored", ha="center", va="center")
        axes.axis("off")
    else:
        kind = study.plot.kind
        rows = (
            [(scene, protocol) for scene in scenes for protocol in study.protocols]
            if kind == "pareto"
            else [(s, "") for s in scenes]
        )
        columns = len(keys) + (kind == "history")
        height = max(_PANEL[1], 0.3 * len(study.variants) + 1) if kind == "bars" else _PANEL[1]
        size = (_PANEL[0] * columns + 1.5 * (kind == "bars"), height * len(rows) + 1.0)
        figure, grid = plt.subplots(len(rows), columns, figsize=size, squeeze=False, layout="constrained")
        for row, (scene, protocol) in zip(grid, rows, strict=True):
            of_scene = frame[frame["scene"] == scene]
            for axes, key in zip(row, keys, strict=False):
                if kind == "bars":
                    _dots(axes, study, of_scene, key, first=axes is row[0])
                elif kind == "pareto":
                    _scatter(axes, study, of_scene, key, protocol)
                else:
                    _lines(axes, study, of_scene, key)
                below = f"\n{PROTOCOLS[protocol].words}" if protocol else ""
                if axes.axison:
                    axes.set_title(f"{scene}: {key.split('/')[0]}{below}", fontsize=9)
            if kind == "history":
                _curves(row[-1], study, {cell: h for cell, h in histories.items() if cell.scene == scene})
                row[-1].set_title(f"{scene}: {study.plot.history} while solving", fontsize=9)
        _legend(figure, grid)
    figure.suptitle(study.title, fontsize=11)
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)


def _of(frame: pd.DataFrame, key: str, protocol: str = "") -> pd.DataFrame:
    quantity, metric = key.split("/")
    chosen = frame[(frame["quantity"] == quantity) & (frame["metric"] == metric)]
    return chosen[chosen["protocol"] == protocol] if protocol else chosen


def _shown_values(study: Study, frame: pd.DataFrame, key: str) -> pd.Series:
    chosen = _of(frame, key)
    return chosen[chosen["protocol"].isin(study.protocols)]["value"]


def _mean_and_spread(values: pd.Series) -> tuple[float, float]:
    numbers = values.to_numpy(np.float64)
    return float(numbers.mean()), float(numbers.std(ddof=1)) if len(numbers) > 1 else 0.0


def _setting(study: Study, variant: str, dotted: str) -> Any:
    section, _, key = dotted.partition(".")
    return study.variants[variant].overrides.get(section, {}).get(key)


def _groups(study: Study) -> dict[str, list[str]]:
    """Label of a line (values of the settings that group) -> its variants."""
    out: dict[str, list[str]] = {}
    for name in study.variants:
        values = [_setting(study, name, dotted) for dotted in study.plot.group]
        out.setdefault(", ".join(str(value) for value in values if value is not None), []).append(name)
    return out


def _others(study: Study, variant: str) -> str:
    """Values that the variant sets besides those that its group has in common: `16, 0.4`."""
    settings = study.variants[variant].overrides
    dotted = [(f"{section}.{key}", value) for section, keys in settings.items() for key, value in keys.items()]
    return ", ".join(str(value) for name, value in dotted if name not in study.plot.group)


def _axis(axes: Any, key: str, which: str, values: pd.Series) -> None:
    metric = METRICS[key.split("/")[1]]
    label = metric.axis or " / ".join(filter(None, (metric.label, metric.unit)))
    getattr(axes, f"set_{which}label")(label, fontsize=8)
    if metric.wide_range:
        _logarithmic_if_wide(axes, which, values)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=8)


def _logarithmic_if_wide(axes: Any, which: str, values: pd.Series) -> None:
    """Use a logarithmic axis for positive values that span more than a factor of 10."""
    if len(values) and values.min() > 0 and values.max() > 10 * values.min():
        getattr(axes, f"set_{which}scale")("log")


def _dots(axes: Any, study: Study, frame: pd.DataFrame, key: str, first: bool) -> None:
    """Draw the variants from top to bottom."""
    names = list(study.variants)
    for shift, protocol, colour in zip((-0.12, 0.12, 0.0), study.protocols, _COLOURS, strict=False):
        chosen, words = _of(frame, key, protocol), PROTOCOLS[protocol].words
        points = [(i, *_mean_and_spread(v)) for i, n in enumerate(names) if len(v := chosen[chosen["variant"] == n]["value"])]
        if points:
            y, mean, spread = np.array(points).T
            marker, style = _MARKERS[protocol], {"ms": 5, "ls": "", "capsize": 2, "color": colour}
            axes.errorbar(mean, y + shift, xerr=spread, marker=marker, label=words, **style)
    printed = [(i, p.values[key]) for i, n in enumerate(names) if (p := study.paper.get(n)) and key in p.values]
    if printed:
        axes.plot(
            [v for _, v in printed], [i for i, _ in printed], "D", ms=5, mfc="none", mec="black", label="paper (other scenes)"
        )
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), [study.variants[n].label or n for n in names] if first else [])
    _axis(axes, key, "x", _shown_values(study, frame, key))


def _lines(axes: Any, study: Study, frame: pd.DataFrame, key: str) -> None:
    """Draw the score over a setting, one colour per group."""
    for colour, (words, names) in zip(_cycle(), _groups(study).items(), strict=False):
        for protocol in study.protocols:
            kind, chosen, points = PROTOCOLS[protocol].words, _of(frame, key, protocol), []
            for name in names:
                x, values = _setting(study, name, study.plot.x), chosen[chosen["variant"] == name]["value"]
                if x is not None and len(values):
                    points.append((float(x), *_mean_and_spread(values)))
            if points:
                x, mean, spread = np.array(sorted(points)).T
                label = ", ".join(part for part in (words, kind) if part)
                style = {"ms": 4, "capsize": 2, "color": colour, "marker": _MARKERS[protocol], "ls": _LINES[protocol]}
                axes.errorbar(x, mean, yerr=spread, label=label, **style)
    printed = [(_setting(study, n, study.plot.x), p.values[key]) for n, p in study.paper.items() if key in p.values]
    if printed:
        axes.plot(*np.array(printed, float).T, "D", ms=5, mfc="none", mec="black", label="paper (other scenes)")
    if study.plot.log:
        axes.set_xscale("log", base=2)
        ticks = sorted({float(x) for n in study.variants if (x := _setting(study, n, study.plot.x)) is not None})
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    axes.set_xlabel(study.plot.x, fontsize=8)
    _axis(axes, key, "y", _shown_values(study, frame, key))
    if study.plot.log:
        axes.tick_params(axis="x", which="minor", bottom=False)


def _scatter(axes: Any, study: Study, frame: pd.DataFrame, key: str, protocol: str) -> None:
    """Draw the score over CPU time; filled markers are on the Pareto front, which is drawn as a line."""
    chosen, front = _of(frame, key, protocol), []
    if chosen.empty:  # this quantity has no such protocol
        axes.axis("off")
        return
    alone = not study.plot.group and len(study.variants) <= len(_COLOURS)
    groups = [(v.label or name, [name]) for name, v in study.variants.items()] if alone else _groups(study).items()
    for colour, (words, names) in zip(_cycle(), groups, strict=False):
        axes.plot([], [], "o", mfc="none", color=colour, label=words or "variants")
        for name in names:
            runs = chosen[chosen["variant"] == name].dropna(subset=["cpu_seconds"])
            if runs.empty:
                continue
            (x, dx), (y, dy) = (_mean_and_spread(runs[column]) for column in ("cpu_seconds", "value"))
            best = runs["pareto"].iloc[0] is True
            if best:
                front.append((x, y))
            face = colour if best else "none"
            axes.errorbar(x, y, xerr=dx, yerr=dy, fmt="o", ms=5, mfc=face, color=colour, elinewidth=0.8)
            if best and len(names) > 1:
                axes.annotate(
                    _others(study, name), (x, y), xytext=(4, -6 + 8 * (len(front) % 2)), textcoords="offset points", fontsize=5.5
                )
    if front:
        axes.plot(*np.array(sorted(front)).T, color="grey", lw=1, zorder=0, label="Pareto front (filled)")
    _logarithmic_if_wide(axes, "x", chosen["cpu_seconds"].dropna())
    axes.margins(x=0.12)
    axes.set_xlabel(f"CPU time of {', '.join(study.costs)} / s", fontsize=8)
    _axis(axes, key, "y", chosen["value"])


def _curves(axes: Any, study: Study, histories: Mapping[Any, list[dict[str, float]]]) -> None:
    """Draw a quantity of the solver over its sweeps, mean over the seeds, one colour per variant."""
    from matplotlib import colormaps

    names = list(study.variants)
    for i, name in enumerate(names):
        runs = [[e[study.plot.history] for e in h] for c, h in histories.items() if c.variant == name and h]
        runs = [run for run in runs if run]
        if runs:
            length = min(map(len, runs))
            colour = colormaps["viridis"](i / max(len(names) - 1, 1))
            mean = np.mean([run[:length] for run in runs], axis=0)
            axes.plot(np.arange(1, length + 1), mean, color=colour, lw=1.2, label=study.variants[name].label or name)
    axes.set_xlabel("sweep", fontsize=8)
    axes.set_ylabel(study.plot.history + (" / nat" if study.plot.history == "entropy" else ""), fontsize=8)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=6, title=study.plot.x, title_fontsize=6)


def _cycle() -> Iterator[str]:
    while True:
        yield from _COLOURS


def _legend(figure: Any, grid: Any) -> None:
    """Draw one legend under all panels."""
    found: dict[str, Any] = {}
    for axes in grid.ravel():
        if axes.get_legend() is None:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                found.setdefault(label, handle)
    if found:
        figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=min(len(found), 4), fontsize=8)
