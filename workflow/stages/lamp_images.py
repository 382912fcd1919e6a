"""lamp_images: pictures of every lamp by itself, of which relightings that only switch, dim and colour lamps are sums
(docs/method/light.md#recombination)."""

from __future__ import annotations

from typing import Any

from workflow.models.denoise import require_denoiser
from workflow.relighting.camera import Flight
from workflow.relighting.check import blamed_on_plan
from workflow.relighting.lamp_files import lamp_channels
from workflow.relighting.tracing import Studio, trace_lamps
from workflow.relighting.world import World
from workflow.runtime.job import Job
from workflow.settings.relight import all_files_of, key_of, lamp_basis


def run(job: Job) -> None:
    """Write <key>/frame_<i>.exr, the radiance of every lamp in white light, and lamp_images.json."""
    bases: list[dict[str, Any]] = job.settings.lamp_images
    studio = Studio.open(job) if bases else None
    with blamed_on_plan(job.scene):
        flights = [studio.flight({**basis, "name": _readers(job, basis)}) for basis in bases] if studio else []
    if any(basis["denoise"] for basis in bases):
        require_denoiser()
    facts = [_trace(studio, basis, flight) for basis, flight in zip(bases, flights, strict=True)] if studio else []
    job.writer.json("lamp_images.json", {"bases": facts})


def _readers(job: Job, basis: dict[str, Any]) -> str:
    """Return the names of the relightings that are summed from a basis, for messages."""
    key = key_of(basis)
    found = [entry["name"] for entry in job.document.get("relight", []) if key_of(lamp_basis(entry)) == key]
    return ", ".join(found) or key


def _trace(studio: Studio, basis: dict[str, Any], flight: Flight) -> dict[str, Any]:
    """Trace all frames of a basis, or take them over; returns its entry of lamp_images.json."""
    job, key = studio.job, key_of(basis)
    by = studio.depends_on(basis, all_files_of(basis))
    world: World = studio.world(basis)
    frames = len(flight.poses)
    for frame in range(frames):
        job.progress(frame, frames, f"frames of lamps, {key}")
        part, name = f"{key}.{frame:04d}", f"{key}/frame_{frame:04d}.exr"
        if job.writer.part_kept(part, by) is not None:
            continue
        pictures = trace_lamps(world, flight, frame, basis, studio.seed(basis, frame))
        job.writer.exr(name, lamp_channels(pictures), "relative")
        job.writer.part_done(part, [name], {}, by)
    job.progress(frames, frames, f"frames of lamps, {key}")
    return {
        "key": key,
        "basis": basis,
        "frames": frames,
        "columns": world.columns,
        "level": world.level.tolist(),
        "found": world.found.tolist(),
    }
