"""Planted emission in a room with known materials (lab/benchmarks/emission_planted.py prints the large table)."""

import numpy as np
import pytest

from iif_core.light.emission.direct import EmissionPrior, solve_emission, solve_families
from tests.unit.planted_room import PlantedScene, averaged, build_room, relative_errors


@pytest.fixture(scope="module")
def planted(llvm):
    scene = PlantedScene(build_room(), views=10, size=48)
    return scene, scene.photographs(0, 128), scene.transport(0, 8)


@pytest.mark.parametrize(("kind", "median"), [("hdr", 0.02), ("ldr", 0.06)])
def test_planted_groups_are_recovered(planted, kind, median):
    scene, photographs, transport = planted
    problem, initial = scene.problem(photographs, transport, kind)
    found = solve_families(problem.rows, EmissionPrior.independent(initial), scene.families())
    assert np.median(relative_errors(scene.room, found.radiance)) < median
    assert found.radiance[~scene.room.truth.any(1)].max() < 1.0  # of up to 20: the distractors
    assert found.converged and np.isfinite(found.error).all()


def test_what_is_never_seen_unsaturated_is_known_by_its_light(planted):
    """So few paths do not separate single triangles, but they determine the light of each object."""
    scene, photographs, _ = planted
    problem, initial = scene.problem(photographs, scene.transport(1, 32), "ldr_one")
    found = solve_families(problem.rows, EmissionPrior.independent(initial), scene.families())
    for family in np.unique(scene.families())[:3]:
        own = scene.families() == family
        assert found.radiance[own].sum() / scene.room.truth[own].sum() == pytest.approx(1, abs=0.15)
    alone = solve_emission(averaged(problem.rows), initial)
    error = [np.median(relative_errors(scene.room, s.radiance)) for s in (found, alone)]
    assert error[0] < error[1]
