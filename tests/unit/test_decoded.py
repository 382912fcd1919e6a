"""Files of views, decoded once for all passes over them."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.pixels import ViewMaps
from iif_core.camera.response import response
from iif_core.camera.view import View
from iif_core.surface.triangles import towards_viewer
from workflow.artifacts.store import ids_to_disk
from workflow.priors import correction
from workflow.priors import views as of_priors
from workflow.priors.views import CaptureViews
from workflow.scene.decoded import DecodedViews, Kept
from workflow.segmentations.face_colour import mean_face_colour
from workflow.segmentations.surface import Surface


def _view(number, split="train"):
    return View(number, f"v{number}", 4, 3, 5.0, 5.0, 2.0, 1.5, np.eye(4), split=split)


class Files:
    """A capture and a segmentation that count what is read of them."""

    def __init__(self):
        self.reads, self.objects = Counter(), np.full((3, 4), 7, np.int32)

    def photo(self, view):
        self.reads["photo", view.name] += 1
        return np.full((3, 4, 3), float(view.view_id), np.float32), np.ones((3, 4), bool)

    def gbuffer(self, view):
        self.reads["gbuffer", view.name] += 1
        face = np.zeros((3, 4), np.int32)
        face[0] = -1
        return np.where(face >= 0, 2.0, 0.0).astype(np.float32), face

    def given_instances(self, view):
        return None

    def exr(self, name):
        self.reads["maps", name] += 1
        ids = self.objects
        return {"object.id": ids_to_disk(ids), "segment.id": ids_to_disk(ids + 1), "interior": np.ones((3, 4), np.float32)}


class Room(Files):
    """Photographs of a wall, without objects."""

    is_hdr, facts = False, {}

    def __init__(self):
        super().__init__()
        self.used = [_view(number) for number in range(4)]

    def photo(self, view):
        return np.full((3, 4, 3), 0.1 + 0.2 * super().photo(view)[0], np.float32), np.ones((3, 4), bool)

    def mesh(self):
        vertices = np.array([[-9, -9, 2], [9, -9, 2], [9, 9, 2], [-9, 9, 2]], np.float32)
        return vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32)

    def faces(self):
        return {"instance_id": np.full(2, -1, np.int32)}


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


def test_without_a_segmentation_nothing_is_said_of_objects():
    files = Files()
    maps = DecodedViews(files).maps(_view(1))
    assert maps.object_id is None and maps.segment_id is None and maps.interior is None
    assert maps.camera.view_id == 1 and (maps.value == 1).all() and maps.hit.sum() == 8
    np.testing.assert_array_equal(maps.points()[maps.hit], _view(1).points(maps.depth)[1:].reshape(-1, 3))
    assert maps.points().dtype == np.float32 and maps.points(np.float64).dtype == np.float64


def test_what_needs_no_photograph_reads_none():
    files = Files()
    decoded = DecodedViews(files, files)
    assert not decoded.maps(_view(0), photograph=False).valid.any()
    pixels = decoded.on_objects(_view(0), NORMALS)
    assert not files.reads["photo", "v0"] and pixels.index.tolist() == list(range(4, 12))


def test_pixels_of_no_object_are_left_out():
    files = Files()
    files.objects[1, :3] = -1
    pixels = DecodedViews(files, files).on_objects(_view(0), NORMALS)
    assert pixels.index.tolist() == [7, *range(8, 12)] and (pixels.object_id == 7).all()


def test_a_pixel_hits_the_mesh_where_it_has_face_and_depth():
    face, depth = np.array([[0, -1, 0, -1]]), np.array([[1.0, 1.0, 0.0, 0.0]])
    maps = ViewMaps(camera=_view(0), value=np.zeros((1, 4, 3)), valid=face == 0, depth=depth, face=face)
    assert maps.hit.tolist() == [[True, False, False, False]]


def test_what_was_forgotten_is_made_again_and_its_memory_is_free():
    kept, made = Kept(9e-6), Counter()

    def make(name):
        made[name] += 1
        return np.zeros(1), (np.zeros(0), SimpleNamespace(more=None))

    for name in "abab":  # 8 bytes each: the first alone fits
        kept.once(name, lambda name=name: make(name))
    assert made == {"a": 1, "b": 2}
    kept.forget()
    for name in "baba":
        kept.once(name, lambda name=name: make(name))
    assert made == {"a": 3, "b": 3}


def test_colours_of_faces_and_those_of_perturbed_runs_are_of_one_reading():
    files = Room()
    surface = Surface(files)
    colours = [mean_face_colour(surface, fold)[0][0, 0] for fold in (None, 0, 1, 2)]
    shown = np.array([0.1, 0.3, 0.5, 0.7])
    np.testing.assert_allclose(colours, [shown.mean(), 0.4, shown[[0, 2, 3]].mean(), shown[[0, 1, 3]].mean()], rtol=1e-6)
    assert [len(surface.pixels_of_face), *surface.pixels()] == [3, 32, 0]
    assert set(files.reads.values()) == {1} and len(files.reads) == 8


@pytest.mark.parametrize("factor", [1, 2])
def test_a_prior_of_all_photographs_decodes_each_once(factor):
    files = Room()
    views = CaptureViews(files, objects_given=True, factor=factor)
    views.calibrate()
    for _ in range(2):
        for view in files.used:
            assert views.of(view).hit.any() and views.full(view).valid.sum() == 8
    assert set(files.reads.values()) == {1} and len(files.reads) == 8


def test_photographs_become_linear_by_the_response_that_was_found_unless_they_are_radiance(monkeypatch):
    found = SimpleNamespace(response=response("gamma", [2.0]), exposure=[1.0, 2.0, 3.0, 4.0], rows=1, reason="")
    monkeypatch.setattr(of_priors, "calibrate_response", lambda *_: found)
    files = Room()
    views = CaptureViews(files, objects_given=True)
    views.calibrate()
    for number, view in enumerate(files.used):
        made = views.of(view)
        np.testing.assert_allclose(made.value[1:], (0.1 + 0.2 * number) ** 2, rtol=1e-4)
        assert made.camera.exposure == number + 1
    files.is_hdr = True
    views = CaptureViews(files, objects_given=True)
    views.calibrate()
    assert views.response is None and np.allclose(views.of(files.used[3]).value[1:], 0.7)


def test_predictions_of_small_photographs_are_enlarged_to_the_view(monkeypatch):
    files = Room()
    monkeypatch.setattr(correction, "features", lambda *_: None)
    made = object.__new__(correction.Correction)
    made.views, made.factor, made.samples = CaptureViews(files, objects_given=True, factor=2), 2, 1
    made.gathering, made.recipe = None, {"scale_calibration": (1.0, 1.0, 1.0)}
    made._heads = lambda _: np.broadcast_to([*np.log([0.2, 0.3, 0.4]), 0.6, 0.1, -1.0, -1.0, -1.0], (1, 2, 2, 8))
    found = made(files.used[1])
    assert found.scale.shape == (3, 4, 3)
    np.testing.assert_allclose(found.maps[0, 1:], np.broadcast_to([0.2, 0.3, 0.4, 0.6, 0.1], (2, 4, 5)), rtol=1e-3)


def test_objects_take_their_first_albedo_from_every_third_view(monkeypatch):
    monkeypatch.setattr(correction, "features", lambda gathering, views, number: number)
    made = object.__new__(correction.Correction)
    made.views = CaptureViews(Room(), objects_given=True)
    made.gathering = SimpleNamespace(group=np.array([-1, 0, 1]))
    made._heads = lambda number: np.broadcast_to([*np.log([0.1 + 0.05 * number] * 3), *[0.0] * 5], (1, 3, 4, 8))
    found, shown = made._albedo_of_objects(1), np.isin(made.gathering.group, made.views[0].object_id[1:])
    np.testing.assert_allclose(found[shown], np.log([0.1, 0.25]).mean(), rtol=1e-5)
    assert shown.any() and np.isnan(found[~shown]).all()


def test_normals_face_the_viewer_and_faces_without_area_get_his_direction():
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    towards = np.tile([0.0, 0.6, 0.8], (3, 1))
    turned, front = towards_viewer(normals, towards)
    assert (turned == [[0, 0, 1], [0, 0, 1], [0, 0.6, 0.8]]).all() and front.tolist() == [True, False, True]
