import json

import numpy as np
import pytest

from workflow.decisions import camera, light, materials, objects

CHOSEN = {
    "candidates": [{"family": "srgb", "behind": 60.0, "error": 20.0}, {"family": "gamma", "behind": 0.0, "error": 0.0}],
    "reason": "gamma it is",
}
KEYS = {"component", "included", "measure", "value", "threshold", "reason"}


@pytest.mark.parametrize(
    ("decision", "included"),
    [
        (light.environment("auto", 0.0, 0.0005, None), False),
        (light.environment("auto", 0.0, 0.05, None), True),
        (light.environment("auto", 0.01, 0.0, 0.5), True),
        (light.environment("auto", 0.01, 0.05, 0.001), False),
        (light.environment("on", 0.0, 0.0, None), True),
        (light.environment("off", 0.5, 0.5, 3.0), False),
        (light.radiance_cache("auto", 0.7, 0.01), True),
        (light.radiance_cache("auto", 0.1, 0.0), False),
        (light.radiance_cache("path", 0.9, 0.0), False),
        (light.radiance_cache("cache", 0.0, 1.0), True),
        (light.emitters(3, 1, 4), True),
        (light.emitters(0, 0, 0), False),
        (light.emitters(0, 2, 2), False),
        (camera.camera_response("hdr", {"candidates": [], "reason": "linear"}), False),
        (camera.camera_response("ldr", {"candidates": [], "reason": "too few"}), True),
        (camera.camera_response("ldr", CHOSEN), True),
        (camera.exposure("given", np.array([1.0, -1.0]), 0), False),
        (camera.exposure("estimate", np.array([1.0, -1.0]), 2), True),
        (camera.exposure("estimate", np.array([0.01, -0.01]), 2), False),
        (camera.exposure("estimate", np.zeros(0), 0), False),
        (materials.metallic(np.array([True, False]), np.array([0.1, 0.9])), True),
        (materials.metallic(np.zeros(0, bool), np.zeros(0)), False),
        (materials.specular(np.array([0.9, 0.95]), np.zeros(2, bool)), False),
        (materials.specular(np.array([0.9, 0.4]), np.zeros(2, bool)), True),
        (materials.specular(np.zeros(0), np.zeros(0, bool)), False),
        (materials.affine_size(["full, roughness", "gain", "identity (3 pixels)"]), True),
        (materials.affine_size([]), False),
    ],
)
def test_decisions(decision, included):
    assert set(decision) == KEYS and decision["included"] is included
    assert json.loads(json.dumps(decision, allow_nan=False)) == decision


def test_values_say_what_was_measured():
    assert camera.camera_response("ldr", CHOSEN)["value"] == 3.0
    assert camera.camera_response("ldr", CHOSEN)["reason"] == "gamma it is"
    assert "1 because it pays" in materials.metallic(np.array([True, False]), np.array([0.1, 0.9]))["reason"]
    assert materials.affine_size(["full", "gain+bias", "full"])["reason"] == "2 full, 1 gain+bias"
    assert light.environment("auto", np.nan, np.nan, None)["value"] == 0.0


def test_objects_say_how_stable_they_are():
    firm = objects.segmentation("masks", 40, 0.9, "views left out", {"masks": 100, "masks_undersegmented": 7})
    assert firm["included"] and firm["value"] == 0.9 and firm["measure"].endswith("views left out")
    assert "7 of 100 masks" in firm["reason"] and "overlay" not in firm["reason"]
    assert "overlay" in objects.segmentation("geometry", 40, 0.5, "views left out", {})["reason"]
    assert objects.segmentation("given", 40, None, "", {})["measure"] == "ids taken as they are"


def test_light_passes_unless_it_explains_the_room_worse():
    for shines, passes, possible, expected in (
        (0.070, 0.044, True, True),
        (0.074, 0.0745, True, True),
        (0.070, 0.080, True, False),
        (0.070, 0.044, False, False),
        (float("inf"), float("inf"), True, False),
        (0.0, 0.0, True, False),
    ):
        found = light.transmission("curtain", shines, passes, possible)
        assert found["included"] == expected
        assert ("no light passes" in found["reason"]) != expected and "curtain" in found["reason"]
        assert np.isfinite(found["value"])
