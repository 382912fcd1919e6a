"""Maps of other people: which files are taken, what is refused, how colour is decoded; and sheets of pictures."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from iif_core.numerics.color import srgb_from_linear
from iif_core.reflectance.material import CHANNELS
from lab.studies.grid import Line, draw
from tests.errors import refused
from workflow.artifacts.files import write_exr
from workflow.artifacts.store import split_rgb
from workflow.comparison import maps as foreign
from workflow.comparison import pair
from workflow.comparison.named import digest_of_maps
from workflow.comparison.pair import _numbers, _words

VIEWS = ["000", "001"]
VIEW = SimpleNamespace(name="000", width=6, height=4)


def colour(value=0.25, shape=(4, 6)):
    return np.full((*shape, 3), value, np.float32)


@pytest.fixture
def folder(tmp_path):
    """`folder(quantity, name, array)` writes a map as EXR, or as 8-bit PNG if the name says so."""

    def write(quantity, name, array):
        path = tmp_path / quantity / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".png"):
            Image.fromarray(np.rint(255 * array).astype(np.uint8)).save(path)
        elif name.endswith(".exr"):
            channels = split_rgb(array) if array.ndim == 3 else {"Y": array.astype(np.float32)}
            write_exr(path, channels)
        else:
            path.write_text("x")
        return tmp_path

    return write


def test_linear_exr_and_srgb_png_are_the_same_albedo(folder):
    where = folder("albedo", "000.exr", colour())
    linear = foreign.read_map(foreign.find(where, "auto", VIEWS), "albedo", VIEW)
    (where / "albedo/000.exr").unlink()
    folder("albedo", "000.png", srgb_from_linear(colour()))
    decoded = foreign.read_map(foreign.find(where, "auto", VIEWS), "albedo", VIEW)
    assert np.allclose(linear, 0.25) and np.allclose(decoded, 0.25, atol=0.004)
    as_it_is = foreign.read_map(foreign.find(where, "linear", VIEWS), "albedo", VIEW)
    assert np.allclose(as_it_is, srgb_from_linear(0.25), atol=0.004)


def test_roughness_is_never_decoded(folder):
    where = folder("roughness", "000.png", colour(0.5))
    assert np.allclose(foreign.read_map(foreign.find(where, "srgb", VIEWS), "roughness", VIEW), 0.5, atol=0.003)


@pytest.mark.parametrize(
    ("quantity", "name", "array", "words"),
    [
        ("albedo", "00.exr", colour(), ["view 00", "000, 001"]),
        ("albedo", "000.tiff", None, [".tiff", ".exr or .png"]),
        ("albedo", "000.exr", colour(shape=(8, 6)), ["6 x 8", "view 000", "6 x 4"]),
        ("albedo", "000.exr", colour(-0.5), [72, "-0.5", 0]),
        ("emission", "000.png", colour(), ["PNG", "EXR"]),
    ],
)
def test_bad_maps_are_refused_by_name(folder, quantity, name, array, words):
    where = folder(quantity, name, array if array is not None else colour())
    with refused(f"{quantity}/{name}", *words):
        foreign.read_map(foreign.find(where, "auto", VIEWS), quantity, VIEW)


def test_values_that_are_no_numbers_are_refused(folder, tmp_path):
    import OpenEXR

    where = folder("roughness", "000.exr", np.full((4, 6), 0.5))
    broken = np.full((4, 6), np.nan, np.float32)
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"Y": broken}) as file:
        file.write(str(where / "roughness/000.exr"))
    with refused("roughness/000.exr", 24, "NaN"):
        foreign.read_map(foreign.find(where, "auto", VIEWS), "roughness", VIEW)


def test_folders_without_maps_and_unknown_words_are_refused(folder, tmp_path):
    with refused(tmp_path / "nothing", "albedo/<view>.exr"):
        foreign.find(tmp_path / "nothing", "auto", VIEWS)
    with refused(f"{tmp_path}: ", "albedo/<view>.exr"):
        foreign.find(tmp_path, "auto", VIEWS)
    folder("albedo", "000.exr", colour())
    with refused("colour=rec709", "auto, srgb, linear"):
        foreign.find(tmp_path, "rec709", VIEWS)
    folder("albedo", "000.png", colour())
    with refused("albedo/000.png", "000.exr"):
        foreign.find(tmp_path, "auto", VIEWS)


def test_missing_views_and_wrong_colour_are_said(folder):
    found = foreign.find(folder("albedo", "001.exr", colour()), "auto", VIEWS)
    notes = foreign._notes(found, VIEWS, [[12.0, 20.0]])
    assert any("albedo: 1 of 2 views; without 000" in note for note in notes)
    assert any(note.startswith("warning: albedo is 8.0 dB nearer") and "colour=srgb" in note for note in notes)
    assert not any("warning" in note for note in foreign._notes(found, VIEWS, [[20.0, 19.0]]))


def test_the_digest_follows_the_files_and_the_colour(folder):
    where = folder("albedo", "000.exr", colour())
    before = digest_of_maps(where, "auto")
    assert digest_of_maps(where, "auto") == before != digest_of_maps(where, "linear")
    folder("albedo", "000.exr", colour(0.3))
    assert digest_of_maps(where, "auto") != before


def test_lines_of_a_comparison():
    a, b = _words("settings", {"x": "1", "y": "2"}, {"x": "1", "z": "3"}), _numbers("scores", {"p": 1.0, "q": 2.0}, {"p": 1.5})
    assert [(r.name, r.a, r.b, r.same) for r in a] == [("x", "1", "1", True), ("y", "2", "", False), ("z", "", "3", False)]
    first, second = b
    assert first.difference == 0.5 and not first.same and np.isnan(second.difference) and second.b == ""
    assert all(row.same and row.difference == 0 for row in _numbers("scores", {"p": 1.0}, {"p": 1.0}))


def test_a_sheet_has_a_picture_for_each_method_and_keeps_their_places(tmp_path):
    red, blue = np.zeros((10, 20, 3), np.uint8), np.zeros((10, 20, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    lines = [Line("room", "room\nalbedo", {"truth": red, "ours": blue}), Line("room", "room\nmetallic", {"ours": red})]
    figure = draw(lines, ["truth", "ours"], {"truth": "ground truth", "ours": "ours"}, {"room": (0.2, 0.2, 0.3)})
    figure.savefig(tmp_path / "sheet.png", dpi=100)
    image = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB")).astype(int)
    height, width = image.shape[:2]
    pictures = [axes for axes in figure.axes]
    assert len(pictures) == 3
    for axes, tint in zip(pictures, (0, 2, 0), strict=True):
        box = axes.get_position()
        x, y = int(width * (box.x0 + 0.1 * box.width)), int(height * (1 - box.y1 + 0.1 * box.height))
        assert image[y, x].argmax() == tint and image[y, x].max() == 255
    assert {"ground truth", "ours", "room\nalbedo"} <= {text.get_text() for text in figure.texts}


def result_of(names, values, faces="same"):
    """A result with two objects of two cells each, as `compare` reads it."""
    cells = {"object_id": np.array([0, 0, 1, 1])}
    fitted = {channel: np.repeat(values, 2).astype(np.float32) for channel in CHANNELS}
    table = {"object_id": np.array([0, 1]), "name": np.array(names)}
    segmentation = SimpleNamespace(table=lambda name: table, manifest={"files": {"faces.parquet": {"sha256": faces}}})
    return {
        "base": SimpleNamespace(table=lambda name: cells),
        "affines": SimpleNamespace(table=lambda name: fitted),
        "segmentation": segmentation,
    }


def test_the_same_pieces_are_compared_whatever_their_colour_is_called():
    first, second = pair._objects(
        result_of(["white wall", "red top"], [0.5, 0.2]), result_of(["beige wall", "red top"], [0.4, 0.3])
    )
    assert first.keys() == second.keys() and len(first) == 2 * len(CHANNELS)
    assert (first["0 white wall/roughness"], second["0 white wall/roughness"]) == pytest.approx((0.5, 0.4))
    first, second = pair._objects(
        result_of(["white wall", "red top"], [0.5, 0.2]), result_of(["beige wall", "red top"], [0.4, 0.3], "other")
    )
    assert set(first) & set(second) == {f"1 red top/{channel}" for channel in CHANNELS}


def test_photographs_are_paired_by_name_although_their_poses_were_corrected(monkeypatch):
    def capture(*views):
        return {"capture": [SimpleNamespace(name=name, world_from_camera=np.eye(4) + x * np.eye(4, k=3)) for name, x in views]}

    monkeypatch.setattr(pair, "CaptureReader", lambda views: SimpleNamespace(views=views))
    a = capture(("p1", 0.0), ("p2", 1.0), ("p3", 2.0), ("p4", 3.0))
    b = capture(("p1", 0.03), ("q2", 1.0), ("p3", 2.5), ("p4", 2.0))
    assert pair._views(a, b) == [("p1", "p1"), ("p2", "q2"), ("p3", "p4")]
