"""Files of views, decoded once for all passes over them."""

from collections import Counter

import numpy as np
import pytest

from iif_core.camera.view import View
from iif_core.surface.triangles import towards_viewer
from workflow.artifacts.store import ids_to_disk
from workflow.scene.decoded import DecodedViews


def _view(number, split="train"):
    return View(number, f"v{number}", 4, 3, 5.0, 5.0, 2.0, 1.5, np.eye(4), split=split)


class Files:
    """A capture and a segmentation that count what is read of them."""

    def __init__(self):
        self.reads = Counter()

    def photo(self, view):
        self.reads["photo", view.name] += 1
        return np.full((3, 4, 3), float(view.view_id), np.float32), np.ones((3, 4), bool)

    def gbuffer(self, view):
        self.reads["gbuffer", view.name] += 1
        face = np.zeros((3, 4), np.int32)
        face[0] = -1
        return np.where(face >= 0, 2.0, 0.0).astype(np.float32), face

    def exr(self, name):
        self.reads["maps", name] += 1
        ids = np.full((3, 4), 7, np.int32)
        return {"object.id": ids_to_disk(ids), "segment.id": ids_to_disk(ids + 1), "interior": np.ones((3, 4), np.float32)}


NORMALS = np.array([[0.0, 0.0, 1.0]])


@pytest.mark.parametrize("memory, reads", [(1.0, 1), (0.0, 3)])
def test_each_file_is_read_once_if_memory_allows(memory, reads):
    files = Files()
    decoded = DecodedViews(files, files, memory)
    views = [_view(0), _view(1)]
    passes = [[decoded.pixels(view, NORMALS) for view in views] for _ in range(3)]
    assert set(files.reads.values()) == {reads} and len(files.reads) == 6
    for again in passes[1:]:
        for one, other in zip(passes[0], again, strict=True):
            for name, values in one.__dict__.items():
                np.testing.assert_array_equal(values, getattr(other, name))
    assert (passes[0][1].value == 1).all() and (passes[0][0].object_id == 7).all() and len(passes[0][0].index) == 8
    assert (decoded.maps(views[0]).segment_id == 8).all()


def test_what_fits_is_kept_and_the_rest_read_again():
    files = Files()
    gbuffer = 3 * 4 * 8 / 1e6
    decoded = DecodedViews(files, files, 1.5 * gbuffer)
    for _ in range(2):
        for number in range(2):
            decoded.gbuffer(_view(number))
    assert files.reads == {("gbuffer", "v0"): 1, ("gbuffer", "v1"): 2}


def test_photographs_that_are_held_out_stay_unread():
    files = Files()
    pixels = DecodedViews(files, files).pixels(_view(0, "test"), NORMALS)
    assert not pixels.valid.any() and not files.reads["photo", "v0"] and len(pixels.index) == 8


def test_normals_face_the_viewer_and_faces_without_area_get_his_direction():
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    towards = np.tile([0.0, 0.6, 0.8], (3, 1))
    turned, front = towards_viewer(normals, towards)
    assert (turned == [[0, 0, 1], [0, 0, 1], [0, 0.6, 0.8]]).all() and front.tolist() == [True, False, True]
