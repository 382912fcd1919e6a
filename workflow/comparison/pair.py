"""`compare/<a>,<b>`: two results side by side with their differences (docs/guide/comparing.md).

A result is what lies under results/ for a scene, a line of the batch table or a variant of a study; what a variant shares with
another is read from there. Nothing is computed that is not there yet.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.evaluation.catalogue import METRICS
from iif_core.reflectance.material import CHANNELS
from workflow.artifacts.files import write_atomically
from workflow.artifacts.store import rgb
from workflow.comparison.named import Result, open_result
from workflow.report import pictures
from workflow.report.page import Picture, Strip, Table, template
from workflow.scene.normal_form import CaptureReader

VIEWS = 4
OBJECTS = 40
"""Objects that the page shows, those that differ most first; the table has all."""
SAME_POSE, NEAR_POSE = 1e-4, 0.2
"""Largest difference of two poses, metres and cosines, that are the same view: of other names, and of the same name."""
TEMPLATE = Path(__file__).with_name("page.html.j2")


@dataclass(frozen=True)
class Row:
    """One line of compare.parquet: the values as text, and the difference b - a of numbers (NaN for words)."""

    part: str
    name: str
    a: str
    b: str
    difference: float = float("nan")
    same: bool = False


def write_comparison(a: str, b: str, quality: str, output: Path) -> None:
    """Write compare.parquet and compare.html into `output`."""
    import pandas as pd

    first, second = open_result(a, quality), open_result(b, quality)
    parts = {
        "settings": list(_words("settings", _settings(first), _settings(second))),
        "code": list(_words("code", _codes(first), _codes(second))),
        "versions": list(_words("versions", _versions(first), _versions(second))),
        "plan": list(_words("plan", _plan(first), _plan(second))),
        "scores": list(_numbers("scores", _scores(first), _scores(second))),
        "objects": list(_numbers("objects", *_objects(first, second))),
    }
    strips, shown = _strips(first, second)
    parts["pictures"] = shown
    rows = [row for part in parts.values() for row in part]
    frame = pd.DataFrame([row.__dict__ for row in rows], columns=list(Row.__dataclass_fields__))
    output.mkdir(parents=True, exist_ok=True)
    write_atomically(output / "compare.parquet", partial(_write, frame))
    text = _page(first, second, parts, strips)
    write_atomically(output / "compare.html", lambda path: path.write_text(text))


def _write(frame: Any, path: Path) -> None:
    frame.to_parquet(path, index=False)


def _words(part: str, a: Mapping[str, str], b: Mapping[str, str]) -> Iterator[Row]:
    for name in dict.fromkeys([*a, *b]):
        yield Row(part, name, a.get(name, ""), b.get(name, ""), same=a.get(name) == b.get(name))


def _numbers(part: str, a: Mapping[str, float], b: Mapping[str, float]) -> Iterator[Row]:
    for name in dict.fromkeys([*a, *b]):
        x, y = a.get(name), b.get(name)
        both = x is not None and y is not None
        words = [f"{value:.6g}" if value is not None else "" for value in (x, y)]
        yield Row(part, name, *words, y - x if both else float("nan"), both and x == y)


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    if isinstance(value, dict) and value:
        out: dict[str, str] = {}
        for key, inner in value.items():
            out |= _flat(inner, f"{prefix}.{key}" if prefix else str(key))
        return out
    return {prefix: json.dumps(value, sort_keys=True)} if prefix else {}


def _settings(result: Result) -> dict[str, str]:
    """All settings that its stages read, among them those of the prior."""
    out = {"quality": result.quality}
    for reader in result.stages.values():
        out |= _flat(reader.manifest.get("settings", {}))
    return out


def _codes(result: Result) -> dict[str, str]:
    return {stage: str(reader.manifest.get("code", "")) for stage, reader in result.stages.items()}


def _versions(result: Result) -> dict[str, str]:
    out: dict[str, str] = {}
    for reader in result.stages.values():
        for library, version in reader.manifest.get("versions", {}).items():
            known = out.get(library, version)
            out[library] = known if version in known.split(", ") else f"{known}, {version}"
        device = reader.manifest.get("device", {})
        out["device"] = str(device.get("kind", "")) or out.get("device", "")
    return out


def _plan(result: Result) -> dict[str, str]:
    """Component -> what the last stage that decides about it says."""
    out: dict[str, str] = {}
    for stage, file in (
        ("plan", "plan.json"),
        ("emission", "emission.json"),
        ("shading", "shading.json"),
        ("affines", "affines.json"),
        ("render", "render.json"),
    ):
        reader = result.stages.get(stage)
        if reader is None or not reader.has(file):
            continue
        for item in reader.json(file).get("plan", []):
            word = "in" if item.get("included") else "out"
            out[item["component"]] = f"{word}: {item.get('reason', '')}"
    return out


def _scores(result: Result) -> dict[str, float]:
    reader = result.stages.get("metrics")
    if reader is None:
        return {}
    table = reader.table("metrics.parquet")
    values: dict[str, list[float]] = {}
    for i, value in enumerate(table["value"]):
        key = "/".join(str(table[column][i]) for column in ("quantity", "metric", "protocol"))
        values.setdefault(key, []).append(float(value))
    return {key: float(np.mean(found)) for key, found in values.items()}


def _objects(a: Result, b: Result) -> tuple[dict[str, float], dict[str, float]]:
    """Object and channel -> mean over its cells, of both. The same pieces of surface have the names of `a`, because names that
    nobody gave follow the predictions."""
    of_faces = (result["segmentation"].manifest["files"]["faces.parquet"]["sha256"] for result in (a, b))
    alike = len(set(of_faces)) == 1
    return _of_objects(a, a), _of_objects(b, a if alike else b)


def _of_objects(result: Result, named: Result) -> dict[str, float]:
    """Object and channel -> mean over its cells, with the names of another result."""
    cells, fitted = result["base"].table("cells.parquet"), result["affines"].table("cells.parquet")
    table = named["segmentation"].table("objects.parquet")
    owner = cells["object_id"].astype(np.int64)
    known = owner >= 0
    count = np.bincount(owner[known], minlength=1)
    out: dict[str, float] = {}
    for number, name in zip(table["object_id"].tolist(), table["name"], strict=True):
        label = f"{number} {name}"
        if number < len(count) and count[number]:
            on = owner == number
            out |= {f"{label}/{channel}": float(fitted[channel][on].mean(dtype=np.float64)) for channel in CHANNELS}
    return out


def _views(a: Result, b: Result) -> list[tuple[str, str]]:
    """Names of the views that both have, spread evenly over them: of the same name from about the same place, because poses are
    corrected, or from the very same place."""
    second = CaptureReader(b["capture"]).views
    pairs = []
    for view in CaptureReader(a["capture"]).views:
        apart = [float(np.abs(v.world_from_camera - view.world_from_camera).max()) for v in second]
        near = [v for v, by in zip(second, apart, strict=True) if by < (NEAR_POSE if v.name == view.name else SAME_POSE)]
        if near:
            same = next((v for v in near if v.name == view.name), near[0])
            pairs.append((view.name, same.name))
    places = np.unique(np.linspace(0, len(pairs) - 1, min(VIEWS, len(pairs))).round().astype(int)) if pairs else []
    return [pairs[place] for place in places]


def _layers(result: Result, view: str) -> dict[str, np.ndarray]:
    """Pictures of a view, (H, W, 3) in [0, 1]: the albedo linear, the re-rendering as sensor values."""
    out = {}
    file = f"maps/{view}.exr"
    if result["affines"].has(file):
        channels = result["affines"].exr(file)
        out = {
            "albedo": rgb(channels, "albedo"),
            "roughness": np.repeat(channels["roughness"].astype(np.float32)[..., None], 3, -1),
            "metallic": np.repeat(channels["metallic"].astype(np.float32)[..., None], 3, -1),
        }
    reader = result.stages.get("render")
    if reader is not None and reader.has(file):
        out["re-rendering"] = rgb(reader.exr(file), "ldr")
    return out


def _strips(a: Result, b: Result) -> tuple[list[Strip], list[Row]]:
    strips, rows = [], []
    for one, other in _views(a, b):
        left, right = _layers(a, one), _layers(b, other)
        for layer in (name for name in left if name in right):
            x, y = left[layer], right[layer]
            resized = "" if x.shape == y.shape else f"; {b.name} resampled from {y.shape[1]} x {y.shape[0]}"
            y = y if x.shape == y.shape else _resampled(y, x.shape)
            draw = pictures.linear if layer == "albedo" else pictures.encoded
            off = float(np.abs(x - y).mean())
            note = f"mean {off:.4f}; mean of {a.name} {x.mean():.4f}{resized}"
            tiles = [
                Picture(a.name, pictures.data_uri(draw(np.clip(x, 0, 1)))),
                Picture(b.name, pictures.data_uri(draw(np.clip(y, 0, 1)))),
                Picture("difference, 0 to 0.25", pictures.data_uri(pictures.difference(x, y, np.ones(x.shape[:2], bool))), note),
            ]
            strips.append(Strip(f"{one}, {layer}", tiles))
            rows.append(Row("pictures", f"{one}/{layer}", f"{x.mean():.6g}", f"{y.mean():.6g}", off, off == 0.0))
    return strips, rows


def _resampled(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a picture at another size, box-filtered or interpolated channel by channel."""
    from PIL import Image

    size = (shape[1], shape[0])
    planes = [np.asarray(Image.fromarray(image[..., i].astype(np.float32)).resize(size, Image.Resampling.BOX)) for i in range(3)]
    return np.stack(planes, -1)


def _page(a: Result, b: Result, parts: dict[str, list[Row]], strips: list[Strip]) -> str:
    differing = {part: [row for row in rows if not row.same] for part, rows in parts.items()}
    count = sum(len(rows) for rows in differing.values())
    warnings = []
    if a["capture"].fingerprint != b["capture"].fingerprint:
        warnings.append("The photographs differ, so scores and pictures differ for that reason, too.")
    if not strips:
        warnings.append("No view of the one is at the place of a view of the other: there are no pictures to compare.")
    if a["segmentation"].fingerprint != b["segmentation"].fingerprint:
        warnings.append("The objects were made differently; objects of the same number and name are compared.")
    facts = [
        (
            name,
            f"quality {result.quality}, made of {', '.join(sorted({r.directory.parent.name for r in result.stages.values()}))}",
        )
        for name, result in ((f"a: {a.name}", a), (f"b: {b.name}", b))
    ]
    titles = {"settings": "Settings that differ", "code": "Code of stages that differs", "versions": "Versions that differ"}
    tables = [
        Table(title, [], ["", a.name, b.name], [[r.name, r.a or "–", r.b or "–"] for r in differing[part]], note="words")
        for part, title in [*titles.items(), ("plan", "Decisions of the plan that differ")]
    ]
    priors = [r for r in parts["settings"] if r.name.startswith("prior.")]
    tables.insert(1, Table("Priors", [], ["", a.name, b.name], [[r.name, r.a or "–", r.b or "–"] for r in priors], note="words"))
    scores = [[*r.name.split("/"), _short(r.a), _short(r.b), _signed(r.difference), _better(r)] for r in parts["scores"]]
    tables.append(Table("Scores", [], ["quantity", "metric", "protocol", a.name, b.name, "b - a", "better"], scores))
    most = sorted(differing["objects"], key=lambda r: -abs(r.difference) if np.isfinite(r.difference) else -1.0)[:OBJECTS]
    objects = [[*r.name.rsplit("/", 1), _short(r.a), _short(r.b), _signed(r.difference)] for r in most]
    left = len(differing["objects"]) - len(most)
    more = f" ({left} more in compare.parquet)" if left else ""
    tables.append(Table(f"Materials by object{more}", [], ["object", "channel", a.name, b.name, "b - a"], objects))
    return template(TEMPLATE).render(
        title=f"{a.name} and {b.name}",
        headline="No difference." if not count else f"{count} of {sum(map(len, parts.values()))} lines of the table differ.",
        facts=facts,
        notes=["Everything is in compare.parquet: part, name, a, b, difference (b - a), same."],
        warnings=warnings,
        tables=tables,
        strips=strips,
        columns=3,
    )


def _short(value: str) -> str:
    return f"{float(value):.4g}" if value else "–"


def _signed(value: float) -> str:
    return f"{value:+.3g}" if np.isfinite(value) and value else ("0" if value == 0 else "–")


def _better(row: Row) -> str:
    higher = METRICS[row.name.split("/")[1]].higher_is_better if row.name.split("/")[1] in METRICS else None
    if higher is None or not np.isfinite(row.difference) or row.difference == 0:
        return ""
    return "b" if (row.difference > 0) == higher else "a"
