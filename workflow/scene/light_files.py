"""The files in which stage emission writes the light that it found, whatever the solver (docs/reference/artefacts.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.light.emission.cache import RadianceVoxels
from workflow.runtime.job import Job


def emitter_columns(
    faces: np.ndarray,
    area: np.ndarray,
    radiance: np.ndarray,
    error: np.ndarray,
    observations: np.ndarray,
    kept: np.ndarray,
    reason: list[str],
    kind: list[str] | None = None,
    side: np.ndarray | None = None,
) -> dict[str, Any]:
    """Return the columns of emitters.parquet for n emitters: `faces`, `area` (m^2), `observations`, `kept`, `reason` and `side`
    (n,), `radiance` and `error` (n, 3); `kind`: None = all are faces."""
    n = len(faces)
    return {
        "emitter_id": np.arange(n, dtype=np.int32),
        "kind": np.array(["area"] * n if kind is None else kind, dtype=str),
        "faces": np.asarray(faces, np.int32),
        "area_m2": np.asarray(area, np.float64),
        "side": np.zeros(n, np.int32) if side is None else np.asarray(side, np.int32),
        **{f"radiance_{c}": radiance[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        **{f"error_{c}": error[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        "observations": np.asarray(observations, np.int64),
        "kept": np.asarray(kept, bool),
        "reason": np.array(reason, dtype=str),
    }


def write_light(
    job: Job,
    table: dict[str, Any],
    face: np.ndarray,
    emitter: np.ndarray,
    side: np.ndarray,
    gain: np.ndarray,
    transmittance: np.ndarray,
    cache: RadianceVoxels,
) -> None:
    """Write emitters.parquet (`table`), emitter_faces.parquet, object_gains.parquet and radiance_cache.parquet.

    face, emitter, side: (n,) faces that belong to emitters, and which side of them shines; gain (O, 3) and transmittance (O,) of
    the objects.
    """
    job.writer.table("emitters.parquet", table, {"area_m2": "m^2", "radiance_r": "relative", "error_r": "relative"})
    columns = {"face_id": face, "emitter_id": emitter, "side": side}
    job.writer.table("emitter_faces.parquet", {name: values.astype(np.int32) for name, values in columns.items()})
    gains = {f"gain_{c}": gain[:, i].astype(np.float32) for i, c in enumerate("rgb")}
    gains["transmittance"] = transmittance.astype(np.float32)
    job.writer.table("object_gains.parquet", {"object_id": np.arange(len(gain), dtype=np.int32), **gains})
    voxels = {name: cache.ijk[:, axis] for axis, name in enumerate("ijk")}
    voxels |= {f"radiance_{c}": cache.radiance[:, i] for i, c in enumerate("rgb")}
    voxels |= {"samples": cache.samples, "censored": cache.censored}
    job.writer.table("radiance_cache.parquet", voxels, {"radiance_r": "relative"})
