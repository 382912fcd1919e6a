"""The baselines as stage affines on a room whose light and materials are known: what they leave, and how good it is."""

import numpy as np
import pytest
from light_room import AFFINES, EMISSION, SHADING, build, opened, run

from lab.baselines import stage
from workflow.scene.normal_form import CaptureReader
from workflow.stages import affines, emission, shading

MODELS = ("base", "object_mean", "texture_average", "fipt", "iris")


def _run(folder, dynamic_range, **changes):
    settings = {name: {**own, **changes.get(name, {})} for name, own in (("emission", EMISSION), ("shading", SHADING))}
    stages = {"emission": emission, "shading": shading}
    run(folder, stages, capture={"dynamic_range": dynamic_range}, affines=AFFINES, **settings)


def _fit(folder, dynamic_range, model, **settings):
    own = AFFINES | {"model": model, "solver": "direct", **settings}
    stages = {"affines": affines if model == "objects" else stage}
    run(folder, stages, capture={"dynamic_range": dynamic_range}, emission=EMISSION, affines=own)
    return opened(folder, "affines")


def _psnr(folder, room, names):
    """Of the albedo of some objects, over all views."""
    errors = []
    capture, wanted = CaptureReader(opened(folder, "capture")), [room.names.index(name) for name in names]
    for view in capture:
        _, face = capture.gbuffer(view)
        seen = (face >= 0) & np.isin(room.object_id[face], wanted)
        maps = opened(folder, "affines").exr(f"maps/{view.name}.exr")
        errors.append((np.stack([maps[f"albedo.{c}"] for c in "RGB"], -1)[seen] - room.material[face[seen], :3]) ** 2)
    return -10 * np.log10(np.mean(np.concatenate(errors)))


@pytest.fixture(scope="module")
def ldr(tmp_path_factory, llvm):
    """Folder, room, and what ours leaves: (manifest's files, keys of affines.json)."""
    folder = tmp_path_factory.mktemp("ldr")
    exposures = np.array([1, 0.5, 2, 0.25])
    room = build(folder, views=4, size=40, samples=64, spoil=0.25, dynamic_range="ldr", curve="srgb", exposures=exposures)
    _run(folder, "ldr", emission={"rows": 4000})
    ours = _fit(folder, "ldr", "objects", iterations=2)
    return folder, room, (ours.manifest["files"], set(ours.json("affines.json")))


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS)
def test_every_model_leaves_what_ours_leaves(ldr, model):
    folder, _, (files, keys) = ldr
    expected = {name: (facts["kind"], facts.get("channels"), facts.get("shape")) for name, facts in files.items()}
    reader = _fit(folder, "ldr", model)
    found = {name: (facts["kind"], facts.get("channels"), facts.get("shape")) for name, facts in reader.manifest["files"].items()}
    response = expected.pop("camera_response.parquet"), found.pop("camera_response.parquet")
    assert found == expected and response[0][1] == response[1][1]
    read_by_others = {"light_scale", "history", "converged", "pixels", "residual", "response", "plan", "solver"}
    facts = set(reader.json("affines.json"))
    assert read_by_others - {"solver"} <= facts and read_by_others <= keys
    cells, base = reader.table("cells.parquet"), opened(folder, "base").table("cells.parquet")
    np.testing.assert_array_equal(cells["cell_id"], base["cell_id"])
    values = np.stack([cells[name] for name in ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")], 1)
    assert np.isfinite(values).all() and (values >= 0).all() and (values <= 1).all() and (values[:, 3] >= 0.02).all()
    assert set(reader.table("objects.parquet")["model"]) != {""}


def test_what_is_given_is_left_alone(ldr):
    folder = ldr[0]
    reader, base = _fit(folder, "ldr", "base"), opened(folder, "base")
    np.testing.assert_array_equal(reader.table("cells.parquet")["albedo_g"], base.table("cells.parquet")["albedo_g"])
    mine, theirs = reader.exr("maps/v001.exr"), base.exr("maps/v001.exr")
    for name in ("albedo.R", "roughness", "metallic"):
        np.testing.assert_array_equal(mine[name], theirs[name])
    reader = _fit(folder, "ldr", "object_mean")
    cells, objects = reader.table("cells.parquet"), reader.table("objects.parquet")
    owner = base.table("cells.parquet")["object_id"]
    assert all(np.ptp(cells["albedo_r"][owner == o]) == 0 for o in np.unique(owner))
    # Surface without a cell shows the affine of the object's base mean: the same constant.
    np.testing.assert_allclose(objects["T_albedo"][owner, 3], cells["albedo_r"], rtol=1e-6)
    assert not objects["T_albedo"][:, :3].any()


def test_texture_average_is_the_mean_of_the_photographs(ldr):
    """Counted again, cell by cell: mean radiance (sRGB, exposure divided out) times one gain, matte."""
    folder = ldr[0]
    reader, capture, base = (
        _fit(folder, "ldr", "texture_average"),
        CaptureReader(opened(folder, "capture")),
        opened(folder, "base"),
    )
    emission = opened(folder, "emission")
    exposure, lamps = emission.json("emission.json")["exposure"], emission.table("emitters.parquet")
    shines = emission.table("emitter_faces.parquet")
    lit = shines["face_id"][np.isin(shines["emitter_id"], lamps["emitter_id"][lamps["kept"].astype(bool)])]
    cells = reader.table("cells.parquet")
    sums, count = np.zeros(len(cells["cell_id"])), np.zeros(len(cells["cell_id"]))
    for view, gain in zip(capture.views, exposure, strict=True):
        photo, valid = capture.photo(view)
        cell = base.exr(f"maps/{view.name}.exr")["cell.id"].astype(np.int64)
        face = capture.gbuffer(view)[1]
        use = valid & (cell < len(sums)) & (face >= 0) & ~np.isin(face, lit)
        y = np.clip(photo[use][:, 1].astype(np.float64), 0, 1)
        radiance = np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4) / gain
        np.add.at(sums, cell[use], radiance)
        np.add.at(count, cell[use], 1)
    gain = reader.json("affines.json")["gain"]
    seen = (count > 0) & (gain * sums / np.maximum(count, 1) < 1)
    np.testing.assert_allclose(cells["albedo_g"][seen], (gain * sums / np.maximum(count, 1))[seen], rtol=2e-2, atol=2e-3)
    assert seen.mean() > 0.8 and (cells["metallic"] == 0).all() and np.ptp(cells["roughness"]) == 0


@pytest.mark.long
def test_free_cells_see_what_the_prior_does_not(tmp_path, llvm):
    """Linear photographs: the albedo of walls comes from them alone. A metal they explain as a dark dielectric too, and the
    regulariser prefers that, as published."""
    room = build(tmp_path, views=4, size=40, samples=128, spoil=0.25)
    _run(tmp_path, "hdr", emission={"rows": 4000}, shading={"samples": 96})
    walls, psnr = ["floor", "wall_a", "wall_b", "wall_c", "wall_d"], {}
    for model in ("base", "fipt"):
        _fit(tmp_path, "hdr", model)
        psnr[model] = _psnr(tmp_path, room, walls)
    assert psnr["fipt"] > 20 and psnr["fipt"] > psnr["base"] + 2
    assert _psnr(tmp_path, room, ["metal"]) < 12
    assert not opened(tmp_path, "affines").has("camera_response.parquet")


@pytest.mark.long
def test_both_solvers_and_same_bytes_twice(ldr):
    folder = ldr[0]
    for model in ("fipt", "iris"):
        direct = _fit(folder, "ldr", model)
        files, loss = direct.manifest["files"], direct.json("affines.json")["history"][-1]
        assert _fit(folder, "ldr", model).manifest["files"] == files
        adam = _fit(folder, "ldr", model, solver="adam").json("affines.json")
        assert loss <= 1.01 * adam["history"][-1] and adam["solver"] == "adam"


def test_the_camera_of_iris_comes_closer(ldr):
    folder = ldr[0]
    curve = _fit(folder, "ldr", "iris").table("camera_response.parquet")
    green = (curve["channel"] == "G") & (curve["kind"] == "sample")
    x = curve["x"][green]
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    assert np.sqrt(np.mean((curve["value"][green] - srgb) ** 2)) < 0.05
    assert (np.diff(curve["value"][green]) > 0).all()


@pytest.mark.parametrize(("dynamic_range", "brightness"), [("ldr", 0.0), pytest.param("ldr", 1000.0, marks=pytest.mark.long)])
def test_dark_and_blinding_rooms_run_to_the_end(tmp_path, llvm, dynamic_range, brightness):
    curve = "srgb" if dynamic_range == "ldr" else None
    build(tmp_path, views=2, size=20, samples=8, dynamic_range=dynamic_range, curve=curve, brightness=brightness)
    _run(tmp_path, dynamic_range, emission={"rows": 500, "samples": 2}, shading={"samples": 2, "levels": 3})
    for model in MODELS:
        cells = _fit(tmp_path, dynamic_range, model).table("cells.parquet")  # the reader refuses what is not finite
        assert ((cells["uncertainty"] >= 0) & (cells["uncertainty"] <= 1)).all()
