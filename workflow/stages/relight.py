"""relight: renders the recovered scene under other light, edited, and along other camera paths
(docs/method/light.md#relighting)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from iif_core.camera.response import Response, response
from iif_core.errors import InputError
from workflow.artifacts.store import split_rgb
from workflow.relighting import sheet
from workflow.relighting.camera import photograph_exposure
from workflow.relighting.check import blamed_on_plan
from workflow.relighting.display import display_of
from workflow.relighting.frames import Frames
from workflow.relighting.tracing import Studio
from workflow.relighting.video import encoded
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_gains
from workflow.scene.named import new_names
from workflow.scene.recovered import read_response
from workflow.settings import require_relighting

Array = np.ndarray


def run(job: Job) -> None:
    """Write <name>/frame_<i>.exr and .png of every relighting, before_<i>.exr and .png, video.mp4, contact_sheet.png and
    relight.json."""
    wanted = require_relighting({"relight": job.settings.relight}, job.scene)
    studio = Studio.open(job)
    bases = {one["key"]: one for one in job.read("lamp_images").json("lamp_images.json")["bases"]}
    with blamed_on_plan(job.scene):
        wanted = studio.inventory.expanded(wanted)
        _refuse_same_names(wanted)
        checked = [Frames.checked(studio, bases, entry) for entry in wanted]  # whatever is wrong stops the stage before any work
    curve = response("srgb") if studio.capture.is_hdr else read_response(job.read("affines"))
    facts, rows = [], []
    for one in checked:
        made, row = _relight(one, curve)
        facts.append(made)
        rows.append(row)
    job.writer.bytes("contact_sheet.png", sheet.png(sheet.contact_sheet(rows, job.settings.relight_title)))
    job.writer.json("relight.json", {"title": job.settings.relight_title, "relightings": facts, "up": studio.up.tolist()})


def _refuse_same_names(entries: list[dict[str, Any]]) -> None:
    names = [entry["name"] for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise InputError(f"`relight.name`: two relightings would be called {twice!r}, one of them of a single lamp; rename one")
    if not entries:
        raise InputError("`relight.each`: no lamp was found, so there is none to see alone; remove the entry")


def _relight(one: Frames, curve: Response) -> tuple[dict[str, Any], sheet.Row]:
    """Write all frames of a relighting; returns its facts and its row of the contact sheet."""
    job, entry, view = one.studio.job, one.entry, one.flight.view
    name, video, shown = entry["name"], entry["video"], sheet.shown_frames(len(one))
    before = {frame: one.picture_before(frame) for frame in shown}
    taken = photograph_exposure(one.studio.capture, read_gains(job), view)
    display = display_of(entry, curve, taken, view.name, before[shown[0]], lambda: one.picture(0))
    changes, pairs, is_dark = sheet.described(entry, one.studio.inventory, new_names(job)), [], True

    def pictures() -> Iterator[Array]:
        nonlocal is_dark
        for frame in range(len(one)):
            job.progress(frame, len(one), f"frames of {name}")
            radiance = one.picture(frame)
            picture = display(radiance)
            _write(job, f"{name}/frame_{frame:04d}", radiance, picture)
            is_dark &= not picture.any()
            if frame in before:
                was = display(before[frame])
                _write(job, f"{name}/before_{frame:04d}", before[frame], was)
                pairs.append(sheet.Pair(was, picture, f"frame {frame}" if len(one) > 1 else ""))
            yield picture

    if len(one) > 1 and video:
        job.writer.bytes(f"{name}/video.mp4", encoded(pictures(), video["fps"], video["codec"]))
    else:
        for _ in pictures():
            pass
    job.progress(len(one), len(one), f"frames of {name}")
    facts = {
        "name": name,
        "changes": changes,
        "frames": len(one),
        "method": "recombined" if one.basis else "path traced",
        **display.facts(),
        "poses": one.flight.poses.reshape(-1, 16).tolist(),
    }
    if is_dark:
        facts["note"] = "black: no light is on, or none reaches the room"
        job.log.warning("relighting %s is %s", name, facts["note"])
    elif changes != sheet.AS_FOUND and all(np.array_equal(pair.before, pair.after) for pair in pairs):
        facts["note"] = "as before: no lamp or surface that it names makes a difference to this picture"
        job.log.warning("relighting %s is %s", name, facts["note"])
        changes += ", which changes nothing"
    return facts, sheet.Row(f"{name}: {changes} (exposure {display.source})", pairs)


def _write(job: Job, name: str, radiance: Array, picture: Array) -> None:
    if f"{name}.exr" not in job.writer.files:
        job.writer.exr(f"{name}.exr", split_rgb(radiance), "relative")
    job.writer.bytes(f"{name}.png", sheet.png(picture))
