"""report: one page to judge the result by, and the plan of the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from workflow.decisions import expected, numerics
from workflow.decisions.materials import by_shown_names
from workflow.decisions.record import plan_text
from workflow.decisions.settled import settled_plan
from workflow.exporters.object_table import read_csv
from workflow.report import pictures as pic
from workflow.report import scores, views
from workflow.report.deliverable import published_names
from workflow.report.downloads import commands, downloads
from workflow.report.emitters import emitter_note, emitter_rows
from workflow.report.evidence import NUMERICS, evidence_of
from workflow.report.facts import facts_of
from workflow.report.materials import intervals_note, material_rows
from workflow.report.page import Page, ViewRows, render_page
from workflow.report.reported import Reported
from workflow.report.response import response_drawing
from workflow.report.strips import exposure_of_emission, view_rows
from workflow.report.verdict import judge
from workflow.report.wording import reason_words
from workflow.runtime import forecast
from workflow.runtime.job import Job
from workflow.runtime.timings import read_timings
from workflow.scene.base_scene import read_base
from workflow.scene.named import object_names
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import read_recovered
from workflow.settings import active_plan


def run(job: Job) -> None:
    """Write report.html, verdict.json and plan.yaml."""
    readers = {stage: job.read(stage) for stage in job.stage.reads(job.document)}
    capture, recovered, export = CaptureReader(readers["capture"]), read_recovered(job), readers["export"]
    summary, objects = readers["metrics"].json("summary.json"), read_csv(export.path("objects.csv").read_bytes())
    scene = Reported(readers | {"base": read_base(job)}, capture, recovered, summary, objects)
    cost = forecast.together(expected.STAGES, job.scene, job.quality)
    plan = [expected.with_expectation(item, cost) for item in settled_plan(readers)]
    former = object_names(readers["segmentation"], len(recovered.object_names))
    plan = [by_shown_names(item, dict(zip(former, recovered.object_names, strict=True))) for item in plan]
    job.writer.bytes("plan.yaml", plan_text(job.scene, job.quality, plan).encode())
    verdict = judge(evidence_of(scene))
    job.writer.json("verdict.json", verdict.document())
    psnr = views.psnr_of_views(readers["metrics"].table("metrics.parquet"))
    ranked = views.ranked(capture.views, psnr)
    middle, means = ranked[len(ranked) // 2], summary["means"]
    fitted = not capture.is_hdr and readers["affines"].has("camera_response.parquet")
    response = readers["affines"].table("camera_response.parquet") if fitted else None
    svg, note = ("", "") if response is None else response_drawing(response, capture.facts.get("response_truth"))
    names = published_names(readers)
    overrides = [(item["component"], item["override"]) for item in plan if item.get("override")]
    page = Page(
        scene=job.scene,
        credit=job.settings.report.credit or str(capture.facts.get("credit", "")),
        verdict=verdict,
        hero=views.pair(scene, middle, psnr, views.HERO_WIDTH),
        hero_note=views.hero_note(middle, psnr.get(middle.name)),
        headline=scores.headline(summary, bool(np.any(recovered.light.emits)), capture.has_truth),
        numbers=scores.head_numbers(means),
        explanations=scores.explanations(means),
        facts=facts_of(scene, job.quality),
        notes=[str(note) for note in (*capture.facts.get("notes", []), *scene.document("emission").get("notes", []))],
        warnings=numerics.warnings([(stage, scene.document(stage)) for stage in NUMERICS]),
        plan=[{**item, "reason": reason_words(item["component"], str(item.get("reason", "")))} for item in plan],
        tables=scores.score_tables(summary),
        overview=pic.png_address(found.path("overview.png")) if (found := readers.get("reconstruction")) else "",
        pairs=[views.pair(scene, view, psnr, views.PAIR_WIDTH) for view in views.spread(ranked, views.PAIRS)],
        pairs_note=views.pairs_note(len(ranked), summary["views"]),
        views=_drawn(job, scene, views.spread(ranked, job.settings.report.views), psnr),
        objects=material_rows(objects),
        objects_note=intervals_note(),
        emitters=emitter_rows(export.table("emitters.parquet")),
        emitter_note=emitter_note(capture.is_hdr, recovered.light_scale),
        response_svg=svg,
        response_note=note,
        timings=read_timings(job.scene),
        versions=sorted(export.manifest.get("versions", {}).items()),
        downloads=downloads(names),
        commands=commands(job.scene, job.quality, overrides, names, active_plan(job.scene)),
        scene_file=_scene_file(job.scene),
    )
    data = render_page(page).encode()
    job.writer.bytes("report.html", data)
    job.log.info("report.html: %.1f MB, %d pictures", len(data) / 1e6, data.count(b"data:image/"))


def _drawn(job: Job, scene: Reported, chosen: list[View], psnr: dict[str, float]) -> list[ViewRows]:
    """Return the pictures of the views that are shown in full."""
    exposure, rows = exposure_of_emission(scene.recovered), []
    for done, view in enumerate(chosen, 1):
        rows.append(view_rows(scene, view, exposure, psnr.get(view.name)))
        job.progress(done, len(chosen), "views drawn")
    return rows


def _scene_file(scene: str) -> str:
    """Return where the settings of the scene stand: its own file, or else the batch table."""
    return next((path for path in (f"config/scenes/{scene}.yaml", "config/batch.tsv") if Path(path).is_file()), "")
