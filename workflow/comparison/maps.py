"""`score/<scene>`: scores of anyone's maps against a scene with truth (docs/guide/comparing.md).

Stage `metrics` uses the same truth, pixels, protocols and metrics, so its scores and these can be compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.errors import InputError
from iif_core.evaluation import metrics
from iif_core.evaluation.catalogue import METRICS, METRICS_OF, PROTOCOLS
from iif_core.numerics.color import linear_from_srgb
from iif_core.reflectance.material import PROPERTIES
from workflow.artifacts import StageReader
from workflow.artifacts.files import read_exr, write_atomically
from workflow.artifacts.store import rgb
from workflow.comparison.named import QUANTITIES
from workflow.intake.documents import reading
from workflow.report import pictures
from workflow.report.page import Picture, Strip, Table, template
from workflow.runtime import fingerprint as fp
from workflow.scene.normal_form import CaptureReader, View
from workflow.scoring.scores import MaterialTruth, ScoreRows, material_truth, perceptual_networks
from workflow.settings.names import did_you_mean
from workflow.sources.folder_scene import images

if TYPE_CHECKING:
    import pandas as pd

EXTENSIONS = (".exr", ".png")
COLOURS = ("auto", "srgb", "linear")
LAYERED = (*PROPERTIES, "emission")
"""What is read from files with a layer for each quantity."""
SHOWN_VIEWS = 6
SUSPICIOUS_DB = 3.0
"""Albedo that is so much nearer to the truth, after a gain, when it is decoded the other way, was probably decoded wrongly."""
TEMPLATE = Path(__file__).with_name("page.html.j2")


@dataclass(frozen=True)
class Maps:
    """The files of somebody's maps.

    Attributes:
        folder: as it was given.
        files: quantity -> view -> file.
        srgb: whether a file of albedo holds sRGB values, by its ending.
    """

    folder: Path
    files: dict[str, dict[str, Path]]
    srgb: dict[str, bool]


def find(folder: Path, colour: str, views: list[str]) -> Maps:
    """List the maps in a folder: `<quantity>/<view>.exr` or `.png`, or `<view>.exr` with a layer for each quantity.

    Args:
        folder: the maps.
        colour: how albedo is decoded: `srgb`, `linear`, or `auto`: PNG as sRGB and EXR as it is.
        views: names of the views of the scene.

    Raises:
        InputError: no such folder, nothing in it, files of unknown views, two files of one view.
    """
    if colour not in COLOURS:
        raise InputError(f"colour={colour}: allowed are {', '.join(COLOURS)}; it says how files of albedo are decoded")
    layout = (
        f"needed: {', '.join(f'{q}/<view>.exr' for q in PROPERTIES)} or .png, as many of them as there are, or <view>.exr with"
        " the layers of maps/ of a finished scene"
    )
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of maps; {layout}")
    files: dict[str, dict[str, Path]] = {}
    for path in sorted(p for p in folder.glob("*.exr") if p.is_file()):
        _known(path, views)
        for quantity in (q for q in LAYERED if f"{q}.R" in (channels := _layers(path)) or q in channels):
            files.setdefault(quantity, {})[path.stem] = path
    for quantity in QUANTITIES:
        found = files.get(quantity, {})
        inside = sorted((folder / quantity).iterdir()) if (folder / quantity).is_dir() else []
        for path in (p for p in inside if p.is_file() and not p.name.startswith(".")):
            if path.suffix.lower() not in EXTENSIONS:
                raise InputError(f"{path}: a {path.suffix or 'file without ending'}; maps are .exr or .png")
            _known(path, views)
            if path.stem in found:
                raise InputError(f"{path}: {found[path.stem].name} is there, too; one file for each view")
            found[path.stem] = path
        if found:
            files[quantity] = found
    if not files:
        raise InputError(f"{folder}: no maps; {layout}")
    return Maps(folder, files, {ending: colour == "srgb" or (colour == "auto" and ending == ".png") for ending in EXTENSIONS})


def _layers(path: Path) -> dict[str, np.ndarray]:
    images.header(path)
    with reading(path, "cannot be read"):
        return read_exr(path)


def _known(path: Path, views: list[str]) -> None:
    if path.stem not in views:
        shown = ", ".join(views[:8]) + (" ..." if len(views) > 8 else "")
        raise InputError(
            f"{path}: the scene has no view {path.stem}.{did_you_mean(path.stem, views)} Its views are {shown};"
            " rename the file, or take it away"
        )


def read_map(maps: Maps, quantity: str, view: View, srgb: bool | None = None) -> np.ndarray:
    """Read one map at the size of its view: (H, W, 3), or (H, W) for roughness and metallic; float32, linear.

    Args:
        maps, quantity, view: which.
        srgb: decode albedo as sRGB; None = as `maps` says.

    Raises:
        InputError: another size, values that are not finite or negative, radiance in a PNG, a file that cannot be read.
    """
    path = maps.files[quantity][view.name]
    exr, three = path.suffix.lower() == ".exr", quantity not in ("roughness", "metallic")
    if quantity == "emission" and not exr:
        raise InputError(f"{path}: radiance does not fit into a PNG; write emission as linear EXR")
    size = images.header(path).size
    if size != (view.width, view.height):
        raise InputError(
            f"{path}: {size[0]} x {size[1]} pixels; view {view.name} has {view.width} x {view.height}. Resample it"
            " yourself, as your method would: no resampling is right for every map"
        )
    if exr and path.parent == maps.folder:
        channels = _layers(path)
        values = rgb(channels, quantity) if three else channels[quantity].astype(np.float32)
    elif exr:
        values = images.load_map(path, 3 if three else 1)
    else:
        loaded = images.load_photo(path, colour="srgb").pixels  # as it is: whoever asks says how it is encoded
        values = loaded if three else loaded[..., 0]
    bad = int(np.size(values) - np.isfinite(values).sum())
    if bad:
        raise InputError(f"{path}: {bad} values are NaN or infinite; write a number for every pixel, 0 where there is none")
    if values.min() < 0:
        raise InputError(
            f"{path}: {int((values < 0).sum())} values are negative, the least {values.min():.3g}; maps are at least 0"
        )
    decode = maps.srgb[path.suffix.lower()] if srgb is None else srgb
    return linear_from_srgb(values).astype(np.float32) if quantity == "albedo" and decode else values.astype(np.float32)


@dataclass(frozen=True)
class _Scene:
    capture: CaptureReader
    segmentation: StageReader


def _scene(scene: str, quality: str) -> _Scene:
    readers = {}
    for stage in ("capture", "segmentation"):
        home = fp.home(stage, scene, quality)
        readers[stage] = StageReader(Path("results") / home / stage, stage, home)
    capture = CaptureReader(readers["capture"])
    if not capture.has_truth:
        raise InputError(f"scene {scene}: no ground truth, so maps cannot be scored; a folder scene with `truth/` has it")
    return _Scene(capture, readers["segmentation"])


def score(scene: str, folder: Path, quality: str, colour: str = "auto") -> tuple[ScoreRows, list[str], Any]:
    """Score the maps in a folder; with LPIPS on VGG16 where stage metrics of the scene has it.

    Returns:
        The scores under variant `maps`, what is to be said about them, and (views scored, maps of them, truths) for the page.
    """
    found = _scene(scene, quality)
    views = {view.name: view for view in found.capture.views}
    maps = find(folder, colour, list(views))
    networks = perceptual_networks(json.loads(fp.resolved(scene, quality))["metrics"]["lpips_vgg"])
    networks_of = {q: networks if q == "albedo" else {"alex": networks["alex"]} for q in (*PROPERTIES, "rgb")}
    exposure = dict(zip(views, found.capture.exposures().tolist(), strict=True))
    rows, other, kept = ScoreRows(), [], []
    for name in (name for name in views if any(name in files for files in maps.files.values())):
        view = views[name]
        truth = material_truth(found.capture, found.segmentation, view, networks_of)
        own = {q: read_map(maps, q, view) for q, files in maps.files.items() if name in files}
        for quantity, scores in _scores(found.capture, view, truth, own, exposure[name], networks_of):
            rows.add("maps", name, quantity, scores)
        if "albedo" in own:
            flipped = read_map(maps, "albedo", view, not maps.srgb[maps.files["albedo"][name].suffix.lower()])
            other.append([_scaled(truth, own["albedo"]), _scaled(truth, flipped)])
        if len(kept) < SHOWN_VIEWS:
            kept.append((view, own, truth))
    return rows, _notes(maps, list(views), other), (maps, kept)


def _scores(
    capture: CaptureReader,
    view: View,
    truth: MaterialTruth,
    own: Mapping[str, np.ndarray],
    exposure: float,
    networks: Mapping[str, Any],
) -> Iterator[tuple[str, list[metrics.Score]]]:
    """Yield (quantity, scores) as stage `metrics` computes them for the result."""
    for quantity in PROPERTIES:
        if quantity in own:
            every = [m for m in METRICS_OF[quantity] if m != "lpips_vgg"]
            scores = truth.scores(dict(own), quantity, every)
            if quantity == "albedo" and "vgg" in networks["albedo"]:
                scores += truth.scores(dict(own), quantity, ("lpips_vgg",), ("raw", "scaled"))
            yield quantity, scores
    if "emission" in own:
        yield "emission", metrics.score_map("emission", own["emission"], truth.truth.emission, truth.masks["emission"])
    if "rgb" in own:
        photo, valid = capture.photo(view, held_out=True)
        hit = capture.gbuffer(view)[1] >= 0
        sensor, shown = photo, own["rgb"]
        if capture.is_hdr:
            sensor, shown = np.clip(exposure * photo, 0, 1), np.clip(exposure * shown, 0, 1)
        name = "rgb_held_out" if view.split == "test" else "rgb"
        yield name, metrics.score_map("rgb", shown, sensor, valid & hit, encoded=not capture.is_hdr, networks=networks["rgb"])


def _scaled(truth: MaterialTruth, albedo: np.ndarray) -> float:
    scores = truth.scores({"albedo": albedo}, "albedo", ("psnr",))
    return next((s.value for s in scores if s.protocol == "scaled" and s.value is not None), float("nan"))


def _notes(maps: Maps, views: list[str], other: list[list[float]]) -> list[str]:
    """Return what a reader of the scores must know."""
    out = []
    for quantity, files in maps.files.items():
        missing = [name for name in views if name not in files]
        what = f"{quantity}: {len(files)} of {len(views)} views"
        if missing:
            what += f"; without {', '.join(missing[:8])}{' ...' if len(missing) > 8 else ''}, so its means are of other views"
        out.append(what)
    if "albedo" in maps.files:
        endings = {path.suffix.lower() for path in maps.files["albedo"].values()}
        words = {True: "decoded from sRGB", False: "taken as linear"}
        out.append("albedo: " + ", ".join(f"{ending} files are {words[maps.srgb[ending]]}" for ending in sorted(endings)))
        if other and np.isfinite(other).all():
            as_is, flipped = np.mean(other, 0)
            if flipped > as_is + SUSPICIOUS_DB:
                first = next(iter(maps.files["albedo"].values())).suffix.lower()
                word = "linear" if maps.srgb[first] else "srgb"
                out.append(
                    f"warning: albedo is {flipped - as_is:.1f} dB nearer to the truth (after a gain) when it is decoded the other"
                    f" way; if that is right, say colour={word}"
                )
    if "rgb" in maps.files:
        out.append("rgb: compared with the photographs; sensor values for 8-bit photographs, radiance for linear ones")
    return out


def write_scores(scene: str, folder: Path, quality: str, colour: str, output: Path) -> None:
    """Write scores.parquet, scores.csv and score.html into `output`, and print the means."""
    import pandas as pd

    rows, notes, (maps, kept) = score(scene, folder, quality, colour)
    frame = pd.DataFrame(rows.table(scene, {"maps"}))
    output.mkdir(parents=True, exist_ok=True)
    write_atomically(output / "scores.parquet", lambda path: frame.to_parquet(path, index=False))
    write_atomically(output / "scores.csv", partial(frame.to_csv, index=False, float_format="%.6g"))
    table = means_table(frame)
    text = _page(scene, folder, notes, rows.missing, table, maps, kept)
    write_atomically(output / "score.html", lambda path: path.write_text(text))
    print("\n".join([*notes, "", *("  ".join(row) for row in [table.heads, *table.rows])]))


def means_table(frame: pd.DataFrame) -> Table:
    """Tabulate the means over views: a row for each quantity and protocol, a column for each metric."""
    names = [m for m in METRICS if (frame["metric"] == m).any()]
    means = frame.groupby(["quantity", "protocol", "metric"])["value"].agg(["mean", "count"])
    body = []
    for quantity in dict.fromkeys(frame["quantity"]):
        for protocol in PROTOCOLS:
            own = {m: means.loc[quantity, protocol, m] for m in names if (quantity, protocol, m) in means.index}
            if not own:
                continue
            count = int(max(row["count"] for row in own.values()))
            cells = [f"{own[m]['mean']:.{METRICS[m].decimals}f}" if m in own else "–" for m in names]
            body.append([quantity, PROTOCOLS[protocol].words, str(count), *cells])
    arrows = {True: " ↑", False: " ↓", None: ""}
    heads = [f"{METRICS[m].short}{arrows[METRICS[m].higher_is_better]}" for m in names]
    return Table("Scores, means over the views", [], ["quantity", "protocol", "views", *heads], body)


def _page(
    scene: str, folder: Path, notes: list[str], missing: list[dict[str, str]], table: Table, maps: Maps, kept: list[Any]
) -> str:
    masks = (
        "Pixels with true emission, without truth and without surface do not count; for albedo neither do true mirrors"
        " (roughness below 0.05). Emission counts wherever there is truth."
    )
    protocols = "; ".join(PROTOCOLS[p].explanation for p in ("raw", "scaled", "oracle_affine"))
    facts = [
        ("maps", str(folder)),
        ("pixels that count", masks),
        ("protocols", f"{protocols}. Each quantity has the protocols of stage metrics"),
        ("colour", "scores of albedo are of linear values; pictures below are shown in sRGB"),
    ]
    strips = [strip for view, own, truth in kept for strip in _strips(view, own, truth)]
    unscored = [f"{row['view']}, {row['quantity']}, {row['metric']} ({row['protocol']}): {row['reason']}" for row in missing[:20]]
    return template(TEMPLATE).render(
        title=f"{folder.name} against the truth of {scene}",
        headline="",
        facts=facts,
        notes=[note for note in notes if not note.startswith("warning")],
        warnings=[note for note in notes if note.startswith("warning")] + unscored,
        tables=[table],
        strips=strips,
        columns=3,
    )


def _strips(view: View, own: Mapping[str, np.ndarray], truth: MaterialTruth) -> Iterator[Strip]:
    true = {"albedo": truth.truth.albedo, "roughness": truth.truth.roughness, "metallic": truth.truth.metallic}
    for quantity in (q for q in PROPERTIES if q in own):
        draw = pictures.linear if quantity == "albedo" else pictures.grey
        found, wanted, mask = own[quantity], true[quantity], truth.masks[quantity]
        tiles = [
            Picture("maps", pictures.data_uri(draw(np.clip(found, 0, 1)))),
            Picture("truth", pictures.data_uri(draw(wanted))),
            Picture("difference, 0 to 0.25", pictures.data_uri(pictures.difference(found, wanted, mask))),
        ]
        yield Strip(f"{view.name}, {quantity}", tiles)
