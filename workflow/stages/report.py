"""report: one page to judge the result by, and the plan of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.evaluation.catalogue import METRICS
from iif_core.numerics import color
from workflow.artifacts.store import ids_from_disk, material_maps, prediction_numbers, rgb
from workflow.decisions import expected, numerics
from workflow.decisions.plan import GAINS, with_override
from workflow.decisions.record import FORCED, PROVISIONAL, SETTLED, plan_text
from workflow.exporters.object_table import read_csv
from workflow.report import pictures as pic
from workflow.report.downloads import commands, downloads
from workflow.report.page import (
    Number,
    Page,
    Pair,
    Picture,
    Strip,
    Table,
    ViewRows,
    explain,
    explanation_key,
    number,
    render_page,
    score_table,
)
from workflow.report.verdict import LIMITS, Evidence, judge
from workflow.report.wording import fit_words, percent, reason_words, significant
from workflow.runtime import forecast
from workflow.runtime.job import Job
from workflow.runtime.timings import read_timings
from workflow.scene.base_scene import read_base
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered, read_recovered, response_samples
from workflow.settings import active_plan
from workflow.settings.prior import members
from workflow.stages import publish

PLAN_KEYS = (
    "component",
    "included",
    "status",
    "measure",
    "value",
    "threshold",
    "gain_nats",
    "error_nats",
    "rows",
    "reason",
    "components",
)
ERROR_RANGE = 0.25
COVERAGE_RANGE = 4.0
UNCERTAINTY_RANGE = 0.2
CHANNEL_COLOURS = ("red", "green", "blue")
WIDTH, HERO_WIDTH, PAIR_WIDTH = 448, 768, 288
"""Longest side of a picture: of maps, of the first one, and of the pairs of all views. With six views and photographs as noisy
as those of a phone the page stays below 15 MB."""
PAIRS = 60
"""Largest number of photographs that are shown next to their re-rendering; of more, this many are taken evenly."""


NUMERICS = ("base", "emission", "shading", "affines")
"""Stages that say where their arithmetic came close to its end."""


def run(job: Job) -> None:
    """Write report.html, verdict.json and plan.yaml."""
    capture = CaptureReader(job.read("capture"))
    recovered = read_recovered(job)
    summary = job.read("metrics").json("summary.json")
    cost = forecast.together(expected.STAGES, job.scene, job.quality)
    plan = [expected.with_expectation(item, cost) for item in collect_plan(job)]
    job.writer.bytes("plan.yaml", plan_text(job.scene, job.quality, plan).encode())
    response_svg, response_note = _response(job, capture)
    emission = _document(job, "emission", "emission.json")
    warned = [(stage, _document(job, stage, f"{stage}.json")) for stage in NUMERICS]
    tables = _tables(summary)
    scores = _scores_of_views(job)
    ranked = _ranked(capture, scores)
    names = publish.published_names({stage: job.read(stage) for stage in job.stage.upstream})
    overrides = [(item["component"], item["override"]) for item in plan if item.get("override")]
    verdict = judge(_evidence(job, capture, recovered, summary))
    job.writer.json("verdict.json", verdict.document())
    page = Page(
        scene=job.scene,
        credit=job.settings.report.credit or str(capture.facts.get("credit", "")),
        verdict=verdict,
        hero=_pair(job, capture, ranked[len(ranked) // 2], scores, HERO_WIDTH),
        hero_note=_hero_note(ranked[len(ranked) // 2], scores),
        headline=_headline(summary, capture, recovered),
        numbers=_numbers(summary),
        explanations=_explanations(summary),
        facts=_facts(job, capture, recovered),
        notes=[str(note) for note in capture.facts.get("notes", [])] + [str(n) for n in emission.get("notes", [])],
        warnings=numerics.warnings(warned),
        plan=[{**item, "reason": reason_words(item["component"], str(item.get("reason", "")))} for item in plan],
        tables=tables,
        pairs=_pairs(job, capture, ranked, scores),
        pairs_note=_pairs_note(job, ranked, summary),
        views=_views(job, capture, recovered, ranked, scores),
        objects=_objects(job),
        emitters=_emitters(job, recovered),
        emitter_note=_emitter_note(capture, recovered),
        response_svg=response_svg,
        response_note=response_note,
        timings=read_timings(job.scene),
        versions=sorted(job.read("export").manifest.get("versions", {}).items()),
        downloads=downloads(names),
        commands=commands(job.scene, job.quality, overrides, names, active_plan(job.scene)),
        scene_file=_scene_file(job.scene),
    )
    data = render_page(page).encode()
    job.writer.bytes("report.html", data)
    job.log.info("report.html: %.1f MB, %d pictures", len(data) / 1e6, data.count(b"data:image/"))


# ------------------------------------------------------------------------------------------------------------- evidence


def _evidence(job: Job, capture: CaptureReader, recovered: Recovered, summary: dict[str, Any]) -> Evidence:
    """Collect what the stages measured."""
    emission, affines = _document(job, "emission", "emission.json"), _document(job, "affines", "affines.json")
    alignment, registration = capture.facts.get("alignment") or {}, capture.facts.get("registration") or {}
    agreement = [view["agreement"] for view in registration.get("views", {}).values() if view.get("agreement")]
    escape, means = emission.get("escape_share") or {}, summary["means"].get("result", {})
    cache = [
        d["value"]
        for d in _document(job, "shading", "shading.json").get("plan", [])
        if d["component"] == "radiance_cache" and "value" in d
    ]
    probed = _document(job, "plan", "plan.json").get("probes", {}).get("photographed_share")
    emitters = job.read("export").table("emitters.parquet")
    area = emitters["kept"].astype(bool) & (emitters["kind"] == "area")
    scale = affines.get("scale") or {}
    unfitted, uncertainty = _fit_evidence(job)

    def score(quantity: str, metric: str) -> dict[str, Any]:
        return means.get(quantity, {}).get("raw", {}).get(metric, {})

    return Evidence(
        escape=escape.get("secondary"),
        escape_camera=escape.get("primary"),
        depth=alignment.get("depth_median_disagreement"),
        edges=alignment.get("edge_correlation"),
        edges_warn=any("may not be aligned" in str(note) for note in capture.facts.get("notes", [])),
        agreement=float(np.median(agreement)) if agreement else None,
        photographs=len(capture.views),
        lost=len(capture.facts.get("dropped_views") or ()) + len(capture.facts.get("left_out_views") or ()),
        photographed=float(cache[-1]) if cache else probed,
        stability=_document(job, "segmentation", "segmentation.json").get("stability"),
        lamps=int(np.count_nonzero(area)),
        environment=bool(np.any(recovered.light.environment)),
        misfit=emission.get("misfit"),
        light_spread=score("rgb", "light_spread").get("mean"),
        held_out=score("rgb_held_out", "psnr").get("mean"),
        held_out_views=int(score("rgb_held_out", "psnr").get("views", 0)),
        used=score("rgb", "psnr").get("mean"),
        albedo=score("albedo", "psnr").get("mean"),
        roughness=score("roughness", "psnr").get("mean"),
        metallic=score("metallic", "psnr").get("mean"),
        roughness_interval=_roughness_interval(job),
        has_truth=capture.has_truth,
        prior=str(job.read("prior").manifest.get("settings", {}).get("prior", {}).get("kind", "")),
        uncertainty=uncertainty,
        unfitted=unfitted,
        level=str(scale.get("kind", "")),
        level_error=scale.get("relative_error"),
        raised=float(np.exp(emission.get("level_raised") or 0.0)),
        light_scale=recovered.light_scale,
        discrepancy=(affines.get("level_errors") or {}).get("normalised_discrepancy"),
        warnings=[
            (stage, sentence)
            for stage in NUMERICS
            for sentence in numerics.warnings([(stage, _document(job, stage, f"{stage}.json"))])
        ],
    )


def _fit_evidence(job: Job) -> tuple[float | None, float | None]:
    """Return the share of pixels on objects that were not fitted by themselves, and the median uncertainty of the albedo."""
    objects, cells = job.read("affines").table("objects.parquet"), job.read("affines").table("cells.parquet")
    unfitted = None
    if "model" in objects and "pixels" in objects and objects["pixels"].sum() > 0:
        alone = np.array([not str(model).startswith(("population", "identity")) for model in objects["model"]], bool)
        unfitted = float(objects["pixels"][~alone].sum() / objects["pixels"].sum())
    return unfitted, float(np.median(cells["uncertainty"])) if len(cells.get("uncertainty", ())) else None


def _roughness_interval(job: Job) -> float | None:
    """Return half of the 95 % interval of roughness, on its longer side, as the median over the pixels seen; None where less than
    half of them are on objects that have one."""
    width, pixels = [], []
    for row in read_csv(job.read("export").path("objects.csv").read_bytes()):
        value, low, high = (float(row[f"roughness{end}"] or "inf") for end in ("", "_low", "_high"))
        width.append(max(high - value, value - low))
        pixels.append(float(row["pixels"] or 0))
    if not sum(pixels):
        return None
    order = np.argsort(width, kind="stable")
    share = np.cumsum(np.array(pixels)[order])
    middle = width[order[np.searchsorted(share, 0.5 * share[-1])]]
    return middle if np.isfinite(middle) else None


def _scene_file(scene: str) -> str:
    """Return where the settings of the scene stand: its own file, or else the batch table."""
    return next((path for path in (f"config/scenes/{scene}.yaml", "config/batch.tsv") if Path(path).is_file()), "")


# ---------------------------------------------------------------------------------------------------------------- plan


def collect_plan(job: Job) -> list[dict[str, Any]]:
    """Return the plan items in the JSON documents of the stages (key `plan`), with the name of the rule, in the order in which
    their components are first named. What a later stage found replaces what was planned; of gains that no stage had a reason to
    try there are none."""
    items: dict[str, dict[str, Any]] = {}
    for stage in job.stage.upstream:
        reader = job.read(stage)
        for name in reader.names():
            if "/" in name or not name.endswith(".json"):
                continue
            document = reader.json(name)
            found = document.get("plan", []) if isinstance(document, dict) else []
            for item in found if isinstance(found, list) else []:
                kept = {key: item[key] for key in PLAN_KEYS if key in item}
                earlier = items.get(item["component"], {})
                forced = {"status": FORCED} if earlier.get("status") == FORCED else {}
                found_here = {**kept, "included": bool(item.get("included")), **forced, "rule": stage}
                items[item["component"]] = {"status": SETTLED, **found_here}
    untried = {"included": False, "status": SETTLED, "reason": "no stage had a reason to try it"}
    settled = ({**i, **untried} if i["status"] == PROVISIONAL and i["component"] in GAINS else i for i in items.values())
    return [with_override(item) for item in settled]


# ---------------------------------------------------------------------------------------------------------------- text


def _document(job: Job, stage: str, name: str) -> dict[str, Any]:
    reader = read_base(job) if stage == "base" else job.read(stage)
    return reader.json(name) if reader.has(name) else {}


def _headline(summary: dict[str, Any], capture: CaptureReader, recovered: Recovered) -> str:
    means = summary["means"].get("result", {})
    psnr = means.get("rgb", {}).get("raw", {}).get("psnr", {}).get("mean")
    text = f"Re-renderings reach {psnr:.1f} dB PSNR on the photographs (sensor values)." if psnr is not None else ""
    held_out = means.get("rgb_held_out", {}).get("raw", {}).get("psnr")
    if held_out is not None:
        text += f" On the {held_out['views']} held-out photographs: {held_out['mean']:.1f} dB."
    gains = summary.get("gain_over_raw_predictions", {})
    gain = gains.get("albedo", {}).get("scaled", {}).get("psnr_db")
    if gain is not None:
        raw = means.get("albedo", {}).get("raw", {}).get("psnr", {}).get("mean")
        uncorrected = f"{raw:.1f} dB as it is and " if raw is not None else ""
        plain = summary["means"].get("object_mean", {}).get("albedo", {}).get("scaled", {}).get("psnr", {}).get("mean")
        own = means.get("albedo", {}).get("scaled", {}).get("psnr", {}).get("mean")
        text += f" Against ground truth, albedo reaches {uncorrected}{own:.1f} dB up to scale, {gain:.1f} dB above predictions"
        text += "." if plain is None else f"; one flat colour per object, the mean of its predictions, reaches {plain:.1f} dB."
    if not np.any(recovered.light.emits):
        text += " No lamp was found, so relighting has none to switch off."
    if gain is None and not capture.has_truth:
        text += " There is no ground truth for this scene: materials are judged by re-rendering alone."
    return text.strip()


def _fit_fact(facts: dict[str, Any]) -> str:
    history = facts["history"]
    if facts["converged"]:
        return f"converged in {len(history) - 1} steps"
    last = (history[-2] - history[-1]) / max(abs(history[-1]), 1e-12) if len(history) > 1 else 0.0
    return f"stopped after {len(history) - 1} steps, the last of which lowered the objective by {100 * last:.2g} %"


def _facts(job: Job, capture: CaptureReader, recovered: Recovered) -> list[tuple[str, str]]:
    first = capture.views[0]
    sizes = sorted({(v.width, v.height) for v in capture.views})
    exposures = capture.exposures()
    stops = np.log2(exposures.max() / exposures.min()) if exposures.min() > 0 else 0.0
    held_out = sum(v.split == "test" for v in capture.views)
    extent = np.ptp(recovered.surface.vertices, axis=0)
    prior = job.read("prior").manifest.get("settings", {}).get("prior", {})
    size = f"{first.width} x {first.height}" if len(sizes) == 1 else f"{len(sizes)} sizes, first {first.width} x {first.height}"
    facts = [
        ("quality", job.quality),
        ("source", str(capture.facts.get("source", ""))),
        ("photographs", f"{len(capture.views)} of {size} pixels, {capture.facts['dynamic_range'].upper()}"),
        ("exposures", f"{stops:.1f} stops apart" if stops > 0.01 else "all equal"),
        ("mesh", f"{number(len(recovered.surface.faces))} faces, {' x '.join(f'{v:.2f}' for v in extent)} m"),
        ("objects", _objects_fact(job, len(recovered.object_names))),
        ("material fit", _fit_fact(job.read("affines").json("affines.json"))),
        (
            "surface cells",
            f"{number(len(recovered.surface.cell_ijk))} of {1000 * recovered.surface.cell_edge:.1f} mm,"
            f" {100 * job.read('base').json('base.json')['seen_once_share']:.0f} % in one photograph only",
        ),
        ("prior", _prior_fact(prior)),
    ]
    if held_out:
        facts.insert(3, ("held out", f"{held_out} photographs were not used"))
    return facts


def _prior_fact(prior: dict[str, Any]) -> str:
    """Return kind and number of the predictions; of pooled ones, of each member."""
    own = members(prior) if prior else []
    return ", ".join(f"{one['kind']}, {one['samples']} predictions a photograph" for one in own) or "unknown"


def _objects_fact(job: Job, count: int) -> str:
    """Describe number, source and stability of the objects (docs/guide/segmentation.md)."""
    facts = _document(job, "segmentation", "segmentation.json")
    if not facts:
        return str(count)
    text = f"{count} ({facts['kind']}), {facts['objects_seen']} of them seen"
    if facts["stability"] is None:
        return text
    return f"{text}; stability {facts['stability']:.2f} (adjusted Rand index with {facts['perturbed']}; 1 = unmoved)"


def _scored(summary: dict[str, Any]) -> str:
    """Which views the scores are of."""
    views = summary["views"]
    return "the views" if views["scored"] == views["of"] else f"{views['scored']} of the {views['of']} views, spread evenly"


def _tables(summary: dict[str, Any]) -> list[Table]:
    means = summary["means"]
    any_held_out = "rgb_held_out" in means.get("result", {})
    materials = [("albedo", "raw", m) for m in ("l2", "psnr", "ssim", "flip")]
    materials += [("albedo", "scaled", m) for m in ("l2", "psnr", "ssim")]
    materials += [(q, "raw", m) for q in ("roughness", "metallic") for m in ("l2", "psnr", "ssim")]
    oracle = [(q, "oracle_affine", m) for q in ("albedo", "roughness", "metallic") for m in ("l2", "psnr", "ssim")]
    light = [("rgb", "raw", m) for m in ("l2", "psnr", "ssim", "flip", "log_l2", "light_spread")] + [("rgb", "scaled", "log_l2")]
    light += [("emission", "raw", m) for m in ("l2", "log_l2", "iou")] + [("emission", "scaled", m) for m in ("l2", "log_l2")]
    tables = [
        score_table(
            f"Materials against ground truth, mean over {_scored(summary)}",
            means,
            materials,
            "Linear values. Emitters, pixels without meaningful truth and (albedo) mirrors are left out, by the truth."
            " scaled = one gain per image and channel.",
        ),
        score_table(
            "Without truth",
            means,
            [("rgb_held_out", "raw", m) for m in ("l2", "psnr", "ssim", "flip")]
            + [("albedo", "raw", m) for m in ("shading_left", "shading_slope", "view_spread")],
            ("Held-out photographs: one exposure gain each where it is estimated. " if any_held_out else "")
            + "Shading left: correlation, inside objects, of log albedo with the log of the light that was found; 0 is none.",
        ),
        score_table("Light and re-rendering", means, light, "rgb: sensor values; its log L2: radiance, where known."),
        score_table(
            "With the best affine per image and object (an oracle)",
            means,
            oracle,
            "Every variant may correct each object by the truth; what remains is the error inside objects. Not a result.",
        ),
    ]
    return [table for table in tables if table]


HEADS = (
    ("re-rendering, held-out photographs", "rgb_held_out", "raw", "psnr", "rerendering"),
    ("re-rendering of the photographs", "rgb", "raw", "psnr", "rerendering"),
    ("albedo, as it is", "albedo", "raw", "psnr", "albedo"),
    ("albedo, up to scale", "albedo", "scaled", "psnr", "albedo"),
    ("roughness", "roughness", "raw", "psnr", "roughness"),
    ("metallic", "metallic", "raw", "psnr", "metallic"),
    ("light left in the albedo", "albedo", "raw", "shading_left", ""),
)
"""Scores at the head of the page: label, quantity, protocol, metric, and the limit of the verdict above which it is good."""


def _numbers(summary: dict[str, Any]) -> list[Number]:
    out = []
    for label, *column, limit in HEADS:
        quantity, protocol, metric = column
        entry = summary["means"].get("result", {}).get(quantity, {}).get(protocol, {}).get(metric)
        if entry is not None:
            unit = METRICS[metric].unit
            text = f"{entry['mean']:.{1 if unit else METRICS[metric].decimals}f}{' ' + unit if unit else ''}"
            good = f"good from {LIMITS[limit].amber:g} {unit}" if limit else "0 is none"
            out.append(Number(label, text, explanation_key(*column), good))
    return out


def _explanations(summary: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the explanation of every score that any variant has."""
    found = {
        (quantity, protocol, metric)
        for quantities in summary["means"].values()
        for quantity, protocols in quantities.items()
        for protocol, values in protocols.items()
        for metric in values
    }
    return [explain(*column) for column in sorted(found)]


# --------------------------------------------------------------------------------------------------------------- views


def _scores_of_views(job: Job) -> dict[str, float]:
    """Return the PSNR of the re-rendering of every view that was scored."""
    table = job.read("metrics").table("metrics.parquet")
    rows = np.char.startswith(table["quantity"].astype(str), "rgb") & (table["metric"] == "psnr") & (table["protocol"] == "raw")
    return {str(view): float(value) for view, value in zip(table["view"][rows], table["value"][rows], strict=True)}


def _ranked(capture: CaptureReader, scores: dict[str, float]) -> list[View]:
    """Return the views from worst to best; those without a score come last."""
    return sorted(capture.views, key=lambda view: (scores.get(view.name, np.inf), view.view_id))


def _spread(views: Sequence[View], count: int) -> list[View]:
    """Return up to `count` of the views, evenly spread, the first and the last among them."""
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))]


def _hero_note(view: View, scores: dict[str, float]) -> str:
    score = scores.get(view.name)
    return f"View {view.name}" + (
        f", the median of all by its score ({score:.1f} dB PSNR, sensor values)" if score is not None else ""
    )


def _pairs_note(job: Job, ranked: Sequence[View], summary: dict[str, Any]) -> str:
    shown = min(PAIRS, len(ranked))
    text = "Drag over a picture, or use the arrow keys. The number is the PSNR of sensor values."
    if summary["views"]["scored"] < summary["views"]["of"]:
        text += f" {summary['views']['scored']} of {summary['views']['of']} views were scored (metrics.views)."
    return text + (f" {shown} of {len(ranked)} views, evenly spread from worst to best." if shown < len(ranked) else "")


def _pairs(job: Job, capture: CaptureReader, ranked: Sequence[View], scores: dict[str, float]) -> list[Pair]:
    """Return photograph and re-rendering of all views, small, from worst to best."""
    return [_pair(job, capture, view, scores, PAIR_WIDTH) for view in _spread(ranked, PAIRS)]


def _pair(job: Job, capture: CaptureReader, view: View, scores: dict[str, float], longest: int) -> Pair:
    photograph, rerendering = _photograph(job, capture, view, longest)[1:]
    return Pair(view.name, photograph, rerendering, view.width, view.height, scores.get(view.name), view.split == "test")


def _photograph(job: Job, capture: CaptureReader, view: View, longest: int) -> tuple[np.ndarray, Picture, Picture]:
    """Return the photograph in sensor values (H, W, 3), its picture, and the picture of the re-rendering."""
    photo, _ = capture.photo(view, held_out=True)
    rendered = rgb(job.read("render").exr(f"maps/{view.name}.exr"), "ldr")
    kind, unit = ("srgb", "exposed radiance") if capture.is_hdr else ("sensor", "sensor value")
    show = pic.linear if capture.is_hdr else pic.encoded
    sensor = np.clip(view.exposure * photo, 0, 1) if capture.is_hdr else photo
    pictures = [
        Picture(title, pic.data_uri(show(image), longest=longest), "", kind, 0.0, 1.0, unit)
        for title, image in (("photograph", sensor), ("re-rendering", rendered))
    ]
    return sensor, pictures[0], pictures[1]


def _views(
    job: Job, capture: CaptureReader, recovered: Recovered, ranked: Sequence[View], scores: dict[str, float]
) -> list[ViewRows]:
    chosen = _spread(ranked, job.settings.report.views)
    emission_exposure = _emission_exposure(recovered)
    rows = []
    for done, view in enumerate(chosen):
        rows.append(_view(job, capture, view, emission_exposure, scores))
        job.progress(done + 1, len(chosen), "views drawn")
    return rows


def _emission_exposure(recovered: Recovered) -> float:
    """Return the factor at which emitters of median radiance, by area, appear just below white; brighter ones clip."""
    lit = np.flatnonzero(recovered.light.emits)
    peak, area = recovered.light.radiance[lit].max(-1), recovered.surface.areas[lit]
    order = np.argsort(peak, kind="stable")
    half = np.searchsorted(np.cumsum(area[order]), 0.5 * area.sum())
    return 0.8 / max(float(peak[order][min(half, len(lit) - 1)]), 1e-6) if len(lit) else 1.0


def _view(job: Job, capture: CaptureReader, view: View, emission_exposure: float, scores: dict[str, float]) -> ViewRows:
    file = f"maps/{view.name}.exr"
    _, valid = capture.photo(view, held_out=True)
    depth, face_id = capture.gbuffer(view)
    counted = valid & (face_id >= 0)
    rendered = job.read("render").exr(file)
    sensor, photograph, rerendering = _photograph(job, capture, view, WIDTH)
    result = material_maps(rendered) if "albedo.R" in rendered else None
    strips = [
        Strip(
            "result",
            [
                rerendering,
                *(_materials(result) if result else [None, None, None]),
                _linear("emission", rgb(rendered, "emission"), "radiance", exposure=emission_exposure),
                _false(
                    "re-rendering error",
                    pic.difference(rgb(rendered, "ldr"), sensor, counted),
                    "error",
                    ERROR_RANGE,
                    "sensor value",
                ),
            ],
        )
    ]
    if capture.has_truth:
        strips.append(_truth(capture, view, photograph, result, face_id >= 0, emission_exposure))
    predictions = job.read("prior").exr(file) if job.read("prior").has(file) else {}
    if prediction_numbers(predictions):
        strips.append(_prediction(predictions, None if capture.has_truth else photograph))
    elif not capture.has_truth:
        strips.append(Strip("photograph", [photograph]))
    strips.append(Strip("checks", _checks(job, file, sensor, depth, counted)))
    captions = [f"{view.width} x {view.height}", f"exposure {view.exposure:.3g}"]
    if view.name in scores:
        captions.insert(0, f"{scores[view.name]:.1f} dB")
    if view.split == "test":
        captions.append("held out: not used in the reconstruction")
    return ViewRows(view.name, ", ".join(captions), strips, file)


def _linear(title: str, image: np.ndarray, unit: str, note: str = "", exposure: float = 1.0) -> Picture:
    """Return the picture of linear colours, shown times `exposure`."""
    return Picture(title, pic.data_uri(pic.linear(image, exposure), longest=WIDTH), note, "srgb", 0.0, exposure, unit)


def _grey(title: str, values: np.ndarray) -> Picture:
    return Picture(title, pic.data_uri(pic.grey(values), longest=WIDTH), "", "grey", 0.0, 1.0, title)


def _false(title: str, image: np.ndarray, scheme: str, high: float, unit: str, note: str = "") -> Picture:
    """Return the picture of a scalar in false colours, from 0 to `high`."""
    return Picture(title, pic.data_uri(image, True, WIDTH), note, scheme, 0.0, high, unit)


def _ids(title: str, image: np.ndarray, note: str = "") -> Picture:
    return Picture(title, pic.data_uri(image, True, WIDTH), note)


def _materials(maps: dict[str, np.ndarray]) -> list[Picture | None]:
    return [
        _linear("albedo", maps["albedo"], "albedo, linear"),
        _grey("roughness", maps["roughness"]),
        _grey("metallic", maps["metallic"]),
    ]


def _truth(
    capture: CaptureReader,
    view: View,
    photograph: Picture,
    result: dict[str, np.ndarray] | None,
    hit: np.ndarray,
    emission_exposure: float,
) -> Strip:
    truth = capture.truth(view)
    maps = {"albedo": truth.albedo, "roughness": truth.roughness, "metallic": truth.metallic}
    emission = _linear("emission", truth.emission, "radiance", "same exposure as the result's", emission_exposure)
    error = None
    if result:
        picture = pic.difference(result["albedo"], truth.albedo, truth.valid & hit & ~(truth.emission > 0).any(-1))
        error = _false("albedo error", picture, "error", ERROR_RANGE, "albedo, linear")
    return Strip("truth", [photograph, *_materials(maps), emission, error])


def _prediction(channels: dict[str, np.ndarray], photograph: Picture | None) -> Strip:
    """Show the first prediction, and the spread of the predictions."""
    numbers = prediction_numbers(channels)
    first = _materials(material_maps(channels, f"prior.{numbers[0]:03d}."))
    spread = np.std([rgb(channels, f"prior.{k:03d}.albedo") for k in numbers], axis=0).mean(-1)
    shown = pic.scalar(spread, 0, UNCERTAINTY_RANGE)
    apart = _false("disagreement", shown, "value", UNCERTAINTY_RANGE, "albedo", "standard deviation over the predictions")
    return Strip("raw prediction", [photograph, *first, apart])


def _checks(job: Job, file: str, sensor: np.ndarray, depth: np.ndarray, counted: np.ndarray) -> list[Picture | None]:
    """Show alignment, objects, selected prediction, uncertainty and base texture of a view, as far as they exist."""
    out: list[Picture | None] = []
    if job.read("segmentation").has(file):
        channels = job.read("segmentation").exr(file)
        object_id, segment_id = ids_from_disk(channels["object.id"]), ids_from_disk(channels["segment.id"])
        out.append(_ids("alignment", pic.alignment(sensor, object_id, depth)))
        objects = pic.data_uri(pic.overlay(sensor, object_id), longest=WIDTH)
        out.append(Picture("objects", objects, "one colour for each object, over the photograph"))
        table = read_base(job).table("selection.parquet")
        if len(table["k"]):
            k = pic.selected_prediction(segment_id, table["segment_id"], table["k"], table["weight_albedo"])
            out.append(_ids("selected prediction", pic.ids(k), "one colour for each number k"))
    if job.read("affines").has(file):
        uncertainty = job.read("affines").exr(file)["uncertainty"].astype(np.float32)
        note = "claimed standard error; errors that all predictions share are not in it"
        shown = pic.scalar(uncertainty, 0, UNCERTAINTY_RANGE, mask=counted)
        out.append(_false("uncertainty", shown, "value", UNCERTAINTY_RANGE, "albedo", note))
    if read_base(job).has(file):
        base = read_base(job).exr(file)
        out.append(_linear("base albedo", rgb(base, "albedo"), "albedo, linear", "before the fit"))
        shown = pic.scalar(base["coverage"], 0, COVERAGE_RANGE, mask=counted)
        out.append(_false("coverage", shown, "value", COVERAGE_RANGE, "pixels", "weighted, of the surface cell; 0: filled in"))
    return out


# ------------------------------------------------------------------------------------------------------------ materials


def _objects(job: Job) -> list[dict[str, str]]:
    """Return the rows of the table of materials, from objects.csv of stage export; the surface that most pixels show first."""
    rows = []
    for row in read_csv(job.read("export").path("objects.csv").read_bytes()):
        colour = [float(row[f"base_colour_{c}"]) for c in "rgb"]
        row["linear"] = ", ".join(f"{v:.3f}" for v in colour)
        row["luminance"] = f"{color.luminance(np.array(colour)):.5f}"
        brightest = max("rgb", key=lambda c: float(row[f"base_colour_{c}"]))
        low, middle = row[f"base_colour_{brightest}_low"], float(row[f"base_colour_{brightest}"])
        # The interval of the level is a factor, and the same for all channels; its lower end is never cut off.
        row["level"] = f"(× {float(low) / middle:.2f} to {middle / float(low):.2f})" if low and float(low) > 0 else ""
        for name in ("roughness", "metallic"):
            low, high = row[f"{name}_low"], row[f"{name}_high"]
            row[f"{name}_text"] = f"{float(row[name]):.2f}"
            row[f"{name}_interval"] = f"({float(low):.2f} to {float(high):.2f})" if low and high else ""
        row["model"] = fit_words(row["model"])
        rows.append(row)
    return sorted(rows, key=lambda row: -float(row["pixels"] or 0))


# ----------------------------------------------------------------------------------------------- emitters and response


def _emitters(job: Job, recovered: Recovered) -> list[dict[str, Any]]:
    table = job.read("export").table("emitters.parquet")
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float64)
    error = np.stack([table[f"error_{c}"] for c in "rgb"], 1).astype(np.float64)
    kept = table["kept"].astype(bool)
    sides = np.where(table["side"] == 0, 2.0, 1.0)
    area = table["kind"] == "area"
    power = np.where(kept & area, table["area_m2"] * sides, 0) * radiance.sum(1)
    rows = []
    for i in np.argsort(-power, kind="stable"):
        peak = radiance[i].max()
        swatch = color.to_uint8(color.srgb_from_linear(radiance[i] / peak if peak > 0 else radiance[i]))
        share = percent(power[i] / power.sum(), 1) if area[i] and power.sum() > 0 else "–"
        rows.append(
            {
                "id": int(table["emitter_id"][i]),
                "object": str(table["object"][i]),
                "kind": str(table["kind"][i]),
                "faces": int(table["faces"][i]),
                "area": float(table["area_m2"][i]),
                "radiance": ", ".join(significant(v) for v in radiance[i]),
                "error": ", ".join(significant(v, 2) for v in error[i]),
                "swatch": "#{:02x}{:02x}{:02x}".format(*swatch),
                "share": share,
                "power": f"{power[i]:.6g}",
                "brightness": f"{radiance[i].sum():.6g}",
                "observations": int(table["observations"][i]),
                "kept": bool(kept[i]),
                "reason": str(table["reason"][i]),
            }
        )
    return rows


def _emitter_note(capture: CaptureReader, recovered: Recovered) -> str:
    text = "Radiance in the units of the photographs' exposure."
    if not capture.is_hdr:
        text += " With LDR photographs the factor between light and albedo is `affines.scale`."
    if recovered.light_scale != 1:
        text += f" Light was multiplied by {recovered.light_scale:.3g} for that."
    return text


def _response(job: Job, capture: CaptureReader) -> tuple[str, str]:
    reader = job.read("affines")
    if capture.is_hdr or not reader.has("camera_response.parquet"):
        return "", ""
    x, curves = response_samples(reader.table("camera_response.parquet"))
    if not len(x):
        return "", ""
    drawn = [(x, curve, colour, False) for curve, colour in zip(curves, CHANNEL_COLOURS, strict=True)]
    note = "Sensor value over exposed radiance, red, green and blue, as fitted."
    truth = capture.facts.get("response_truth")
    if truth is not None:
        truth = np.asarray(truth, np.float64)
        grid = np.linspace(0, 1, truth.shape[1])
        drawn += [(grid, curve, colour, True) for curve, colour in zip(truth, CHANNEL_COLOURS, strict=True)]
        fitted = np.stack([np.interp(grid, x, curve) for curve in curves])
        rms = float(np.sqrt(np.mean((fitted - truth) ** 2)))
        note += f" Dashed: what the camera did; difference {rms:.4f} (root mean square, sensor units)."
    return pic.curves_svg(drawn, "Response of the camera: sensor value over exposed radiance, in red, green and blue"), note
