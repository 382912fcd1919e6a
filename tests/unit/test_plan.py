import json

import numpy as np
import pytest

from iif_core.requirements.evidence import NOTHING, Evidence
from workflow.decisions import camera, light, materials, objects, plan
from workflow.decisions.record import FORCED, PROVISIONAL, SETTLED

CHOSEN = {
    "candidates": [{"family": "srgb", "behind": 60.0, "error": 20.0}, {"family": "gamma", "behind": 0.0, "error": 0.0}],
    "reason": "gamma it is",
}
KEYS = {"component", "included", "status", "measure", "value", "threshold", "reason"}


@pytest.mark.parametrize(
    ("decision", "included"),
    [
        (plan.environment("auto", 0.0, 0.0005, None), False),
        (plan.environment("auto", 0.0, 0.05, None), True),
        (plan.environment("auto", 0.01, 0.02, 0.6), True),
        (plan.environment("auto", 0.01, 0.004, 0.6), False),  # cracks
        (plan.environment("auto", 0.002, 0.0025, 3.0), True),  # a small window, saturated
        (plan.environment("auto", 0.01, 0.004, None), True),
        (plan.environment("auto", 0.01, 0.05, 0.001), False),
        (plan.environment("on", 0.0, 0.0, None), True),
        (plan.environment("off", 0.5, 0.5, 3.0), False),
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
    said = {share: plan.environment("auto", 0.05, share, None)["reason"] for share in (plan.ESCAPE_OPEN, 1.01 * plan.ESCAPE_OPEN)}
    assert ["ceiling" in reason for reason in said.values()] == [False, True]
    assert plan.environment("auto", np.nan, np.nan, None)["value"] == 0.0


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


IN, OUT, UNCLEAR = Evidence(30.0, 10.0, 500), Evidence(-30.0, 10.0, 500), Evidence(3.0, 10.0, 500)
LEANS = Evidence(-15.0, 10.0, 500)


@pytest.mark.parametrize(
    ("decision", "included", "status"),
    [
        (plan.environment("auto", 0.0, 0.0, 1.0, IN), False, SETTLED),
        (plan.environment("auto", 0.0002, 0.0006, 3.0, Evidence(19.0, 10.0, 500)), False, SETTLED),  # cracks of a closed mesh
        (plan.environment("auto", 0.0002, 0.0006, 3.0, IN), True, SETTLED),
        (plan.environment("auto", 0.0002, 0.0021, 3.0, IN), True, SETTLED),
        (plan.environment("on", 0.0002, 0.0006, 3.0, IN), True, FORCED),
        (plan.environment("auto", 0.1, 0.1, 1.0, IN), True, SETTLED),
        (plan.environment("auto", 0.1, 0.1, 1.0, OUT), False, SETTLED),
        (plan.environment("auto", 0.01, 0.004, 0.6, IN), False, SETTLED),
        (plan.environment("auto", 0.1, 0.1, 1.0, UNCLEAR), True, PROVISIONAL),
        (plan.environment("auto", 0.1, 0.1, 1.0, NOTHING), True, PROVISIONAL),
        (plan.environment("auto", 0.1, 0.1, 0.001, IN), False, SETTLED),
        (plan.environment("auto", 0.0, 0.1, None, IN), True, SETTLED),
        (plan.environment("on", 0.0, 0.0, 1.0, NOTHING), True, FORCED),
        (plan.environment("off", 0.1, 0.1, 1.0, IN), False, FORCED),
        (plan.specular("auto", IN), True, SETTLED),
        (plan.specular("auto", OUT), False, SETTLED),
        (plan.specular("auto", UNCLEAR), True, PROVISIONAL),
        (plan.specular("auto", LEANS), True, PROVISIONAL),
        (plan.specular("off", IN), False, FORCED),
        (plan.emitters(True, NOTHING), True, PROVISIONAL),
        (plan.emitters(False, IN), True, PROVISIONAL),
        (plan.radiance_cache(0.9), True, PROVISIONAL),
        (plan.radiance_cache(0.1), False, PROVISIONAL),
        (light.denoiser(True), True, SETTLED),
        (light.denoiser(False), False, FORCED),
        (light.radiance_cache("path", 0.9, 0.0), False, FORCED),
        (materials.metallic(np.ones(2, bool), np.ones(2), "off"), False, FORCED),
    ],
)
def test_what_is_settled_and_what_is_not(decision, included, status):
    assert (decision["included"], decision["status"]) == (included, status)
    assert json.loads(json.dumps(decision, allow_nan=False)) == decision


def test_linear_photographs_need_no_response_and_given_exposures_no_gains():
    of = {item["component"]: item for item in plan.later(is_hdr=True, exposure_estimated=False)}
    out = {name for name, item in of.items() if not item["included"]}
    assert out == {"camera_response", "exposure", "white_balance", "vignetting"}
    assert all(item["included"] for item in plan.later(is_hdr=False, exposure_estimated=True))


@pytest.mark.parametrize(("lowest", "metal", "included"), [(0.9, False, False), (0.5, False, True), (0.9, True, True)])
def test_predictions_settle_what_the_photographs_left_open(lowest, metal, included):
    settled = plan.matte_by_predictions(plan.specular("auto", UNCLEAR), lowest, metal, 0.85)
    assert (settled["included"], settled["status"], settled["threshold"]) == (included, SETTLED, 0.85)
    assert settled["gain_nats"] == 3.0  # what the photographs said is still there
    for decided in (plan.specular("auto", IN), plan.specular("off", IN)):
        assert plan.matte_by_predictions(decided, lowest, metal, 0.85) == decided


def test_the_plan_says_how_to_turn_it_over():
    assert plan.with_override(plan.specular("auto", OUT))["override"] == "components: {specular: on}"
    assert "override" not in plan.with_override(plan.emitters(False, IN))
    assert plan.included([plan.radiance_cache(0.9)], "radiance_cache")["value"] == 0.9
    with pytest.raises(KeyError):
        plan.included([], "specular")


def test_a_probe_that_finds_nothing_in_enough_rows_leaves_the_part_out():
    assert plan.specular("auto", Evidence(0.0, 0.0, 900))["included"] is False
