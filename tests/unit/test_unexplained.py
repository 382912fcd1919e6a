"""What re-renderings lack, from what other photographs show beside theirs."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from iif_core.camera.response import response
from iif_core.light import unexplained
from iif_core.light.unexplained import UnexplainedLight, nested_blocks
from tests.errors import refused

RNG = np.random.default_rng(0)
COLOUR = np.array([1.0, 0.5, -1.0])
EYES = np.stack([np.linspace(-1, 1.5, 8), np.linspace(0.2, 0.6, 8), np.full(8, 1.0)], 1)


def wall(size=64):
    """Cells of a wall of two objects, of 1 cm."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(size), np.arange(size), indexing="ij"))
    ijk = np.stack([i, j, np.zeros_like(i)], 1)
    return ijk, (i >= size // 2).astype(int), ijk * 0.01


def empty(size=64):
    ijk, owner, centre = wall(size)
    return UnexplainedLight(nested_blocks(ijk, owner, centre))


def collected(ratio, eyes=EYES, noise=0.0, share=0.7):
    """Light from photographs that see most of the cells; `ratio(cell, number)` is what they show, in logarithms."""
    light, rng = empty(), np.random.default_rng(1)
    for number, eye in enumerate(eyes):
        cell = np.flatnonzero(rng.random(64 * 64) < share)
        shown = ratio(cell, number)[:, None] * COLOUR + rng.normal(-(noise**2) / 2, noise, (len(cell), 3))
        light.add(eye, cell, np.exp(shown), np.ones((len(cell), 3)), np.ones((len(cell), 3)))
    return light


@pytest.mark.parametrize(("pixels", "small"), [(100, 4), (unexplained.PIXELS, 4), (unexplained.PIXELS + 1, 8), (1e6, 16)])
def test_blocks_are_nested_within_objects_and_grow_with_the_photographs(pixels, small):
    ijk, owner, centre = wall(80)
    blocks = nested_blocks(ijk, owner, centre, pixels)
    np.testing.assert_array_equal(blocks.parent[:, blocks.of_cell[-1]], blocks.of_cell)
    for level, edge in enumerate((1000, 4 * small, small)):
        same = blocks.of_cell[level] == blocks.of_cell[level][-1]
        expected = (ijk // edge == ijk[-1] // edge).all(1) & (owner == owner[-1])
        np.testing.assert_array_equal(same, expected)
        np.testing.assert_allclose(blocks.centre[level][blocks.of_cell[level][-1]], centre[expected].mean(0))


def test_what_every_photograph_shows_alike_is_found_again():
    """A factor for each object and another for each block of 16 cells; terms of finer blocks and of directions are 0."""
    ijk, owner, _ = wall()
    level = 0.3 * owner - 0.1 + 0.2 * ((ijk[:, 0] // 16 + ijk[:, 1] // 16) % 2)
    light = collected(lambda cell, number: level[cell])
    strength = light.strength()
    np.testing.assert_allclose(strength.beta[:2], 1, atol=1e-4)
    assert strength.share == pytest.approx(1, abs=1e-4) and strength.views == 8
    cell = RNG.integers(0, len(ijk), 500)
    expected = np.exp(level[cell, None] * COLOUR)
    np.testing.assert_allclose(light.factor((0.3, 0.3, 2.0), cell, strength.beta), expected, rtol=1e-3)
    np.testing.assert_allclose(light.factor(EYES[2], cell, strength.beta, 2), expected, rtol=1e-3)


def test_what_changes_with_the_direction_is_taken_from_the_nearest():
    light = collected(lambda cell, number: np.full(len(cell), 0.3 * EYES[number, 0]))
    strength = light.strength()
    assert 0.8 < strength.share < 1 and strength.beta[3] > 0.5
    ends = [np.log(light.factor(eye, np.arange(100), strength.beta)[:, 0].mean()) for eye in (EYES[1], EYES[6])]
    np.testing.assert_allclose(ends, 0.3 * EYES[[1, 6], 0], atol=0.06)


def test_the_blend_is_that_of_the_rivals():
    """The angles are those at the middle of a block, otherwise it is Eq. E.22 of `photo_nearest`."""
    light, eye = collected(lambda cell, number: np.full(len(cell), 0.04 * number**2)), np.array([0.1, 0.4, 1.2])
    block = np.arange(len(light.blocks.centre[1]))
    centre = light.blocks.centre[1]
    found, known = light._nearest(1, block, eye - centre, centre, None)
    for row in RNG.integers(0, len(block), 5):
        away = [np.asarray(e) - centre[row] for e in (eye, *EYES)]
        unit = [v / np.linalg.norm(v) for v in away]
        angle = np.array([np.arccos(np.clip(unit[0] @ u, -1, 1)) for u in unit[1:]])
        limit = np.sort(angle)[unexplained.NEAREST]
        weight = np.maximum(1 - angle / limit, 0) / angle
        expected = weight @ (0.04 * np.arange(8) ** 2) / weight.sum()
        assert known[row] and found[row, 0] == pytest.approx(expected, abs=1e-5)


def test_photographs_from_one_place_are_blended_alike():
    light = empty()
    for number in range(7):
        eye, ratio = (EYES[0], 0.1 * number) if number < 6 else (EYES[7], 2.0)
        light.add(eye, np.arange(4096), np.full((4096, 3), np.exp(ratio)), np.ones((4096, 3)), np.ones((4096, 3)))
    centre = light.blocks.centre[1]
    found, _ = light._nearest(1, np.arange(len(centre)), EYES[0] - centre, centre, None)
    assert (np.abs(found - 0.25) < 0.06).all()  # five of the six, and nothing of the seventh


def test_noise_is_not_believed():
    light = collected(lambda cell, number: np.zeros(len(cell)), noise=0.5)
    strength = light.strength()
    assert not strength.beta.any() and abs(strength.share) < 0.05
    np.testing.assert_array_equal(light.factor(EYES[0], np.arange(10), strength.beta), 1)


def test_noise_of_rerenderings_is_not_taken_for_light():
    """A noisy re-rendering of the right mean: the mean of its logarithm is .13 too low."""
    light, rng = empty(), np.random.default_rng(2)
    for eye in EYES:
        noisy = np.exp(rng.normal(0, 0.5, (4096, 3)) - 0.125)
        light.add(eye, np.arange(4096), np.ones((4096, 3)), noisy, np.ones((4096, 3)))
    assert np.abs(np.log(light.factor(EYES[0], np.arange(4096), np.array([1.0, 0, 0, 0, 0])))).max() < 0.02


def test_a_photograph_does_not_tell_of_itself():
    """One photograph of eight shows something else; without it, nothing of that is left in what is predicted for it."""
    light = collected(lambda cell, number: np.full(len(cell), 1.0 if number == 3 else 0.1))
    ones = np.ones(unexplained.TERMS)
    np.testing.assert_allclose(np.log(light.factor(EYES[3], np.arange(50), ones, 3)[:, 0]), 0.1, atol=1e-5)
    assert np.log(light.factor(EYES[3], np.arange(50), ones)[:, 0]).min() > 0.9


def test_a_strength_is_the_least_squares_solution():
    """By the blocks themselves, with the terms of every one written out; each photograph scored by the strength of the others."""
    _, owner, _ = wall()
    texture = RNG.normal(0, 0.2, len(owner)) + 0.2 * owner
    light = collected(lambda cell, number: texture[cell] + 0.2 * EYES[number, 0], noise=0.1)
    rows, values, weights = [], [], []
    for i, view in enumerate(light.views):
        shown = view.levels[-1]
        rows.append(light.terms(EYES[i], shown.block, i).reshape(-1, 5))
        values.append(shown.ratio.astype(float).ravel())
        weights.append(view.weight.astype(float).ravel())

    def solved(chosen):
        root = np.sqrt(np.concatenate([weights[i] for i in chosen]))
        left, right = (np.concatenate([part[i] for i in chosen]) for part in (rows, values))
        return lsq_linear(root[:, None] * left, root * right, (0, 1)).x

    found, every = light.strength(), range(8)
    np.testing.assert_allclose(found.beta, solved(every), atol=1e-3)
    assert (found.beta[:4] > 0.5).all() and found.beta.max() <= 1
    before = np.array([(weights[i] * values[i] ** 2).sum() for i in every])
    after = [(weights[i] * (values[i] - rows[i] @ solved([j for j in every if j != i])) ** 2).sum() for i in every]
    taken = (before - after) / before.mean()
    assert found.share == pytest.approx(taken.mean(), abs=1e-3)
    assert found.error == pytest.approx(taken.std(ddof=1) / np.sqrt(8), abs=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_surface_that_only_two_photographs_show_is_not_extrapolated(seed):
    """Photographs in a chain, each surface shown by two: one is left, whose blend is its mean."""
    light, rng = empty(), np.random.default_rng(seed)
    _, owner, _ = wall()
    for number in range(8):
        cell = np.flatnonzero((np.arange(4096) // 512 == number) | (np.arange(4096) // 512 == (number + 1) % 8))
        shown = np.exp(rng.normal(0.1, 0.3, (len(cell), 3)) + 0.2 * owner[cell, None])
        light.add(EYES[number], cell, shown, np.ones((len(cell), 3)), np.ones((len(cell), 3)))
    strength = light.strength()
    assert strength.beta.min() >= 0 and strength.beta.max() <= 1 and abs(strength.share) < 1
    assert np.abs(np.log(light.factor((0.2, 0.3, 1.5), np.arange(4096), np.ones(5)))).max() < 1


def test_a_small_block_that_no_photograph_shows_is_as_the_one_around_it():
    """In its mean, and in what comes from the nearest directions."""
    light = empty()
    for number, eye in enumerate(EYES):
        cell = np.setdiff1d(np.arange(4096), np.flatnonzero(light.blocks.of_cell[2] == 5))
        ratio = np.exp(np.full((len(cell), 3), 0.1 * number))
        light.add(eye, cell, ratio, np.ones((len(cell), 3)), np.ones((len(cell), 3)))
    hidden = np.flatnonzero(light.blocks.of_cell[2] == 5)[:1]
    near = np.flatnonzero((light.blocks.of_cell[1] == light.blocks.of_cell[1][hidden]) & (light.blocks.of_cell[2] != 5))
    ones = np.ones(unexplained.TERMS)
    factor, around = light.factor(EYES[6], hidden, ones), light.factor(EYES[6], near, ones)
    assert np.log(factor).max() > 0.45 and np.abs(np.log(factor) - np.log(around).mean()).max() < 0.03


def test_extremes():
    light = empty(4)
    assert light.strength().views == 0 and not light.strength().beta.any()
    ones = np.ones((3, 3))
    for eye in (*EYES[:3], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)):  # two photographs from the surface itself
        light.add(eye, np.array([0, 1, 5]), 1e30 * ones, 1e-30 * ones, ones)
    light.add(EYES[4], np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))  # one that shows nothing
    strength = light.strength()
    assert strength.beta.any() and strength.views == 5
    factor = light.factor(EYES[5], np.arange(16), strength.beta)
    assert np.isfinite(factor).all() and factor.max() <= np.exp(unexplained.LARGEST) * (1 + 1e-9)
    np.testing.assert_allclose(factor[7], np.exp(unexplained.LARGEST), rtol=1e-4)  # no photograph shows it: as its object
    np.testing.assert_array_equal(factor[15], 1)  # nor its object
    for shown, rendered, weight in ((np.nan, 1, 1), (1, 0, 1), (1, np.inf, 1), (1, 1, np.nan), (1, 1, -1)):
        with refused("finite"):
            light.add(EYES[0], np.array([0]), *(np.full((1, 3), float(x)) for x in (shown, rendered, weight)))
    few = empty(4)
    for eye in EYES[: unexplained.MIN_VIEWS - 1]:
        few.add(eye, np.array([0, 1, 5]), 2 * ones, ones, ones)
    assert not few.strength().beta.any() and few.strength().views == 0


# ---------------------------------------------------------------------------------------------------- what stage render writes

SIZE = 32
"""Pixels of a picture of the wall; each shows four cells."""
GAIN = np.linspace(0.3, 0.6, SIZE)[:, None, None] * np.array([1.0, 0.9, 0.8])
"""From radiance to the sensor: vignetting and white balance."""


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


def staged(monkeypatch, is_hdr=False, own=0.0):
    """`Unexplained` of seven photographs of a wall that is re-rendered with .2. Its second object shows 1.4 times as much, and
    exp(own) times more in the first photograph. A lamp, a saturated corner and an invalid one show far more."""
    from workflow.scene import unexplained as of_stage

    files, curve = Files(), response("identity" if is_hdr else "srgb")
    monkeypatch.setattr(of_stage, "read_base", lambda job: files)
    ijk, owner, centre = wall()
    names = ["used"] * 6 + ["test", "unknown"]
    views = []
    for i, (name, eye) in enumerate(zip(names, EYES, strict=True)):
        pose = np.vstack([np.hstack([np.eye(3), eye[:, None]]), [0, 0, 0, 1]])
        split = "test" if name == "test" else "train"
        views.append(SimpleNamespace(view_id=i, name=f"{name}{i}", world_from_camera=pose, width=SIZE, height=SIZE, split=split))
    of_pixel = owner[files.cells]
    emits, valid = np.zeros((SIZE, SIZE), bool), np.ones((SIZE, SIZE), bool)
    emits[:4, :4], valid[:4, -4:] = True, False

    def photograph(view):
        assert view.split != "test", "held out"
        shown = 0.2 * np.where(of_pixel == 1, 1.4 * np.exp(own * (view.view_id == 0)), 1.0)[..., None] * np.ones(3)
        shown[:4, :4], shown[:4, -4:] = 0.9, 0.7
        if not is_hdr:
            shown[-3:, -3:] = 50.0
        return (shown if is_hdr else np.clip(curve(np.clip(GAIN * shown, 0, 1)), 0, 1)), valid

    capture = SimpleNamespace(photo=photograph, views=views, is_hdr=is_hdr)
    scene = SimpleNamespace(surface=SimpleNamespace(cell_ijk=ijk, cell_object=owner), cell_centres=centre)
    job = SimpleNamespace(writer=files, progress=lambda done, of, what: None)
    found = of_stage.Unexplained(job, capture, scene, curve)
    return SimpleNamespace(found=found, views=views, emits=emits, files=files, second=(of_pixel == 1) & ~emits, curve=curve)


FLAT = np.full((SIZE, SIZE, 3), 0.2)
FLOOR = 0.02 * (0.2 + 0.28) / 2
"""Of the logarithms, which makes factors a little smaller; without the saturated corner and a lamp it is .1 larger."""


def written(stage, view):
    return stage.files.written[f"unexplained/{view.name}.exr"]


@pytest.mark.parametrize("is_hdr", [False, True])
def test_stage_render_writes_a_factor_for_every_view(monkeypatch, is_hdr):
    stage = staged(monkeypatch, is_hdr)
    for view in stage.views:
        stage.found.add(view, FLAT, np.ones((SIZE, SIZE, 3)) if is_hdr else GAIN, stage.emits)
    strength, decision = stage.found.write()
    assert decision["included"] and decision["component"] == "unexplained_light" and strength.share > 0.99 and strength.views == 6
    assert set(stage.files.written) == {f"unexplained/{view.name}.exr" for view in stage.views}
    expected = np.where(stage.second, (0.28 + FLOOR) / (0.2 + FLOOR), 1.0)[..., None] * np.ones(3)
    for view in stage.views[:7]:  # the held-out one from all others; the lamp keeps its radiance
        np.testing.assert_allclose(written(stage, view), expected, rtol=5e-3)
    np.testing.assert_array_equal(written(stage, stage.views[7]), 1)


def test_the_factor_of_a_photograph_is_that_of_the_others(monkeypatch):
    stage = staged(monkeypatch, own=0.3)
    for view in stage.views:
        stage.found.add(view, FLAT, GAIN, stage.emits)
    stage.found.write()
    own, near, test = (np.log(written(stage, stage.views[i])[stage.second]).mean() for i in (0, 1, 6))
    assert own < np.log(1.4) < near and own < test
    # The photograph that shows more is the nearest of the second one, and far from the held-out one.
    assert near > test + 0.02


def test_pixels_count_by_the_change_of_their_sensor_value(monkeypatch):
    stage, seen = staged(monkeypatch), []
    monkeypatch.setattr(stage.found._light, "add", lambda *arguments: seen.append(arguments))
    radiance = FLAT.copy()
    radiance[10:, :5] = 30.0  # re-rendered at saturation: it says little
    stage.found.add(stage.views[0], radiance, GAIN, stage.emits)
    (eye, cell, shown, rendered, weight), h = seen[0], 1e-5
    np.testing.assert_array_equal(eye, EYES[0])
    use = np.ones((SIZE, SIZE), bool)
    use[:4, :4] = use[:4, -4:] = use[-3:, -3:] = use[10:, :5] = False
    np.testing.assert_array_equal(cell, stage.files.cells[use])
    exposed = (GAIN * np.where(stage.second, 0.28, 0.2)[..., None])[use]
    slope = (stage.curve(exposed * np.exp(h)) - stage.curve(exposed * np.exp(-h))) / (2 * h)
    np.testing.assert_allclose(weight, slope**2, rtol=1e-4)
    least = rendered.min() - 0.2
    assert least == pytest.approx(FLOOR, rel=0.2)
    np.testing.assert_allclose(shown - least, exposed / GAIN.repeat(SIZE, 1)[use], rtol=1e-4)


def test_without_enough_photographs_nothing_is_written(monkeypatch):
    stage = staged(monkeypatch)
    for view in stage.views[:4]:
        stage.found.add(view, FLAT, GAIN, stage.emits)
    stage.found.add(stage.views[4], np.full((SIZE, SIZE, 3), 50.0), GAIN, stage.emits)  # nothing of it is below saturation
    for view in stage.views[6:]:
        stage.found.add(view, FLAT, GAIN, stage.emits)
    strength, decision = stage.found.write()
    assert not decision["included"] and "too few" in decision["reason"] and not strength.beta.any() and not stage.files.written


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_corrected_rerendering_is_scored_as_the_rerendering_is(split):
    """Radiance times factor, through gain and response; only a held-out photograph of unknown exposure gets a gain of its own."""
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
