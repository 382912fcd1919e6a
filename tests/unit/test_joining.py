"""Small parts become one mesh in exported files: nothing of them is lost, and lamps stay what they are."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.surface.triangles import face_geometry
from workflow.exporters.atlas import TexturedPart
from workflow.exporters.joining import joined


def square(number, side, emitter=-1, **facts):
    """A square of its own place, texture coordinates and normals, in two faces."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32) * side + np.float32([0, 0, number])
    uv = np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]) * 0.01 + np.float32(number * 0.02)
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    radiance = np.float32([1, 1, 1]) * (emitter >= 0)
    part = TexturedPart(f"thing {number}", number, emitter, corners, normals, uv, faces, radiance, False)
    return replace(part, **facts)


def soup(parts):
    """The triangles of parts with position and texture coordinates of their corners, sorted."""
    rows = [np.concatenate([part.vertices, part.normals, part.uv], 1)[part.faces].reshape(-1, 24) for part in parts]
    every = np.concatenate(rows)
    return every[np.lexsort(every.T)]


@pytest.mark.parametrize("most", [2, 3, 7, 19])
def test_the_least_parts_are_joined_and_no_triangle_changes(most):
    parts = [square(i, 1.0 + (7 * i) % 20) for i in range(20)]
    out = joined(parts, most)
    assert len(out) == most
    np.testing.assert_array_equal(soup(out), soup(parts))
    *kept, small = out
    assert [part.object_id for part in kept] == sorted(part.object_id for part in kept)
    least = min(face_geometry(part.vertices, part.faces)[1].sum() for part in kept)
    assert all(face_geometry(small.vertices, small.faces)[1] <= least / 2)
    assert (small.name, small.object_id, small.emitter_id) == ("small pieces", -1, -1)
    assert small.faces.dtype == np.int32 and small.vertices.dtype == np.float32


def test_few_parts_stay_as_they_are():
    parts = [square(i, 1.0) for i in range(5)]
    assert joined(parts, 5) == parts
    assert joined(parts, 200) == parts


def test_lamps_and_parts_of_other_kinds_stay_apart():
    lamps = [square(i, 0.1, emitter=i) for i in range(4)]
    sheets = [square(i, 0.2, double_sided=True, opacity=0.5) for i in range(4, 8)]
    simple = [square(i, 0.3, simplified=True) for i in range(8, 12)]
    out = joined([*lamps, *sheets, *simple], 3)  # fewer than there are lamps
    assert [part.emitter_id for part in out] == [0, 1, 2, 3, -1, -1]
    assert [(part.double_sided, part.opacity, part.simplified) for part in out[4:]] == [(True, 0.5, False), (False, 1.0, True)]
    assert len({part.name for part in out}) == 6
    np.testing.assert_array_equal(soup(out), soup([*lamps, *sheets, *simple]))


def test_a_thing_that_is_called_small_pieces_keeps_its_name():
    parts = [square(0, 9.0, name="small pieces"), *(square(i, 1.0) for i in range(1, 5))]
    assert [part.name for part in joined(parts, 2)] == ["small pieces", "small pieces 2"]


def test_a_part_alone_of_its_kind_keeps_its_name():
    parts = [square(i, 1.0 + i, double_sided=True, opacity=0.1 + 0.1 * i) for i in range(6)]
    assert joined(parts, 3) == parts
