"""Which files of the stages are published in scenes/<scene>/, each under its own name."""

from __future__ import annotations

from collections.abc import Mapping

from workflow.artifacts.store import StageReader

WRITTEN_BY_PUBLISH = ("manifest.json", "timings.parquet")
"""Files of the deliverable that stage publish writes itself."""


def deliverables(readers: Mapping[str, StageReader]) -> list[tuple[str, str]]:
    """Return (stage, file) of everything that is copied, as the manifests of export, render and affines list it."""
    chosen = [("export", name) for name in readers["export"].names() if name != "export.json"]
    chosen += [("render", name) for name in readers["render"].names("maps/")]
    chosen += [
        ("report", "report.html"),
        ("room", "room.html"),
        ("room", "scene_unlit.glb"),
        ("report", "verdict.json"),
        ("report", "plan.yaml"),
        ("metrics", "metrics.parquet"),
        ("affines", "objects.parquet"),
    ]
    if readers["affines"].has("camera_response.parquet"):
        chosen.append(("affines", "camera_response.parquet"))
    return chosen


def published_names(readers: Mapping[str, StageReader]) -> list[str]:
    """Return the names of all files of the deliverable, for pages that link to them."""
    return sorted({*(name for _, name in deliverables(readers)), *WRITTEN_BY_PUBLISH})
