"""Scored relighting: matching of lamps, gains, exposure, scores of planted pictures, lights as documents."""

from types import SimpleNamespace

import numpy as np
import pytest

from lab.relit import scores as relit_scores
from lab.relit.lamps import lamps_of, match_faces
from lab.relit.measures import RelitTarget, best_gain, exposure_of, relative_error
from lab.relit.new_light import Ball, NewLight
from tests.errors import refused
from workflow.scene.normal_form import View


def quads(*centres: tuple[float, float, float], size: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal squares of two triangles each."""
    corners = 0.5 * size * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    vertices = np.concatenate([corners + centre for centre in centres])
    faces = np.concatenate([4 * i + np.array([(0, 1, 2), (0, 2, 3)]) for i in range(len(centres))])
    return vertices, faces


# Lamp A, lamp B, a shade 0.1 m below A, and a wall far away; two faces each.
MESH = quads((0, 0, 2), (3, 0, 2), (0, 0, 1.9), (10, 10, 0))
OBJECT = np.repeat([5, 7, 1, 2], 2)
TRUE = np.zeros((8, 3))
TRUE[:2], TRUE[2:4] = 1.0, 4.0


def test_lamps_are_the_emitting_objects_the_strongest_first():
    lamps = lamps_of(*MESH, OBJECT, TRUE, [f"thing{i}" for i in range(8)])
    assert [(lamp.lamp, lamp.name, lamp.faces.tolist()) for lamp in lamps] == [(7, "thing7", [2, 3]), (5, "thing5", [0, 1])]
    assert np.allclose(lamps[1].centre, (0, 0, 2)) and np.isclose(lamps[0].area, 0.25) and np.isclose(lamps[0].power, 1.0)


def test_faces_go_to_the_lamp_that_they_belong_to_or_that_is_near():
    lamps = lamps_of(*MESH, OBJECT, TRUE)
    emits = np.array([0, 0, 1, 1, 1, 1, 1, 1], bool)  # lamp A is missed, its shade and the wall are taken for lamps
    assert match_faces(lamps, *MESH, emits).tolist() == [-1, -1, 0, 0, 1, 1, -1, -1]
    assert match_faces(lamps, *MESH, emits, near=0.05).tolist() == [-1, -1, 0, 0, -1, -1, -1, -1]
    assert match_faces([], *MESH, emits).tolist() == [-1] * 8


@pytest.fixture
def picture():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.05, 0.7, (24, 24, 3)).astype(np.float32)
    mask = np.ones((24, 24), bool)
    mask[:3] = False
    return truth, mask


def scored(target: RelitTarget, image: np.ndarray) -> dict[tuple[str, str], float]:
    return {(score.metric, score.protocol): score.value for score in target.scores(image, ("psnr", "ssim"))}


def test_the_source_itself_scores_perfectly(picture):
    truth, mask = picture
    found = scored(RelitTarget(truth, mask, 1.0), truth)
    for protocol in ("raw", "gain", "scaled"):
        assert found["psnr", protocol] == 100 and found["ssim", protocol] == pytest.approx(1)
        assert found["relative", protocol] == pytest.approx(0, abs=1e-6)


def test_a_gain_of_two_is_forgiven_by_the_gain_protocols_alone(picture):
    truth, mask = picture
    found = scored(RelitTarget(truth, mask, 1.0), 2 * truth)
    assert found["psnr", "raw"] < 20 and found["relative", "raw"] == pytest.approx(1, rel=1e-5)
    assert found["psnr", "gain"] == 100 and found["psnr", "scaled"] == 100
    tinted = truth * np.float32([2, 1, 0.5])
    found = scored(RelitTarget(truth, mask, 1.0), tinted)
    assert found["psnr", "gain"] < 25 and found["psnr", "scaled"] == 100


def test_gains_do_not_see_what_is_above_white_or_masked(picture):
    truth, mask = picture
    truth[10, 10] = 50.0  # a lamp, which the other picture shows ten times as bright
    other = 2 * truth
    other[10, 10] *= 10
    other[:3] = 1e6
    assert np.allclose(best_gain(other, truth, mask, 1.0, True), 0.5)
    assert best_gain(np.zeros_like(truth), truth, mask, 1.0, True).tolist() == [1, 1, 1]


def test_the_exposure_is_that_of_the_counted_pixels_of_all_pictures(picture):
    truth, mask = picture
    dark = 0.01 * truth
    dark[:3] = 1e9
    together = np.concatenate([truth[mask].max(-1), dark[mask].max(-1)])
    assert exposure_of([truth, dark], [mask, mask]) == pytest.approx(0.8 / np.quantile(together.astype(float), 0.95))
    with refused("pictures"):
        exposure_of([np.zeros((4, 4, 3))], [np.ones((4, 4), bool)])


def test_a_black_picture_is_wrong_by_all_of_the_light(picture):
    truth, mask = picture
    found = scored(RelitTarget(truth, mask, 1.0), np.zeros_like(truth))
    assert found["relative", "raw"] == found["relative", "scaled"] == 1.0 and found["psnr", "raw"] < 10
    assert relative_error(truth, truth, mask) == 0


def test_a_lamp_that_was_missed_is_black(monkeypatch):
    """Intel Open Image Denoise makes values up to 0.01 of a black picture, which a gain would make visible."""
    rays, generator = 64 * 48, np.random.default_rng(0)
    guides = generator.random((rays, 3), np.float32), np.tile(np.float32([0, 0, 1]), (rays, 1)), None
    monkeypatch.setattr("iif_core.light.transport.render.render", lambda *_: np.zeros((rays, 3), np.float32))
    monkeypatch.setattr("iif_core.light.transport.render.first_hits", lambda *_: guides)
    view = View(0, "a", 64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    wanted = SimpleNamespace(samples=1, max_bounces=1, denoise=True)
    assert not relit_scores._picture(SimpleNamespace(geometry=None, material=None), view, wanted, 0).any()


def test_pictures_that_cannot_be_scored_say_why(picture):
    truth, mask = picture
    broken = truth.copy()
    broken[5, 5] = np.nan
    assert {score.value for score in RelitTarget(truth, mask, 1.0).scores(broken)} == {None}
    with refused("(23, 24, 3)", "(24, 24, 3)"):
        list(RelitTarget(truth, mask, 1.0).scores(truth[:-1]))


def test_a_light_survives_its_document():
    ball = NewLight("sphere0", "sphere", ball=Ball((1.0, 2.0, 3.0), 0.1, (5.0, 4.0, 3.0)))
    moved = NewLight("moved7", "moved", 7, shift=(0.1, 0.0, -0.5))
    sky = NewLight("environment", "environment", environment=(1.0, 1.0, 1.0))
    for light in (ball, moved, sky):
        assert NewLight.of(light.document()) == light and light.quantity == f"relit_{light.kind}"
    vertices, faces, radiance = ball.glowing_mesh()
    assert np.allclose(np.linalg.norm(vertices - (1, 2, 3), axis=1), 0.1, rtol=0.02) and (radiance == (5, 4, 3)).all()
    assert len(faces) == len(radiance) and moved.glowing_mesh() is None


MITSUBA = """<?xml version="1.0"?>
<scene version="3.0.0">
<sensor type="perspective"><float name="fov" value="70"/>
  <transform name="to_world"><lookat origin="1,1,1.5" target="3,2,1.2" up="0,0,1"/></transform>
  <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
<shape type="cube"><boolean name="flip_normals" value="true"/>
  <transform name="to_world"><scale x="2" y="1.5" z="1.25"/><translate x="2" y="1.5" z="1.25"/></transform>
  <bsdf type="diffuse"><rgb name="reflectance" value="0.5,0.5,0.5"/></bsdf></shape>
{lamps}
</scene>"""
LAMP = """<shape type="rectangle"><boolean name="flip_normals" value="true"/>
  <transform name="to_world"><scale value="0.3"/><translate x="{x}" y="1.5" z="2.4"/></transform>
  <bsdf type="diffuse"><rgb name="reflectance" value="0,0,0"/></bsdf>
  <emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter></shape>"""


def test_the_lamps_of_a_mitsuba_scene_add_up_and_move(llvm, tmp_path):
    from iif_core.camera.pinhole import look_at
    from lab.mitsuba_scene import render, scene
    from lab.relit.mitsuba_scene import _Room
    from workflow.scene.normal_form import View

    path = tmp_path / "scene.xml"
    lamps = LAMP.format(x=1, radiance="5,4,3") + LAMP.format(x=3, radiance="1,2,4")
    path.write_text(MITSUBA.format(lamps=lamps))
    pose = look_at(np.array([1, 1, 1.5]), np.array([3, 2, 1.2]), np.array([0, 0, 1.0]))
    view = View(0, "000", 16, 16, 12.0, 12.0, 8.0, 8.0, pose)
    loaded = scene.load(path)
    names = [shape.name for shape in loaded.shapes]
    whole, _, _ = render.render_view(loaded.scene, render.path_integrator(4), view, 256, 1)
    room = _Room(path, names)
    lit = [number for number in range(len(names)) if number in room._lamps]
    assert len(lit) == 2

    def mean(light: NewLight) -> np.ndarray:
        return room.relit(light, view, 256, 4, 2)[0].mean((0, 1))

    first, second = (mean(NewLight(f"lamp{n}", "lamp", n)) for n in lit)
    assert np.allclose(first + second, whole.mean((0, 1)), rtol=0.03)
    assert np.allclose(first / first[0], np.float32([5, 4, 3]) / 5, rtol=0.05)
    lowered = mean(NewLight("moved", "moved", lit[0], shift=(0.5, 0.0, -0.4)))
    assert not np.allclose(lowered, first, rtol=0.05)
    assert np.allclose(mean(NewLight("lamp", "lamp", lit[0])), first, rtol=1e-5)  # it is back in its place
    assert mean(NewLight("environment", "environment", environment=(1.0, 1.0, 1.0))).max() < 1e-4  # the room is closed
    ball = NewLight("sphere", "sphere", ball=Ball((2.0, 1.5, 1.0), 0.2, (2.0, 1.0, 1.0)))
    assert mean(ball)[0] == pytest.approx(2 * mean(ball)[1], rel=1e-3) and mean(ball)[1] > 0.01


def test_sources_without_a_room_are_refused(monkeypatch):
    from lab.relit import sources as relit

    with refused("source.kind: folder", "builtin", "mitsuba"):
        relit.raw_inputs({"source": {"kind": "folder", "path": "x"}})
    assert relit.raw_inputs({"source": {"kind": "builtin"}}) == []
