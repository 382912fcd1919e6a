"""Figures by which stages say where their arithmetic came close to its end."""

from types import SimpleNamespace

import numpy as np

from iif_core.surface.shading_cells import DiffuseShading
from workflow.decisions import numerics


def _beyond(figures):
    return [item["figure"].split(" /")[0] for item in figures if item["beyond"]]


def test_clipped_texture_and_failed_predictions_are_said():
    value = np.full((100, 5), 0.5, np.float32)
    result = SimpleNamespace(value=value, coverage=np.ones(100), dropped=[])
    assert not _beyond(numerics.of_base(result, 40))
    value[:30, 1] = 1.0
    result.dropped = [None] * 8
    assert _beyond(numerics.of_base(result, 40)) == ["albedo at an end of its range", "predictions left out"]
    assert not _beyond(numerics.of_base(SimpleNamespace(value=value[:0], coverage=np.ones(0), dropped=[]), 0))


def test_light_that_cannot_be_told_apart_or_alternates_is_said():
    assert not _beyond(numerics.of_emission(1e5, True))
    assert _beyond(numerics.of_emission(1e7, False)) == ["condition of the light's normal matrix", "light not at rest"]
    assert _beyond(numerics.of_emission(float("nan"), True)) == ["condition of the light's normal matrix"]


def test_fireflies_and_noise_are_said():
    diffuse = np.ones((2, 200, 3), np.float32)
    quiet = DiffuseShading(diffuse, np.full(200, 16), 0.1, 0.1, 0)
    assert not _beyond(numerics.of_shading(quiet, 0.2))
    diffuse[0, :5] = 100.0
    noisy = DiffuseShading(diffuse, np.full(200, 16), 0.9, 0.6, 3)
    assert _beyond(numerics.of_shading(noisy, 0.2)) == ["fireflies", "noise of the light"]


def test_warnings_name_stage_value_and_limit():
    document = {"numerics": numerics.of_affines({"condition": 1e12, "downweighted": 0.1}, True)}
    (warning,) = numerics.warnings([("affines", document), ("base", {}), ("emission", {"numerics": []})])
    assert warning.startswith("affines: condition of an object's numbers: 1e+12 (up to 1e+10)")
