"""The mesh of a room as a point sees it."""

import numpy as np
import pytest

from iif_core.light.base_scene import BaseScene
from workflow.scene.base_scene import made_up_objects
from workflow.scene.fitted_maps import without_emitters


def floor():
    """Two triangles of opposite normals in the plane z = 1."""
    vertices = np.float32([[0, 0, 1], [1, 0, 1], [0, 1, 1]])
    none = np.zeros((0, 3), np.int32)
    return BaseScene(
        vertices=vertices, faces=np.int32([[0, 1, 2], [0, 2, 1]]), object_id=np.int32([0, 0]),
        normals=np.float32([[0, 0, 1], [0, 0, -1]]), areas=np.float32([0.5, 0.5]), n_objects=1, cell_edge=0.1,
        cell_origin=np.zeros(3), cell_ijk=none, cell_object=np.zeros(0, np.int32), cell_values=np.zeros((0, 5)),
        object_values=np.zeros((1, 5)),
    )  # fmt: skip


def test_normals_are_on_the_side_of_the_eye():
    scene = floor()
    assert scene.facing([5, 5, 2]).tolist() == [1, -1] and scene.facing([5, 5, 0]).tolist() == [-1, 1]
    assert scene.facing([9, 0, 1]).tolist() == [0, 0]
    seen = scene.seen_normals(np.array([[0, 1, -1]]), np.array([0, 0, 3.0]))
    assert seen.dtype == np.float32 and seen.tolist() == [[[0, 0, 1], [0, 0, 1], [0, 0, 0]]]
    assert scene.seen_normals(np.array([[0]]), np.zeros(3)).tolist() == [[[0, 0, -1]]]


@pytest.mark.parametrize("added, expected", [(0, [0, 0, 0]), (1, [0, 0, 1]), (2, [0, 0, 1]), (3, [0, 1, 1]), (4, [0, 1, 1])])
def test_objects_are_made_up_if_all_their_faces_were_added(added, expected):
    object_id = np.int32([0, 0, 1, -1, 2])
    assert made_up_objects(object_id, 3, added).tolist() == [bool(one) for one in expected]
    assert not made_up_objects(np.int32([0, 1, 0]), 2, 1).any()  # a scan has faces of the object too


def test_emitters_are_black_and_rough_in_the_fitted_maps():
    half = np.full((1, 2), 0.25, np.float16)
    names = ("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic", "uncertainty")
    fitted = dict.fromkeys(names, half) | {"instance.id": np.uint32([[3, 4]])}
    found = without_emitters(fitted, np.array([[True, False]]))
    assert [float(found[name][0, 0]) for name in names] == [0, 0, 0, 1, 0, 0]
    assert all(found[name].dtype == np.float16 and found[name][0, 1] == 0.25 for name in names)
    assert found["instance.id"].tolist() == [[3, 4]]
