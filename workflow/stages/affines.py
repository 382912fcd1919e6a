"""affines: one affine map for each object and the camera response, fitted to the photographs (Eq. M.1, M.14)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import apply_gauge
from iif_core.fitting.object_levels import shared_light_error
from iif_core.fitting.problem import FitOptions, FitProblem, FitResult
from workflow.fitting.affine_files import write_fit
from workflow.fitting.fit_input import Draw, read_fit
from workflow.fitting.inputs import prediction_errors
from workflow.fitting.interreflection import interreflection
from workflow.runtime.job import Job
from workflow.scene.cached_light import has_lobes
from workflow.settings.options import options_of

Solver = Callable[[FitProblem, Response], FitResult]
"""From the problem and the response of stage emission to the fit, in the gauge of the given light."""


def run(job: Job) -> None:
    """Write objects.parquet, camera_response.parquet (LDR), cells.parquet, maps/<view>.exr and affines.json."""
    fit(job, _direct)


def fit(
    job: Job,
    solver: Callable[[Job, tuple[np.ndarray, np.ndarray] | None], Solver],
    name: str = "direct",
    draw: Draw | None = None,
    merged: bool = False,
) -> None:
    """Fit one affine map for each object and write the artefacts of the stage.

    Args:
        job: the job.
        solver: makes the solver from the settings, and mean and precision of the response; name: of it, for affines.json.
        draw, merged: see `read_fit`.
    """
    inputs = read_fit(job, draw, merged)
    with job.timed("solve"):
        free = solver(job, inputs.prior)(inputs.problem, inputs.start)
    found = apply_gauge(inputs.problem, free, inputs.gauge)
    with job.timed("interreflection"):
        kept = interreflection(job, inputs, free, found)
    write_fit(job, inputs, found, name, kept)


def _direct(job: Job, prior: tuple[np.ndarray, np.ndarray] | None) -> Solver:
    options = options_of(
        FitOptions,
        job.settings.affines,
        response_prior=prior,
        # This prior read the brightness of objects from the same photographs.
        base_tells_levels=job.settings.prior.kind != "retinex",
        lobes=has_lobes(job),
        metals=job.settings.components.metallic != "off",
        prediction_errors=prediction_errors(job),
        light_error=shared_light_error(job.read("emission").json("emission.json").get("misfit")),
        threads=job.threads,
    )
    return lambda problem, start: fit_affines(problem, start, options)
