"""One affine correction per object and the camera response, fitted to the photographs over cached shading (METHOD 2.8, 7b)."""

from iif_core.affines.clusters import patches
from iif_core.affines.direct import fit_affines
from iif_core.affines.gauge import Gauge, pin
from iif_core.affines.levels import interpolate_levels
from iif_core.affines.problem import (
    IDENTITY,
    FitOptions,
    FitProblem,
    FitResult,
    albedo_uncertainty,
    apply_affines,
)
from iif_core.affines.reference_loss import ReferenceLoss, reference_loss, reference_options, reference_problem
from iif_core.affines.sgd import SgdOptions, fit_affines_sgd

__all__ = [
    "IDENTITY",
    "FitOptions",
    "FitProblem",
    "FitResult",
    "Gauge",
    "ReferenceLoss",
    "SgdOptions",
    "albedo_uncertainty",
    "apply_affines",
    "fit_affines",
    "fit_affines_sgd",
    "interpolate_levels",
    "patches",
    "pin",
    "reference_loss",
    "reference_options",
    "reference_problem",
]
