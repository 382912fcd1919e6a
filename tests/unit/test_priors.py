"""Prediction files of other models, and the handling of unusable predictions in stage prior."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.numerics.color import linear_from_srgb
from iif_core.numerics.filling import fill_from_neighbours
from tests.errors import refused
from workflow.artifacts.files import write_exr
from workflow.priors import files, retinex
from workflow.scene.normal_form import View

HEIGHT, WIDTH = 12, 16


def view(name="desk_01", width=WIDTH, height=HEIGHT):
    return View(3, name, width, height, 10.0, 10.0, width / 2, height / 2, np.eye(4))


def settings(folder, samples=2, albedo_space="linear", roughness_is="perceptual", path=None):
    prior = SimpleNamespace(kind="files", samples=samples, path=path, albedo_space=albedo_space, roughness_is=roughness_is)
    return SimpleNamespace(prior=prior, source=SimpleNamespace(path=str(folder)))


def png(path: Path, values: np.ndarray) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def png16(path: Path, values: np.ndarray) -> None:
    import mitsuba as mi

    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(values).write(str(path))


@pytest.fixture
def folder(tmp_path):
    """Two 8-bit predictions of `desk_01` with known values."""
    rng = np.random.default_rng(0)
    for k in range(2):
        png(tmp_path / f"predictions/albedo/desk_01_{k:03d}.png", rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
        png(tmp_path / f"predictions/roughness/desk_01_{k:03d}.png", np.full((HEIGHT, WIDTH), 64 + k, np.uint8))
        png(tmp_path / f"predictions/metallic/desk_01_{k:03d}.png", np.full((HEIGHT, WIDTH, 3), 10, np.uint8))
    return tmp_path


def stored(folder, k=0):
    from PIL import Image

    return np.asarray(Image.open(folder / f"predictions/albedo/desk_01_{k:03d}.png")) / 255


def predict(folder, **kwargs):
    return files.predict(view(), settings(folder, **kwargs), None, 0)


def test_reads_8_bit_linear(folder):
    maps = predict(folder)
    assert maps.shape == (2, HEIGHT, WIDTH, 5) and maps.dtype == np.float32
    np.testing.assert_allclose(maps[1, ..., :3], stored(folder, 1), atol=1e-6)
    np.testing.assert_allclose(maps[1, ..., 3], 65 / 255, atol=1e-6)
    np.testing.assert_allclose(maps[..., 4], 10 / 255, atol=1e-6)


def test_declared_encodings(folder):
    maps = predict(folder, albedo_space="srgb", roughness_is="alpha")
    np.testing.assert_allclose(maps[0, ..., :3], linear_from_srgb(stored(folder)), atol=1e-6)
    np.testing.assert_allclose(maps[0, ..., 3], np.sqrt(64 / 255), atol=1e-6)


def test_reads_16_bit_without_cutting_it(folder):
    values = (np.arange(HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3) * 100 + 1).astype(np.uint16)
    path = folder / "predictions/albedo/desk_01_000.png"
    path.unlink()
    png16(path, values)
    np.testing.assert_allclose(predict(folder)[0, ..., :3], values / 65535, atol=1e-7)


def test_reads_exr_and_keeps_what_is_not_finite(folder):
    (folder / "predictions/roughness/desk_01_001.png").unlink()
    values = np.full((HEIGHT, WIDTH), 0.3, np.float16)
    write_exr(folder / "predictions/roughness/desk_01_001.exr", {"Y": values})
    assert predict(folder)[1, 0, 0, 3] == pytest.approx(0.3, abs=1e-3)
    import OpenEXR

    values[2, 3] = np.nan
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": values}) as file:
        file.write(str(folder / "predictions/roughness/desk_01_001.exr"))
    maps = predict(folder)[1, ..., 3]
    assert np.isnan(maps[2, 3]) and np.isnan(maps).sum() == 1


@pytest.mark.parametrize("factor", [2, 0.5])
def test_other_sizes_are_resized(folder, factor):
    maps = files.predict(view(width=int(WIDTH / factor), height=int(HEIGHT / factor)), settings(folder), None, 0)
    assert maps.shape == (2, int(HEIGHT / factor), int(WIDTH / factor), 5)
    np.testing.assert_allclose(maps[0, ..., :3].mean((0, 1)), stored(folder).mean((0, 1)), atol=0.02)
    np.testing.assert_allclose(maps[0, ..., 3], 64 / 255, atol=1e-6)


def test_bilinear_is_exact_on_planes():
    y, x = np.mgrid[:6, :8] + 0.5
    plane = (2 * x + 3 * y)[..., None]
    found = files.bilinear(plane, 24, 18)
    y, x = (np.mgrid[:18, :24] + 0.5) / 3
    inside = (y > 0.5) & (y < 5.5) & (x > 0.5) & (x < 7.5)
    np.testing.assert_allclose(found[..., 0][inside], (2 * x + 3 * y)[inside], atol=1e-12)
    np.testing.assert_array_equal(files.bilinear(np.ones((1, 1, 2)), 3, 2), 1)


def test_another_shape_is_refused(folder):
    with refused("albedo/desk_01_000.png", "16x12", "20x12"):
        files.predict(view(width=20), settings(folder), None, 0)


def test_what_is_missing_is_named(folder):
    with refused("albedo/desk_01_002", "prior.samples", 3):
        predict(folder, samples=3)
    (folder / "predictions/metallic/desk_01_001.png").unlink()
    with refused("metallic/desk_01_001", 1):
        files.raw_inputs(document(folder))
    with refused(folder / "elsewhere/predictions", "prior.path"):
        predict(folder / "elsewhere")
    with refused("`prior.path`: "):
        files.raw_inputs({"prior": {"path": None, "samples": 1}, "source": {}})


def document(folder, samples=2):
    return {"prior": {"path": None, "samples": samples}, "source": {"path": str(folder)}}


def test_raw_inputs_are_the_files_that_are_read(folder):
    png(folder / "predictions/albedo/notes_about_it.png", np.zeros((2, 2), np.uint8))
    assert len(files.raw_inputs(document(folder))) == 6
    assert len(files.raw_inputs(document(folder, 1))) == 3
    for path in (folder / "predictions").rglob("*.png"):
        path.unlink()
    with refused(folder / "predictions", "albedo/<view>_000.png"):
        files.raw_inputs(document(folder))


def test_two_files_for_one_prediction_are_refused(folder):
    write_exr(folder / "predictions/albedo/desk_01_000.exr", {c: np.zeros((HEIGHT, WIDTH), np.float32) for c in "RGB"})
    with refused("desk_01_000.exr", "desk_01_000.png"):
        predict(folder)


def test_values_of_another_range_are_refused(folder):
    (folder / "predictions/albedo/desk_01_000.png").unlink()
    channels = {c: np.full((HEIGHT, WIDTH), 128, np.float32) for c in "RGB"}
    write_exr(folder / "predictions/albedo/desk_01_000.exr", channels)
    with refused("desk_01_000.exr", 128, "[0, 1]"):
        predict(folder)


def test_damaged_file_is_refused_by_name(folder):
    path = folder / "predictions/albedo/desk_01_000.png"
    path.write_bytes(path.read_bytes()[:60])
    with refused("desk_01_000.png"):
        predict(folder)


def test_view_names_may_look_like_each_other(folder):
    png(folder / "predictions/albedo/desk_01_extra_000.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    np.testing.assert_allclose(predict(folder)[0, ..., :3], stored(folder), atol=1e-6)


# ------------------------------------------------------------------------------------------------- the other two


class Capture:
    """As much of a capture as the priors read: a floor and a wall, two objects."""

    is_hdr = False

    def __init__(self, has_truth=True):
        self.has_truth = has_truth
        self.rows = np.mgrid[:HEIGHT, :WIDTH][0]
        self.used = [view()]

    def points(self, _, depth):
        return np.stack([*np.mgrid[:HEIGHT, :WIDTH], 0 * self.rows], -1).astype(np.float32)

    def photo(self, _):
        return np.where(self.rows[..., None] < 6, 0.8, 0.3) * np.ones(3), np.ones((HEIGHT, WIDTH), bool)

    def gbuffer(self, _):
        return np.ones((HEIGHT, WIDTH)), np.where(self.rows < 6, 0, 1).astype(np.int32)

    facts = {}  # noqa: RUF012

    def given_instances(self, _):
        return None

    def faces(self):
        return {"instance_id": np.array([4, 7], np.int32)}

    def mesh(self):
        vertices = 20 * np.array([[-1, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
        return vertices, np.array([[0, 1, 2], [0, 1, 3]])

    def directions(self, _):
        return np.ones((HEIGHT, WIDTH, 3))

    def truth(self, _):
        shape = (HEIGHT, WIDTH)
        albedo = np.where(self.rows[..., None] < 6, 0.7, 0.3) * np.ones(3)
        zero = np.zeros((*shape, 3))
        return SimpleNamespace(
            albedo=albedo,
            roughness=np.ones(shape),
            metallic=np.zeros(shape),
            emission=zero,
            radiance=albedo,
            valid=np.ones(shape, bool),
        )


def test_retinex_uses_objects_and_gamma():
    chosen = SimpleNamespace(prior=SimpleNamespace(samples=2, mean_albedo=0.3), segmentation=SimpleNamespace(kind="given"))
    maps = retinex.prepare(chosen, Capture(), 0, lambda array: array)(view()).maps
    ratio = maps[0, 2, 2, 0] / maps[0, 9, 2, 0]
    # a step between objects is material; the floor and the wall need not get the same light
    assert ratio == pytest.approx((0.8 / 0.3) ** 2.2, rel=0.1)


def test_the_light_of_retinex_is_as_the_photograph_was_exposed():
    """What the photograph shows is albedo times light times exposure, so the albedo does not follow the exposure."""
    light = SimpleNamespace(around=lambda own: (own.hit,), log_at=lambda hit: np.full((2, hit.sum(), 3), np.log(0.5)))
    albedo = np.where(np.arange(WIDTH)[:, None] < 8, 0.6, 0.2) * np.ones((HEIGHT, WIDTH, 3))
    hit = np.ones((HEIGHT, WIDTH), bool)
    hit[:2] = False
    prior = object.__new__(retinex.Retinex)
    prior.settings, prior.seed, prior.light = SimpleNamespace(samples=2), 0, light
    found = []
    for exposure in (0.5, 1.0, 1.6):
        own = SimpleNamespace(
            value=exposure * 0.5 * albedo, depth=np.ones_like(albedo[..., 0]), hit=hit, valid=hit, saturated=np.zeros_like(hit),
            object_id=(albedo[..., 0] < 0.4).astype(int), normals=np.tile([0.0, 0, 1], (HEIGHT, WIDTH, 1)),
            camera=SimpleNamespace(exposure=exposure),
        )  # fmt: skip
        prior.views = SimpleNamespace(of=lambda _, own=own: own)
        found.append(prior(view()).maps)
    np.testing.assert_allclose(found[0][:, hit, :3], np.broadcast_to(albedo[hit], (2, hit.sum(), 3)), rtol=1e-3)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4)
    np.testing.assert_allclose(found[2], found[1], rtol=1e-4)


def test_pixels_without_a_value_take_their_neighbours():
    maps = np.tile(np.arange(6.0)[:, None, None], (1, 4, 5))
    maps[0, 0, 2] = np.nan
    filled, count = fill_from_neighbours(maps)
    assert count == 1 and np.isfinite(filled).all() and filled[0, 0, 2] in (0.0, 1.0)
    np.testing.assert_array_equal(fill_from_neighbours(np.ones((2, 2, 5)))[0], 1)
