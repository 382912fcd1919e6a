"""Light that the model lacks, from what other photographs show beside their re-renderings."""

import numpy as np
import pytest
from scipy.optimize import nnls

from iif_core.light import unexplained
from iif_core.light.unexplained import UnexplainedLight, nested_blocks
from tests.errors import refused

RNG = np.random.default_rng(0)


def wall(size=64):
    """Cells of a wall of two objects, of 1 cm."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(size), np.arange(size), indexing="ij"))
    ijk = np.stack([i, j, np.zeros_like(i)], 1)
    return ijk, (i >= size // 2).astype(int), ijk * 0.01


EYES = np.stack([np.linspace(-1, 1.5, 8), np.linspace(0.2, 0.6, 8), np.full(8, 1.0)], 1)


def collected(ratio, eyes=EYES, noise=0.0, share=0.7, weight=1.0):
    """Light from photographs that see most of the cells; `ratio(cells, eye)` is what they show."""
    ijk, owner, centre = wall()
    light = UnexplainedLight(nested_blocks(ijk, owner, centre))
    rng = np.random.default_rng(1)
    for eye in eyes:
        cell = np.flatnonzero(rng.random(len(ijk)) < share)
        shown = ratio(cell, eye)[:, None] * [1.0, 0.5, -1.0] + rng.normal(0, noise, (len(cell), 3)) if noise or ratio else None
        light.add(eye, cell, shown, np.full((len(cell), 3), weight))
    return light


def test_blocks_are_nested_within_objects():
    ijk, owner, centre = wall()
    blocks = nested_blocks(ijk, owner, centre)
    assert [len(c) for c in blocks.centre] == [2, 16, 256]
    np.testing.assert_array_equal(blocks.parent[:, blocks.of_cell[-1]], blocks.of_cell)
    for level, edge in enumerate((64, *unexplained.EDGES)):
        same = blocks.of_cell[level] == blocks.of_cell[level][:1]
        expected = (ijk // edge == ijk[0] // edge).all(1) & (owner == owner[0])
        np.testing.assert_array_equal(same, expected)
        np.testing.assert_allclose(blocks.centre[level][blocks.of_cell[level][0]], centre[expected].mean(0))


def test_what_every_photograph_shows_alike_is_found_again():
    """A factor for each object and another for each block of 16 cells; terms of finer blocks and of directions are 0."""
    ijk, owner, _ = wall()
    level = 0.3 * owner - 0.1 + 0.2 * ((ijk[:, 0] // 16 + ijk[:, 1] // 16) % 2)
    light = collected(lambda cell, eye: level[cell])
    strength = light.strength()
    np.testing.assert_allclose(strength.beta[:2], 1, atol=1e-6)
    assert strength.share == pytest.approx(1, abs=1e-6)
    cell = RNG.integers(0, len(ijk), 500)
    expected = np.exp(level[cell, None] * [1.0, 0.5, -1.0])
    np.testing.assert_allclose(light.factor((0.3, 0.3, 2.0), cell, strength.beta), expected, rtol=1e-5)
    np.testing.assert_allclose(light.factor(EYES[2], cell, strength.beta, 2), expected, rtol=1e-5)


def test_what_changes_with_the_direction_is_taken_from_the_nearest():
    light = collected(lambda cell, eye: np.full(len(cell), 0.3 * eye[0]))
    strength = light.strength()
    assert 0.8 < strength.share < 1 and strength.beta[3] > 0.5
    ends = [np.log(light.factor(eye, np.arange(100), strength.beta)[:, 0].mean()) for eye in (EYES[1], EYES[6])]
    np.testing.assert_allclose(ends, 0.3 * EYES[[1, 6], 0], atol=0.05)


def test_noise_is_not_believed():
    strength = collected(lambda cell, eye: np.zeros(len(cell)), noise=0.5).strength()
    assert not strength.beta.any() and abs(strength.share) < 0.05
    light = collected(lambda cell, eye: np.zeros(len(cell)), noise=0.5)
    np.testing.assert_array_equal(light.factor(EYES[0], np.arange(10), strength.beta), 1)


def test_a_photograph_does_not_tell_of_itself():
    """One photograph of eight shows something else; without it, nothing of that is left in what is predicted for it."""

    def ratio(cell, eye):
        return np.full(len(cell), 1.0 if eye is EYES_LIST[3] else 0.1)

    EYES_LIST = list(EYES)
    light = collected(ratio, EYES_LIST)
    one = np.array([1.0, 1, 1, 1, 1])
    np.testing.assert_allclose(np.log(light.factor(EYES[3], np.arange(50), one, 3)[:, 0]), 0.1, atol=1e-5)
    assert np.log(light.factor(EYES[3], np.arange(50), one)[:, 0]).min() > 0.9


def test_a_strength_is_the_least_squares_solution():
    """By the pixels themselves, with the terms of every one written out."""
    ijk, owner, _ = wall()
    texture = RNG.normal(0, 0.2, len(ijk)) + 0.2 * owner
    light = collected(lambda cell, eye: texture[cell] + 0.2 * eye[0], noise=0.1, weight=2.0)
    rows, values = [], []
    rng = np.random.default_rng(1)
    for i, eye in enumerate(EYES):
        cell = np.flatnonzero(rng.random(len(ijk)) < 0.7)
        shown = (texture[cell] + 0.2 * eye[0])[:, None] * [1.0, 0.5, -1.0] + rng.normal(0, 0.1, (len(cell), 3))
        rows.append(light.terms(eye, light.blocks.of_cell[-1][cell], i).reshape(-1, 5))
        values.append(shown.ravel())
    expected = nnls(np.concatenate(rows), np.concatenate(values))[0]
    found = light.strength()
    assert (expected[:4] > 0.5).all() and expected[4] == 0
    np.testing.assert_allclose(found.beta, expected, rtol=1e-6)
    residual = np.concatenate(values) - np.concatenate(rows) @ expected
    assert found.share == pytest.approx(1 - (residual**2).sum() / (np.concatenate(values) ** 2).sum(), rel=0.1)


def test_extremes():
    ijk, owner, centre = wall(4)
    light = UnexplainedLight(nested_blocks(ijk, owner, centre))
    assert light.strength() == (pytest.approx(np.zeros(5)), 0, 0)
    for eye in (*EYES[:3], centre[0], centre[0]):  # two photographs from the surface itself
        light.add(eye, np.array([0, 1, 5]), np.full((3, 3), 50.0), np.ones((3, 3)))
    light.add(EYES[4], np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))  # one that shows nothing
    strength = light.strength()
    factor = light.factor(EYES[5], np.arange(16), strength.beta)
    assert np.isfinite(factor).all() and factor.max() <= np.exp(unexplained.LARGEST) * (1 + 1e-9)
    np.testing.assert_allclose(
        light.factor(EYES[5], np.array([7]), strength.beta)[0], np.exp(unexplained.LARGEST)
    )  # as its object
    with refused("finite"):
        light.add(EYES[0], np.array([0]), np.full((1, 3), np.nan), np.ones((1, 3)))


# ---------------------------------------------------------------------------------------------------- what stage render writes

SIZE = 32
"""Pixels of a picture of the wall; each shows four cells."""


class Files:
    """A base that knows the cells of every picture but one, and a writer."""

    def __init__(self):
        self.written = {}
        self.cells = (np.arange(SIZE)[:, None] * 2 * 64 + np.arange(SIZE) * 2).astype(np.uint32)

    def has(self, name):
        return "unknown" not in name

    def exr(self, name, channels=None, units=""):
        if channels is None:
            return {"cell.id": self.cells}
        self.written[name] = np.stack([channels[c] for c in "RGB"], -1)


@pytest.fixture
def stage(monkeypatch):
    """`Unexplained` of six photographs of a wall that is re-rendered with .2. Its second object shows 1.4 times as much, and a
    lamp and a saturated corner far more."""
    from types import SimpleNamespace

    from iif_core.camera.response import response
    from workflow.scene import unexplained as of_stage

    files, curve = Files(), response("srgb")
    monkeypatch.setattr(of_stage, "read_base", lambda job: files)
    ijk, owner, centre = wall()
    names = ["used"] * 6 + ["test", "unknown"]
    pose = [np.vstack([np.hstack([np.eye(3), eye[:, None]]), [0, 0, 0, 1]]) for eye in EYES]
    views = [
        SimpleNamespace(view_id=i, name=f"{name}{i}", world_from_camera=pose[i], width=SIZE, height=SIZE)
        for i, name in enumerate(names)
    ]
    shown = 0.2 * np.where(owner[files.cells] == 1, 1.4, 1.0)[..., None] * np.ones(3)
    emits = np.zeros((SIZE, SIZE), bool)
    emits[:4, :4], shown[:4, :4], shown[-3:, -3:] = True, 0.9, 5.0
    photo = np.clip(curve(np.clip(0.5 * shown, 0, 1)), 0, 1)

    def photograph(view):
        assert view.name.startswith(("used", "unknown")), "held out"
        return photo, np.ones((SIZE, SIZE), bool)

    capture = SimpleNamespace(photo=photograph, views=views, is_hdr=False)
    scene = SimpleNamespace(surface=SimpleNamespace(cell_ijk=ijk, cell_object=owner), cell_centres=centre)
    found = of_stage.Unexplained(SimpleNamespace(writer=files), capture, scene, curve)
    return SimpleNamespace(found=found, views=views, emits=emits, files=files, owner=owner[files.cells])


def test_stage_render_writes_a_factor_for_every_view(stage):
    flat = np.full((SIZE, SIZE, 3), 0.2)
    for view in stage.views[:6] + stage.views[7:]:
        stage.found.add(view, flat, np.full((SIZE, SIZE, 3), 0.5), stage.emits)
    strength, decision = stage.found.write()
    assert decision["included"] and decision["component"] == "unexplained_light" and strength.share > 0.99
    assert set(stage.files.written) == {f"unexplained/{view.name}.exr" for view in stage.views}
    # The floor of the logarithms makes the factor a little smaller.
    floor = 0.02 * (0.2 + 0.28) / 2
    expected = np.where(stage.owner == 1, (0.28 + floor) / (0.2 + floor), 1.0)[..., None] * np.ones(3)
    for view in stage.views[:7]:  # the held-out one from all others
        np.testing.assert_allclose(stage.files.written[f"unexplained/{view.name}.exr"], expected, rtol=3e-3)
    np.testing.assert_array_equal(stage.files.written["unexplained/unknown7.exr"], 1)


def test_without_unexplained_light_nothing_is_written(stage):
    flat = np.full((SIZE, SIZE, 3), 0.2)
    for view in stage.views[:2]:
        stage.found.add(view, flat, np.full((SIZE, SIZE, 3), 0.5), stage.emits)
    strength, decision = stage.found.write()
    assert not decision["included"] and not strength.beta.any() and not stage.files.written
    stage.found.add(stage.views[2], flat, np.full((SIZE, SIZE, 3), 50.0), stage.emits)  # nothing of it is below saturation
    assert not stage.found.write()[1]["included"]


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_corrected_rerendering_is_scored_as_the_rerendering_is(split):
    """Radiance times factor, through gain and response; only a held-out photograph of unknown exposure gets a gain of its own."""
    from types import SimpleNamespace

    from iif_core.camera.response import response
    from workflow.scoring.rivals import OtherPhotographs

    curve, factor = response("srgb"), np.array([1.5, 1.0, 0.5], np.float32)
    radiance = RNG.uniform(0.1, 0.4, (12, 12, 3)).astype(np.float32)
    photo = curve(1.2 * 0.8 * factor * radiance)
    files = {"unexplained/a.exr": {c: np.full((12, 12), f, np.float16) for c, f in zip("RGB", factor, strict=True)}}
    others = OtherPhotographs.__new__(OtherPhotographs)
    others._job = SimpleNamespace(read=lambda stage: SimpleNamespace(has=files.__contains__, exr=files.__getitem__))
    others._capture, others._curve = SimpleNamespace(facts={"exposure_estimated": True}), curve
    others._gains = SimpleNamespace(gain=np.ones((1, 3)))
    others._factor = lambda view: np.full((12, 12, 3), 0.8)
    view = SimpleNamespace(name="a", split=split)
    found = others.corrected(view, radiance, photo, np.ones((12, 12), bool))
    expected = photo if split == "test" else curve(0.8 * factor * radiance)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert others.corrected(SimpleNamespace(name="b", split=split), radiance, photo, np.ones((12, 12), bool)) is None
