"""Sheets of pictures for papers: methods side by side, one row for each room and quantity (lab/docs/studies.md#sheets).

Everything comes from stages that are finished; a variant that is not has no column, and nothing is computed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iif_core.errors import InputError
from lab.studies import table
from lab.studies.files import Study
from workflow.artifacts.files import sha256_of, write_atomically
from workflow.runtime import fingerprint as fp

if TYPE_CHECKING:
    import numpy as np

    from workflow.artifacts import StageReader
    from workflow.scene.normal_form import CaptureReader, View

MATERIALS = ("albedo", "roughness", "metallic")
TILE = 1.35
"""Width of a picture in inches."""
GAP, TOP = 0.03, 0.3
LETTERS = 7.0
"""Size of the labels in points."""
LETTER = 0.0093
"""Width of a letter of one point in inches."""
LIGHTS = {"lamp": "one lamp", "moved": "a moved lamp", "environment": "an environment", "sphere": "a glowing sphere"}
"""Kinds of light of a study of relighting, as text."""
DPI = 200


@dataclass
class Line:
    """A row of the sheet: its label, and column -> picture (H, W, 3) uint8."""

    scene: str
    label: str
    tiles: dict[str, Any] = field(default_factory=dict)


def _cells(name: str, quality: str) -> tuple[Study, list[table.Cell]]:
    """Return the study, and the cells of its first seed whose maps or pictures are finished."""
    study, cells, _ = table.plan(name, quality)
    last = _last_stage(study)
    first = [cell for cell in cells if cell.seed == study.seeds[0]]
    done = [cell for cell in first if (table.home(cell, quality, last) / "manifest.json").is_file()]
    if not done:
        raise InputError(
            f"results/studies/{name}.grid: no variant of this study is finished; make them with"
            f" `snakemake -s lab/Snakefile --cores 2 results/studies/{name}.parquet`"
        )
    return study, done


def _last_stage(study: Study) -> str:
    return {"base_scores": "base", "relit_scores": "relit_scores"}.get(study.scores, "affines")


def mark(name: str, quality: str) -> str:
    """Return a digest that changes when more variants are finished or finished ones change.

    Raises:
        InputError: a mistake in the study's file, or nothing is finished.
    """
    study, cells = _cells(name, quality)
    last = _last_stage(study)
    found = [sha256_of(table.home(cell, quality, last) / "manifest.json") for cell in cells]
    facts = [study.model_dump(mode="json"), found, fp.modules_digest(["lab.studies.grid"])]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def write_grid(name: str, quality: str) -> None:
    """Write results/studies/<study>.grid.png and .pdf."""
    figure = sheet(name, quality)
    for ending in ("png", "pdf"):
        path = table.RESULTS / f"{name}.grid.{ending}"
        write_atomically(path, partial(_save, figure, ending))


def sheet(name: str, quality: str, rooms: int | None = None, letters: float = LETTERS) -> Any:
    """Return the sheet of a study as a figure of matplotlib: all its rooms or the first few; `letters`: their size in points."""
    study, cells = _cells(name, quality)
    scenes = list(dict.fromkeys(cell.scene for cell in cells))[:rooms]
    lines = [line for scene in scenes for line in _lines(study, cells, scene, quality)]
    columns = [c for c in ("truth", *study.variants) if any(c in line.tiles for line in lines)]
    labels = {"truth": "ground truth", **{v: study.variants[v].label or v for v in study.variants}}
    return draw(lines, columns, labels, study.sheet.insets, letters)


def _save(figure: Any, ending: str, path: Path) -> None:
    metadata = {"CreationDate": None} if ending == "pdf" else {"Software": None}
    figure.savefig(path, dpi=DPI, metadata=metadata)


def draw(
    lines: list[Line],
    columns: list[str],
    labels: dict[str, str],
    insets: dict[str, tuple[float, float, float]],
    letters: float = LETTERS,
) -> Any:
    """Draw a sheet: a column for each method, a row for each line.

    Args:
        lines: rows with their pictures; a picture that is missing leaves its place empty.
        columns: keys of the pictures, from left to right.
        labels: words over the columns.
        insets: scene -> (x, y, size) of a square that is shown enlarged in a corner, as shares of the width and the height.
        letters: size of the labels in points.

    Returns:
        The matplotlib figure.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    heights = [TILE * _aspect(line) for line in lines]
    top = TOP * letters / LETTERS
    left = LETTER * letters * max(len(words) for line in lines for words in line.label.split("\n")) + 0.12
    width = left + len(columns) * (TILE + GAP)
    height = top + sum(h + GAP for h in heights)
    figure = plt.figure(figsize=(width, height))
    plt.close(figure)
    y = height - top
    for j, column in enumerate(columns):
        x = left + j * (TILE + GAP) + TILE / 2
        words = _wrapped(labels[column])
        figure.text(x / width, (height - 0.55 * top) / height, words, ha="center", va="center", fontsize=letters)
    for line, tall in zip(lines, heights, strict=True):
        y -= tall
        figure.text((left - 0.06) / width, (y + tall / 2) / height, line.label, ha="right", va="center", fontsize=letters)
        for j, column in enumerate(columns):
            if column not in line.tiles:
                continue
            place = ((left + j * (TILE + GAP)) / width, y / height, TILE / width, tall / height)
            axes = figure.add_axes(place)
            axes.imshow(line.tiles[column], interpolation="nearest", aspect="auto")
            axes.axis("off")
            if line.scene in insets:
                _enlarge(axes, line.tiles[column], insets[line.scene])
        y -= GAP
    return figure


def _aspect(line: Line) -> float:
    picture = next(iter(line.tiles.values()))
    return picture.shape[0] / picture.shape[1]


def _wrapped(words: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(words, 22))


def _enlarge(axes: Any, picture: np.ndarray, inset: tuple[float, float, float]) -> None:
    """Frame a square of the picture and show it three times as large in the lower right corner."""
    from matplotlib.patches import Rectangle

    tall, wide = picture.shape[:2]
    x, y, size = inset[0] * wide, inset[1] * tall, inset[2] * wide
    axes.add_patch(Rectangle((x, y), size, size, fill=False, edgecolor="#d55e00", linewidth=0.8))
    share = min(3 * inset[2], 0.6)
    inner = axes.inset_axes([1 - share, 0, share, share * wide / tall])
    inner.imshow(picture, interpolation="nearest")
    inner.set_xlim(x, x + size)
    inner.set_ylim(y + size, y)
    inner.set_xticks([])
    inner.set_yticks([])
    for spine in inner.spines.values():
        spine.set_edgecolor("#d55e00")


def _reader(stage: str, cell: table.Cell, quality: str) -> StageReader | None:
    from workflow.artifacts import StageReader

    folder = table.home(cell, quality, stage)
    return StageReader(folder, stage, folder.parent.name) if (folder / "manifest.json").is_file() else None


def _lines(study: Study, cells: list[table.Cell], scene: str, quality: str) -> Iterator[Line]:
    """Yield the rows of a room: materials of some views, and what a study of relighting has under new light."""
    from workflow.scene.normal_form import CaptureReader

    own = [cell for cell in cells if cell.scene == scene]
    reader = _reader("capture", own[0], quality)
    assert reader is not None  # later stages are finished
    capture = CaptureReader(reader)
    truth = _reader("relit_truth", own[0], quality)
    lit = truth.json("lights.json") if truth is not None and study.scores == "relit_scores" else {"views": [], "lights": []}
    views = [view for view in capture.views if not lit["views"] or view.name in lit["views"]]
    count = min(study.sheet.views, len(views))
    chosen = [views[((2 * i + 1) * len(views) - 1) // (2 * count)] for i in range(count)]
    for view in chosen:
        for quantity in (q for q in study.sheet.quantities if q in MATERIALS):
            line = Line(scene, f"{scene}\n{quantity}")
            _fill_materials(line, study, own, capture, view, quantity, quality)
            if line.tiles:
                yield line
    if truth is None or "relit" not in study.sheet.quantities:
        return
    kinds = dict.fromkeys(light["kind"] for light in lit["lights"])
    for kind in kinds:
        light = next(one for one in lit["lights"] if one["kind"] == kind)
        for view in chosen:
            yield _relit_line(study, own, scene, light, view, truth, quality)


def _fill_materials(
    line: Line, study: Study, own: list[table.Cell], capture: CaptureReader, view: View, quantity: str, quality: str
) -> None:
    from workflow.artifacts.store import material_maps, prediction_numbers

    if capture.has_truth:
        truth = capture.truth(view)
        line.tiles["truth"] = _shown(getattr(truth, quantity), quantity)
    for cell in own:
        row = study.variants[cell.variant].row
        stage = {"prior_k0": "prior", "base": "base"}.get(row, "base" if study.scores == "base_scores" else "affines")
        if row not in ("", "result", "base", "prior_k0"):
            continue  # means of predictions and noise are no maps of a stage
        reader, file = _reader(stage, cell, quality), f"maps/{view.name}.exr"
        if reader is None or not reader.has(file):
            continue
        channels = reader.exr(file)
        prefix = f"prior.{prediction_numbers(channels)[0]:03d}." if stage == "prior" else ""
        line.tiles[cell.variant] = _shown(material_maps(channels, prefix)[quantity], quantity)


def _relit_line(
    study: Study, own: list[table.Cell], scene: str, light: dict[str, Any], view: View, truth: StageReader, quality: str
) -> Line:
    from iif_core.numerics.color import to_uint8, tone_map
    from workflow.artifacts.store import rgb

    file, line = f"{light['name']}/{view.name}.exr", Line(scene, f"{scene}\n{LIGHTS[light['kind']]}")
    line.tiles["truth"] = to_uint8(tone_map(rgb(truth.exr(file)), light["exposure"]))
    for cell in own:
        reader = _reader("relit_scores", cell, quality)
        if reader is not None and reader.has(file) and not study.variants[cell.variant].row:
            line.tiles[cell.variant] = to_uint8(tone_map(rgb(reader.exr(file)), light["exposure"]))
    return line


def _shown(values: np.ndarray, quantity: str) -> np.ndarray:
    from workflow.report import pictures

    return pictures.linear(values) if quantity == "albedo" else pictures.grey(values)
