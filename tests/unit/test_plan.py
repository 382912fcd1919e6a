import json

import numpy as np
import pytest

from iif_core import plan

CHOSEN = {
    "candidates": [{"family": "srgb", "behind": 60.0, "error": 20.0}, {"family": "gamma", "behind": 0.0, "error": 0.0}],
    "reason": "gamma it is",
}
KEYS = {"component", "included", "measure", "value", "threshold", "reason"}


@pytest.mark.parametrize(
    ("decision", "included"),
    [
        (plan.environment("auto", 0.0, 0.0005, None), False),
        (plan.environment("auto", 0.0, 0.05, None), True),
        (plan.environment("auto", 0.01, 0.0, 0.5), True),
        (plan.environment("auto", 0.01, 0.05, 0.001), False),
        (plan.environment("on", 0.0, 0.0, None), True),
        (plan.environment("off", 0.5, 0.5, 3.0), False),
        (plan.radiance_cache("auto", 0.7, 0.01), True),
        (plan.radiance_cache("auto", 0.1, 0.0), False),
        (plan.radiance_cache("path", 0.9, 0.0), False),
        (plan.radiance_cache("cache", 0.0, 1.0), True),
        (plan.emitters(3, 1, 4), True),
        (plan.emitters(0, 0, 0), False),
        (plan.emitters(0, 2, 2), False),
        (plan.camera_response("hdr", {"candidates": [], "reason": "linear"}), False),
        (plan.camera_response("ldr", {"candidates": [], "reason": "too few"}), True),
        (plan.camera_response("ldr", CHOSEN), True),
        (plan.exposure("given", np.array([1.0, -1.0]), 0), False),
        (plan.exposure("estimate", np.array([1.0, -1.0]), 2), True),
        (plan.exposure("estimate", np.array([0.01, -0.01]), 2), False),
        (plan.exposure("estimate", np.zeros(0), 0), False),
        (plan.metallic(np.array([True, False]), np.array([0.1, 0.9])), True),
        (plan.metallic(np.zeros(0, bool), np.zeros(0)), False),
        (plan.specular(np.array([0.9, 0.95]), np.zeros(2, bool)), False),
        (plan.specular(np.array([0.9, 0.4]), np.zeros(2, bool)), True),
        (plan.specular(np.zeros(0), np.zeros(0, bool)), False),
        (plan.specular(np.array([0.9, 0.4]), np.zeros(2, bool), (0.03, 0.04)), True),
        (plan.specular(np.array([0.9, 0.4]), np.zeros(2, bool), (0.04, 0.03)), False),
        (plan.affine_size(["full, roughness", "gain", "identity (3 pixels)"]), True),
        (plan.affine_size([]), False),
        (plan.second_pass(np.array([1.5, 1.0]), np.array([10, 1])), False),
        (plan.second_pass(np.zeros(0), np.zeros(0)), False),
    ],
)
def test_decisions(decision, included):
    assert set(decision) == KEYS and decision["included"] is included
    assert json.loads(json.dumps(decision, allow_nan=False)) == decision


def test_values_say_what_was_measured():
    assert plan.camera_response("ldr", CHOSEN)["value"] == 3.0
    assert plan.camera_response("ldr", CHOSEN)["reason"] == "gamma it is"
    assert plan.second_pass(np.array([1.5, 1.0, 0.7]), np.array([10, 1, 2]))["value"] == 0.5
    assert "1 because it pays" in plan.metallic(np.array([True, False]), np.array([0.1, 0.9]))["reason"]
    assert plan.affine_size(["full", "gain+bias", "full"])["reason"] == "2 full, 1 gain+bias"
    assert plan.environment("auto", np.nan, np.nan, None)["value"] == 0.0


def test_objects_say_how_stable_they_are():
    firm = plan.segmentation("masks", 40, 0.9, "views left out", {"masks": 100, "masks_undersegmented": 7})
    assert firm["included"] and firm["value"] == 0.9 and firm["measure"].endswith("views left out")
    assert "7 of 100 masks" in firm["reason"] and "overlay" not in firm["reason"]
    assert "overlay" in plan.segmentation("geometry", 40, 0.5, "views left out", {})["reason"]
    assert plan.segmentation("given", 40, None, "", {})["measure"] == "ids taken as they are"
