"""Rows of the study `relighting` that outlive its folder, and the page that is made from them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iif_core.errors import InputError
from iif_core.evaluation.catalogue import METRICS
from lab.relit.measures import RELIT_PROTOCOLS
from lab.studies import table
from lab.studies.files import RELIT, load_study
from lab.studies.grid import LIGHTS, sheet, write_grid
from workflow.artifacts.files import write_atomically
from workflow.report.blocks import fill, markdown
from workflow.runtime import fingerprint as fp
from workflow.settings.names import REPOSITORY

if TYPE_CHECKING:
    import pandas as pd

STUDY = "relighting"
KEPT = REPOSITORY / "lab/notebook/data/relighting.csv"
LAMPS = REPOSITORY / "lab/notebook/data/relighting_lamps.csv"
PAGE = REPOSITORY / "lab/notebook/relighting.md"
PICTURE = REPOSITORY / "lab/notebook/pictures/relighting.jpg"
WIDTH = 1200
"""Pixels of the picture of the page, which has the first room alone, so that its labels can be read."""
NOISE = "noise"
KEY = ("scene", "variant", "seed", "light", "view", "quantity", "metric", "protocol")
COLUMNS = (*KEY, "value", "found", "seconds", "fingerprint")
LAMP_COLUMNS = ("scene", "lamp", "name", "share_of_power", "found", "overlap", "power_ratio", "emitters", "unmatched_share")
ASKED = {"raw": 26.0, "scaled": 30.8}
"""PSNR of single lamps that is aimed at, in dB."""
LUXREMIX = ("LuxRemix (its scenes, not these)", "", "", "30.8", "0.867", "0.091", "", "")
"""What LuxRemix prints for single lamps after a gain per channel."""
WORDS = {f"relit_{kind}": words for kind, words in LIGHTS.items()}


def keep(quality: str) -> None:
    """Add the rows of the cells that are finished to lab/notebook/data/relighting.csv, and make the page anew: tables, picture.

    Raises:
        InputError: nothing was ever scored.
    """
    import pandas as pd

    new, lamps = finished(quality)
    frame = _joined(new, KEPT, ["scene", "variant", "seed"], list(KEY), COLUMNS)
    if frame.empty:
        raise InputError(
            f"results/: no cell of the study {STUDY} is finished;"
            f" snakemake -s lab/Snakefile --cores 2 results/studies/{STUDY}.parquet"
        )
    matched = _joined(lamps, LAMPS, ["scene"], ["scene", "lamp"], LAMP_COLUMNS)
    for path, rows in ((KEPT, frame), (LAMPS, matched)):
        write_atomically(path, lambda temporary, rows=rows: rows.to_csv(temporary, index=False, float_format="%.5g"))
    blocks = tables(pd.read_csv(KEPT), pd.read_csv(LAMPS))
    text = fill(PAGE.read_text(), blocks)
    write_atomically(PAGE, lambda temporary: temporary.write_text(text))
    if len(new):
        write_grid(STUDY, quality)
        write_atomically(PICTURE, lambda temporary: save_picture(sheet(STUDY, quality, rooms=1, letters=10.0), temporary))


def save_picture(figure: Any, path: Path) -> None:
    """Save a sheet as the picture of the page."""
    figure.savefig(path, dpi=WIDTH / figure.get_figwidth(), format="jpeg", pil_kwargs={"quality": 88})


def _joined(new: pd.DataFrame, path: Path, cell: list[str], order: list[str], columns: tuple[str, ...]) -> pd.DataFrame:
    """Put new rows in the place of older ones of the same cells."""
    import pandas as pd

    parts = [new]
    if path.is_file():
        older = pd.read_csv(path)
        done = set(map(tuple, new[cell].drop_duplicates().to_numpy().tolist()))
        parts.insert(0, older[[tuple(row) not in done for row in older[cell].to_numpy().tolist()]])
    whole = pd.concat([part for part in parts if len(part)] or [new])
    return whole.sort_values(order, kind="stable").reindex(columns=list(columns))


def finished(quality: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the scores of the finished cells (`COLUMNS`), and how the lamps of each room were matched (`LAMP_COLUMNS`)."""
    import pandas as pd

    from workflow.artifacts import StageReader

    study, cells, _ = table.plan(STUDY, quality)
    rows, lamps = [], []
    for cell in cells:
        folder = table.home(cell, quality, "relit_scores")
        if not (folder / "manifest.json").is_file():
            continue
        reader = StageReader(folder, "relit_scores", folder.parent.name)
        if reader.fingerprint != fp.fingerprint("relit_scores", cell.name, quality):
            continue
        frame = pd.DataFrame(reader.table("scores.parquet"))
        frame = frame[frame["variant"] == (study.variants[cell.variant].row or "result")]
        rows.append(frame.assign(scene=cell.scene, variant=cell.variant, seed=cell.seed, fingerprint=reader.fingerprint))
        if cell.variant == next(iter(study.variants)):
            lamps += list(_lamp_rows(cell.scene, reader.json("scores.json")))
    scores = pd.concat(rows) if rows else pd.DataFrame(columns=list(COLUMNS))
    return scores.reindex(columns=list(COLUMNS)), pd.DataFrame(lamps, columns=list(LAMP_COLUMNS))


def _lamp_rows(scene: str, facts: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for lamp in facts["lamps"]:
        emitters = " ".join(map(str, lamp["emitters"]))
        yield {"scene": scene, **lamp, "emitters": emitters, "unmatched_share": facts["unmatched_share"]}


def tables(frame: pd.DataFrame, lamps: pd.DataFrame) -> dict[str, str]:
    """Return the tables of the page in Markdown, by name."""
    made = {
        "verdict": _verdict(frame),
        "methods": _methods(frame),
        "lights": _lights(frame),
        "noise": _noise(frame),
        "lamps": _lamps(lamps),
        "pictures": _pictures(frame),
    }
    return {name: "\n".join(lines) for name, lines in made.items()}


def _labels() -> dict[str, str]:
    return {name: variant.label or name for name, variant in load_study(STUDY).variants.items()}


def _mean(frame: pd.DataFrame, **chosen: Any) -> float:
    for column, value in chosen.items():
        frame = frame[frame[column] == value]
    return float(frame["value"].mean()) if len(frame) else float("nan")


def _text(value: float, metric: str = "psnr") -> str:
    return f"{value:.{METRICS[metric].decimals}f}" if value == value else ""


def _scenes(frame: pd.DataFrame) -> list[str]:
    order = load_study(STUDY).scenes
    return sorted(set(frame["scene"]), key=lambda scene: order.index(scene) if scene in order else len(order))


def _verdict(frame: pd.DataFrame) -> list[str]:
    """Single lamps of the full result: all that were lit alone, and those of them that were found."""
    own = frame[(frame["variant"] == "ours") & (frame["quantity"] == "relit_lamp")]
    body = []
    for scene in _scenes(own):
        rows = own[own["scene"] == scene]
        lights = rows.drop_duplicates("light")
        count = f"{int(lights['found'].sum())} of {len(lights)}"
        cells = [_text(_mean(rows, metric="psnr", protocol=p)) for p in RELIT_PROTOCOLS]
        hits = [_text(_mean(rows[rows["found"]], metric="psnr", protocol=p)) for p in RELIT_PROTOCOLS]
        body.append([scene, count, *cells, *hits])
    body.append(["asked", "", f"{ASKED['raw']:.1f}", "", f"{ASKED['scaled']:.1f}", "", "", ""])
    head = ["room", "lamps found", *(f"all: {p}" for p in RELIT_PROTOCOLS), *(f"found: {p}" for p in RELIT_PROTOCOLS)]
    return markdown(head, body)


def _methods(frame: pd.DataFrame) -> list[str]:
    """Single lamps that were found, every method."""
    own, labels, body = frame[(frame["quantity"] == "relit_lamp") & frame["found"]], _labels(), []
    for scene in _scenes(own):
        for name, label in labels.items():
            rows = own[(own["scene"] == scene) & (own["variant"] == name)]
            if rows.empty or name == NOISE:
                continue
            psnr = [_text(_mean(rows, metric="psnr", protocol=p)) for p in RELIT_PROTOCOLS]
            rest = [_text(_mean(rows, metric=m, protocol="scaled"), m) for m in ("ssim", "lpips", "flip")]
            body.append([f"{scene}: {label}", *psnr, *rest, _text(_mean(rows, metric="relative", protocol="raw"), "relative")])
    body.append(list(LUXREMIX))
    head = [
        "room: method",
        *(f"PSNR {p}" for p in RELIT_PROTOCOLS),
        "SSIM scaled",
        "LPIPS scaled",
        "FLIP scaled",
        "relative error raw",
    ]
    return markdown(head, [[row[0], *row[1:4], *row[4:]] for row in body if len(row) == len(head)])


def _lights(frame: pd.DataFrame) -> list[str]:
    """Every kind of light, every method: PSNR as it is and after a gain per channel."""
    labels, body = _labels(), []
    for scene in _scenes(frame):
        for name, label in labels.items():
            rows = frame[(frame["scene"] == scene) & (frame["variant"] == name) & (frame["metric"] == "psnr")]
            if rows.empty or name == NOISE:
                continue
            cells = []
            for quantity in RELIT:
                pair = [_text(_mean(rows, quantity=quantity, protocol=p)) for p in ("raw", "scaled")]
                cells.append(" / ".join(pair) if all(pair) else "")
            body.append([f"{scene}: {label}", *cells])
    return markdown(["room: method", *(f"{WORDS[q]}, raw / scaled" for q in RELIT)], body)


def _noise(frame: pd.DataFrame) -> list[str]:
    rows = frame[(frame["variant"] == NOISE) & (frame["metric"] == "psnr") & (frame["protocol"] == "raw")]
    body = [[scene, *(_text(_mean(rows, scene=scene, quantity=q)) for q in RELIT)] for scene in _scenes(rows)]
    return markdown(["room", *(WORDS[q] for q in RELIT)], body)


def _lamps(lamps: pd.DataFrame) -> list[str]:
    body = []
    for row in lamps.itertuples():
        found = "yes" if row.found else "no"
        ratio = f"{row.power_ratio:.2f}" if row.found else ""
        share = f"{100 * row.share_of_power:.1f} %"
        body.append([row.scene, f"{row.lamp} {row.name}", share, found, f"{100 * row.overlap:.0f} %", ratio])
    heads = ["room", "lamp of the source", "share of all power", "found", "of its surface", "power, found over true"]
    elsewhere = lamps.drop_duplicates("scene")
    said = [f"{row.scene} {100 * row.unmatched_share:.1f} %" for row in elsewhere.itertuples()]
    return [*markdown(heads, body, 2), "", f"Power of emitting faces that belong to no lamp of the source: {', '.join(said)}."]


def _pictures(frame: pd.DataFrame) -> list[str]:
    """The full result, light by light."""
    own, body = frame[frame["variant"] == "ours"], []
    for scene in _scenes(own):
        for light in dict.fromkeys(own[own["scene"] == scene]["light"]):
            rows = own[(own["scene"] == scene) & (own["light"] == light)]
            psnr = [_text(_mean(rows, metric="psnr", protocol=p)) for p in RELIT_PROTOCOLS]
            noise = _mean(frame, scene=scene, light=light, variant=NOISE, metric="psnr", protocol="raw")
            word = "yes" if rows["found"].iloc[0] else "no: black"
            body.append(
                [scene, light, word, *psnr, _text(_mean(rows, metric="relative", protocol="raw"), "relative"), _text(noise)]
            )
    heads = ["room", "light", "found", *(f"PSNR {p}" for p in RELIT_PROTOCOLS), "relative error raw", "noise, PSNR"]
    return markdown(heads, body, 3)
