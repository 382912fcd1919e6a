"""Every row of bad_input.md, provoked: the message (or the recorded note) is the one that the page shows."""

import functools
import json
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from iif_core.errors import InputError
from tests.errors import named
from tests.unit import own_scene as own
from tests.unit import scannetpp_scene as mini
from tests.unit import test_colmap, test_fipt
from workflow import settings
from workflow.relighting import video
from workflow.relighting.inserts import light_of, load_insert
from workflow.relighting.inventory import Inventory, Lamp, check_places
from workflow.runtime import fingerprint
from workflow.settings import relight_plans
from workflow.settings.relight import Relighting
from workflow.sources.folder_scene import transforms

PAGE = Path(__file__).with_name("bad_input.md")
PENDING = {"no emitter seen", "way of the camera through a wall", "browser without WebGL"}
"""Rows whose stage tests them elsewhere."""


def rows():
    """Case -> text of the page, over all its tables."""
    out = {}
    for line in PAGE.read_text().splitlines():
        match = re.fullmatch(r"\| (.+?) \| (?:(`{1,2}) ?(.+?) ?\2|(none: .+)) \|", line)
        if match:
            assert match[1] not in out, f"two rows for {match[1]}"
            out[match[1]] = match[3] or match[4]
    return out


ROWS = rows()
CASES = {}


def case(name):
    """Register how a row is provoked: a function of the project's root that returns the text the user gets."""

    def register(function):
        CASES[name] = function
        return function

    return register


def data_of(text):
    """The files, keys, values and commands in the text of a row, without its English: what stands in backticks, and every word
    with a digit or a sign inside. `…` is anything, and what touches it is part of a word."""
    text = re.sub(r"[\w.%]+…|…[\w.%]+", "…", text)
    quoted = [part for name in re.findall(r"`([^`…]+)`", text) for part in [name.strip()] if part]
    words = [word.strip("`'\"(),.:;!?") for word in re.split(r"[\s…]+", re.sub(r"`[^`]*`", " ", text))]
    return quoted + [word for word in words if re.search(r"\d|\w[./_=:-]\w*[./_=:]?\w|^/", word)]


def test_the_page_and_the_cases_are_the_same():
    assert set(ROWS) - PENDING == set(CASES)


def error(action):
    with pytest.raises(InputError) as caught:
        action()
    return str(caught.value)


def planned(root, **kwargs):
    """The message while Snakemake plans: fingerprint of the capture, which checks the input files."""
    own.project(root, **kwargs)
    with own.working_in(root):
        return error(lambda: fingerprint.fingerprint("capture", "own", "draft"))


def changed(root, **keys):
    """A bare scene whose transforms.json has other top-level keys (None removes one)."""
    path = root / "data/own"
    document = own.bare(path) | keys
    own.write_transforms(path, {k: v for k, v in document.items() if v is not None})
    return planned(root)


def second_pose(root, change):
    path = root / "data/own"
    document = own.bare(path)
    pose = np.array(document["frames"][1]["transform_matrix"])
    document["frames"][1]["transform_matrix"] = change(pose).tolist()
    own.write_transforms(path, document)
    return planned(root)


def captured(root, **kwargs):
    """The message of the capture job."""
    own.project(root, **kwargs)
    return error(lambda: own.run(root, "capture"))


def noted(root, word, **kwargs):
    """The note with this word that the capture records."""
    own.project(root, **kwargs)
    notes = own.run(root, "capture").facts["notes"]
    return next(note for note in notes if word in note)


# ---------------------------------------------------------------------------------------------------------------
# settings


def loaded(root, text, scene="own"):
    (root / "config/scenes").mkdir(parents=True)
    (root / "config/scenes/kitchen.yaml").write_text("source: {kind: builtin}\nprior: {kind: simulated}\n")
    (root / "config/scenes/own.yaml").write_text("source: {kind: builtin}\nprior: {kind: simulated}\n" + text)
    with own.working_in(root):
        return error(lambda: settings.load(scene))


case("unknown scene")(lambda root: loaded(root, "", "kichen"))
case("misspelt key")(lambda root: loaded(root, "capture: {veiws: 3}\n"))
case("empty view list: `capture.views: 0`")(lambda root: loaded(root, "capture: {views: 0}\n"))


case("a word in the place of a section")(lambda root: loaded(root, "affines: {scale: {white_patch: paper}}\n"))
case("a key of `source` outside of it")(lambda root: loaded(root, "unit: mm\n"))
case("a tab in a scene file")(lambda root: loaded(root, "capture:\n\tviews: 3\n"))
case("a line that is indented by one too many")(lambda root: loaded(root, "capture:\n  views: 3\n   width: 64\n"))


@case("a room of 27 m")
def _(root):
    (root / "config/scenes").mkdir(parents=True)
    (root / "config/scenes/own.yaml").write_text("source: {kind: photographs, path: data/own, room_height: 27.4}\n")
    with own.working_in(root):
        return error(lambda: settings.load("own"))


@case("K = 0: `prior.samples: 0`")
def _(root):
    (root / "config/scenes").mkdir(parents=True)
    text = "source: {kind: builtin}\nprior: {kind: simulated, samples: 0}\n"
    (root / "config/scenes/own.yaml").write_text(text)
    with own.working_in(root):
        return error(lambda: settings.load("own"))


# ------------------------------------------------------------------------------------------------------------------
# files


case("folder absent")(lambda root: planned(root, source={"path": "data/nowhere"}))


@case("transforms.json absent")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/transforms.json").unlink()
    return planned(root)


@case("transforms.json cut short")
def _(root):
    own.bare(root / "data/own")
    path = root / "data/own/transforms.json"
    path.write_text(path.read_text()[:-40])
    return planned(root)


case("empty view list: no frames")(lambda root: changed(root, frames=[]))


@case("empty view list: glob without match")
def _(root):
    own.bare(root / "data/own")
    return planned(root, source={"frames": "rgb/*"})


@case("images absent")
def _(root):
    own.bare(root / "data/own")
    for name in ("000", "002"):
        (root / f"data/own/images/{name}.png").unlink()
    return planned(root)


@case("image damaged")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/images/001.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    return planned(root)


@case("JPEG cut short")
def _(root):
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    document = own.bare(root / "data/own")
    document["frames"][0]["file_path"] = "images/000.jpg"
    path = root / "data/own/images/000.jpg"
    thumbnail = path.with_name("small.jpg")
    Image.fromarray(noise[:8, :8]).save(thumbnail)
    exif = b"Exif\0\0" + thumbnail.read_bytes()  # a whole JPEG, with its own end mark, in the header
    Image.fromarray(noise).save(path, exif=exif)
    own.write_transforms(root / "data/own", document)
    own.project(root)
    with own.working_in(root):
        fingerprint.fingerprint("capture", "own", "draft")  # whole, it passes
    path.write_bytes(path.read_bytes()[:-200])
    return planned(root)


@case("PNG cut short")
def _(root):
    own.bare(root / "data/own")
    path = root / "data/own/images/001.png"
    path.write_bytes(path.read_bytes()[:-20])
    return planned(root)


@case("image in a format not read")
def _(root):
    document = own.bare(root / "data/own")
    document["frames"][0]["file_path"] = "images/000.gif"
    Image.new("RGB", (64, 48)).save(root / "data/own/images/000.gif")
    own.write_transforms(root / "data/own", document)
    return planned(root)


def first_as_jpeg(root, image, **options):
    document = own.bare(root / "data/own")
    document["frames"][0]["file_path"] = "images/000.jpg"
    image.save(root / "data/own/images/000.jpg", **options)
    own.write_transforms(root / "data/own", document)
    return planned(root)


case("CMYK image")(lambda root: first_as_jpeg(root, Image.new("CMYK", (64, 48))))


@case("EXIF rotation that the cameras do not explain")
def _(root):
    exif = Image.Exif()
    exif[274] = 3
    return first_as_jpeg(root, Image.new("RGB", (64, 48)), exif=exif)


@case("two images of one name")
def _(root):
    document = own.bare(root / "data/own")
    document["frames"][1]["file_path"] = "images/000.jpg"
    own.save_png(root / "data/own/images/000.jpg", np.zeros((48, 64, 3)))
    own.write_transforms(root / "data/own", document)
    return planned(root)


@case("the same photograph twice")
def _(root):
    document = own.bare(root / "data/own")
    document["frames"][2]["file_path"] = "images/000.png"
    own.write_transforms(root / "data/own", document)
    return planned(root)


@case("images of different sizes")
def _(root):
    own.bare(root / "data/own")
    own.save_png(root / "data/own/images/001.png", np.zeros((24, 32, 3)))
    return planned(root)


# ----------------------------------------------------------------------------------------------------------------
# cameras

TWICE = {"fl_x": 120.0, "fl_y": 124.0, "cx": 66.0, "cy": 46.0}
case("intrinsics for another resolution")(lambda root: changed(root, w=128, h=96, **TWICE))
case("the same, without `w` and `h`")(lambda root: changed(root, w=None, h=None, **TWICE))
case("w and h swapped")(lambda root: changed(root, w=48, h=64))
case("cx and cy swapped")(lambda root: changed(root, cx=23.0, cy=33.0))
case("misspelt key in transforms.json")(lambda root: changed(root, fl_x=None, flx=60.0))
case("no focal length")(lambda root: changed(root, fl_x=None, fl_y=None))


@case("pose missing")
def _(root):
    document = own.bare(root / "data/own")
    del document["frames"][1]["transform_matrix"]
    own.write_transforms(root / "data/own", document)
    return planned(root)


case("pose not 4x4")(lambda root: second_pose(root, lambda pose: pose[:3]))
case("pose with NaN")(lambda root: second_pose(root, lambda pose: pose * np.nan))
case("pose with a scale")(lambda root: second_pose(root, lambda pose: pose @ np.diag([2.0, 2, 2, 1])))
case("pose with a reflection")(lambda root: second_pose(root, lambda pose: pose @ np.diag([-1.0, 1, 1, 1])))
case("unknown lens model")(lambda root: changed(root, camera_model="EQUIRECTANGULAR"))
case("lens coefficients on a pinhole")(lambda root: changed(root, camera_model="PINHOLE", k1=-0.1))


# ----------------------------------------------------------------------------------------------------------- other
# files


@case("EXR photographs declared LDR")
def _(root):
    path = root / "data/own"
    document = own.bare(path)
    for entry in document["frames"]:
        entry["file_path"] = entry["file_path"].replace(".png", ".exr")
        own.save_exr(path / entry["file_path"], dict.fromkeys("RGB", np.ones((48, 64), np.float32)))
    own.write_transforms(path, document)
    return planned(root)


@case("8-bit photographs declared HDR")
def _(root):
    own.bare(root / "data/own")
    return planned(root, capture={"dynamic_range": "hdr"})


@case("mesh absent")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/mesh.ply").unlink()
    return planned(root)


@case("mesh empty")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/mesh.ply").write_bytes(b"")
    return planned(root)


@case("mesh is no PLY")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/mesh.ply").write_text("version https://git-lfs.github.com/spec/v1\n")
    return planned(root)


@case("several meshes")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/mesh.obj").write_text("")
    return planned(root)


@case("instance files under other names")
def _(root):
    own.bare(root / "data/own")
    own.save_png(root / "data/own/instances/frame_0.png", np.zeros((48, 64, 3)))
    return planned(root)


@case("truth incomplete")
def _(root):
    own.bare(root / "data/own")
    albedo = dict.fromkeys("RGB", np.ones((48, 64), np.float32))
    for i in range(3):
        own.save_exr(root / f"data/own/truth/albedo/{i:03d}.exr", albedo)
    return planned(root)


@case("mask missing")
def _(root):
    document = own.bare(root / "data/own")
    document["frames"][1]["mask_path"] = "masks/001.png"
    own.write_transforms(root / "data/own", document)
    return planned(root)


case("photograph listed for train and test")(
    lambda root: changed(root, train_filenames=["images/000.png", "images/001.png"], test_filenames=["images/001.png"])
)


@case("`applied_transform: undo` without one")
def _(root):
    own.bare(root / "data/own")
    return planned(root, source={"applied_transform": "undo"})


@case("exposure missing or not positive")
def _(root):
    own.bare(root / "data/own")
    (root / "data/own/exposures.json").write_text(json.dumps({"000": 1, "001": -1, "002": 1}))
    return planned(root)


# ------------------------------------------------------------------------------------------------------------ capture
# job


@case("mesh in millimetres")
def _(root):
    path = root / "data/own"
    document = own.bare(path)
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", vertices * 1000, faces)
    for entry in document["frames"]:
        pose = np.array(entry["transform_matrix"])
        pose[:3, 3] *= 1000
        entry["transform_matrix"] = pose.tolist()
    own.write_transforms(path, document)
    return captured(root)


@case("mesh in millimetres, cameras in metres")
def _(root):
    own.bare(root / "data/own")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(root / "data/own/mesh.ply", vertices * 1000, faces)
    return captured(root)


@case("point cloud instead of a mesh")
def _(root):
    own.bare(root / "data/own")
    own.save_mesh(root / "data/own/mesh.ply", own.room_mesh()[0], np.zeros((0, 3), int))
    return captured(root)


@case("mesh cut short, as text")
def _(root):
    own.bare(root / "data/own")
    path = root / "data/own/mesh.ply"
    path.write_bytes(path.read_bytes()[:-30])
    return captured(root)


@case("mesh cut short, binary")
def _(root):
    own.bare(root / "data/own")
    path = root / "data/own/mesh.ply"
    vertices, faces, _ = own.room_mesh()
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    path.write_bytes(path.read_bytes()[:-30])
    return planned(root)


def moved(root, which, by):
    document = own.bare(root / "data/own")
    for i in which:
        pose = np.array(document["frames"][i]["transform_matrix"])
        pose[:3, 3] += by
        document["frames"][i]["transform_matrix"] = pose.tolist()
    own.write_transforms(root / "data/own", document)


@case("all cameras far from the mesh")
def _(root):
    moved(root, range(3), [100, 0, 0])
    return captured(root)


@case("all cameras look at nothing")
def _(root):
    document = own.bare(root / "data/own")
    for entry in document["frames"]:
        pose = np.array(entry["transform_matrix"])
        pose[:3, 3] = [3, -0.5, 4]  # above the room, looking up
        pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
        entry["transform_matrix"] = pose.tolist()
    own.write_transforms(root / "data/own", document)
    return captured(root)


@case("all cameras look at nothing, and other axes would see the mesh")
def _(root):
    """A block on a floor, no walls: cameras that look the other way see nothing at all."""
    path = root / "data/own"
    own.photographed(path, depth=False)
    vertices, faces, thing = own.room_mesh()
    on_floor = (vertices[faces][..., 2] == own.ROOM[0][2]).all(1)
    own.save_mesh(path / "mesh.ply", vertices, faces[(thing == 1) | on_floor])
    return captured(root, source={"axes": "opencv"})


def filled(root, value, which):
    """A bare scene of which some photographs have one value everywhere."""
    document = own.bare(root / "data/own")
    for i in which:
        own.save_png(root / "data/own" / document["frames"][i]["file_path"], np.full((48, 64, 3), value))


@case("all photographs black")
def _(root):
    filled(root, 0.0, range(3))
    return captured(root)


@case("all photographs white")
def _(root):
    filled(root, 1.0, range(3))
    return captured(root)


@case("one photograph black")
def _(root):
    filled(root, 0.0, [1])
    return noted(root, "black all over")


@case("one photograph white")
def _(root):
    filled(root, 1.0, [1])
    return noted(root, "white all over")


@case("camera axes wrong (depth images exist)")
def _(root):
    own.photographed(root / "data/own")
    return captured(root, source={"axes": "opencv"})


@case("camera axes wrong (no depth images)")
def _(root):
    own.photographed(root / "data/own", depth=False)
    return captured(root, source={"axes": "opencv"})


@case("unit wrong (depth images exist)")
def _(root):
    own.photographed(root / "data/own")
    return captured(root, source={"unit": 3.0})


@case("`given` without instance ids")
def _(root):
    own.photographed(root / "data/own", 2, depth=False)
    own.project(root, segmentation={"kind": "given"})
    return error(lambda: own.run(root, "capture", "segmentation"))


# --------------------------------------------------------------------------------------------------------------
# treatment


@case("zero-area triangles")
def _(root):
    own.bare(root / "data/own")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(root / "data/own/mesh.ply", vertices, np.concatenate([faces, [[0, 0, 1], [2, 3, 3]]]))
    return noted(root, "zero-area")


@case("faces with NaN vertices")
def _(root):
    own.bare(root / "data/own")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(
        root / "data/own/mesh.ply",
        [*vertices, [np.nan] * 3],
        np.concatenate([faces, [[0, 1, len(vertices)]]]),
    )
    return noted(root, "NaN vertices")


@case("NaN pixels")
def _(root):
    path = root / "data/own"
    document = own.bare(path)
    for i, entry in enumerate(document["frames"]):
        entry["file_path"] = entry["file_path"].replace(".png", ".exr")
        pixels = np.ones((48, 64), np.float32)
        pixels[3, 4] = np.nan if i == 1 else 1
        own.save_raw_exr(path / entry["file_path"], dict.fromkeys("RGB", pixels))
    own.write_transforms(path, document)
    return noted(root, "NaN or infinite", capture={"dynamic_range": "hdr"})


@case("focal lengths far apart")
def _(root):
    own.write_transforms(root / "data/own", own.bare(root / "data/own") | {"fl_x": 31.0})
    return noted(root, "fl_x / fl_y")


def first_as(root, image, word, **options):
    """The note with this word when the first photograph is this picture."""
    own.bare(root / "data/own")
    image.save(root / "data/own/images/000.png", **options)
    return noted(root, word)


@case("16-bit PNG")
def _(root):
    import mitsuba as mi

    own.bare(root / "data/own")
    mi.Bitmap(np.full((48, 64, 3), 30000, np.uint16)).write(str(root / "data/own/images/000.png"))
    text = noted(root, "16-bit")
    photo = own.run(root).photo(own.run(root).views[0])[0]
    np.testing.assert_allclose(photo, 30000 / 65535, atol=1e-6)  # not cut to 8 bits, which would give 116 / 255
    return text


@case("RGBA image, opaque")
def _(root):
    own.bare(root / "data/own")
    path = root / "data/own/images/000.png"
    Image.open(path).convert("RGBA").save(path)
    own.project(root)
    capture = own.run(root, "capture")
    assert not [note for note in capture.facts["notes"] if "transparent" in note or "grey" in note]
    np.testing.assert_array_equal(capture.photo(capture.views[0])[0], capture.photo(capture.views[1])[0])
    return "none: alpha is dropped"


@case("EXIF rotation that the cameras explain")
def _(root):
    document = own.bare(root / "data/own")
    exif = Image.Exif()
    exif[274] = 6  # stored on its side: 48x64, upright 64x48 as `w` x `h` say
    Image.new("RGB", (48, 64)).save(root / "data/own/images/000.jpg", exif=exif)
    document["frames"][0]["file_path"] = "images/000.jpg"
    own.write_transforms(root / "data/own", document)
    return noted(root, "EXIF")


@case("masked pixels")
def _(root):
    document = own.bare(root / "data/own")
    document["frames"][1]["mask_path"] = "masks/001.png"
    mask = np.full((48, 64), 255, np.uint8)
    mask[0] = 0
    mini.save_mask(root / "data/own/masks/001.png", mask)
    own.write_transforms(root / "data/own", document)
    return noted(root, "masked")


def listed(root, *other):
    """The last of three photographs is for testing; `other`: those that are other pictures than that one."""
    document = own.bare(root / "data/own")
    for number in other:
        own.save_png(root / f"data/own/images/00{number}.png", np.full((48, 64, 3), 0.4 + 0.02 * number))
    own.write_transforms(root / "data/own", document | {"test_filenames": ["images/002.png"]})


@case("lists of train and test")
def _(root):
    listed(root, 0, 1)
    return noted(root, "lists")


@case("a used photograph that repeats a held-out one")
def _(root):
    listed(root, 1)
    return noted(root, "repeat")


@case("all used photographs repeat a held-out one")
def _(root):
    listed(root)
    return captured(root)


case("grey image")(lambda root: first_as(root, Image.new("L", (64, 48), 90), "grey"))


@case("transparent pixels")
def _(root):
    own.bare(root / "data/own")
    rgba = np.full((48, 64, 4), 255, np.uint8)
    rgba[0, 0, 3] = 0
    Image.fromarray(rgba, "RGBA").save(root / "data/own/images/001.png")
    return noted(root, "transparent")


@case("one camera outside the room looking at nothing")
def _(root):
    moved(root, [0], [0, 0, 50])
    document = json.loads((root / "data/own/transforms.json").read_text())
    document["frames"][0]["transform_matrix"][2][:3] = [0, 0, -1]
    document["frames"][0]["transform_matrix"][0][:3] = [1, 0, 0]
    document["frames"][0]["transform_matrix"][1][:3] = [0, -1, 0]
    own.write_transforms(root / "data/own", document)
    text = noted(root, "dropped")
    kept = json.loads((root / "results/own/capture/capture.json").read_text())
    assert kept["dropped_views"] == {"000": 0.0}
    return text


@case("one view only")
def _(root):
    own.bare(root / "data/own", 1)
    return noted(root, "one view only")


@case("edges of photographs and mesh apart (no depth images)")
def _(root):
    own.bare(root / "data/own")  # grey pictures have no edges at all
    return noted(root, "WARNING")


# ------------------------------------------------------------------------------------------------------------- strangers


def with_size(path, width, height):
    """A PNG whose header states another size; its pixels are never read."""
    data = path.read_bytes()
    body = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
    path.write_bytes(data[:12] + body + struct.pack(">I", zlib.crc32(body)) + data[33:])


@case("a photograph with too many pixels")
def _(root):
    own.bare(root / "data/own")
    with_size(root / "data/own/images/000.png", 13_000, 13_000)
    return planned(root)


@case("an EXR with too many pixels")
def _(root):
    path = root / "data/own"
    document = own.bare(path)
    for entry in document["frames"]:
        entry["file_path"] = entry["file_path"].replace(".png", ".exr")
        own.save_exr(path / entry["file_path"], {c: np.zeros((48, 64), np.float32) for c in "RGB"})
    own.write_transforms(path, document)
    first = path / "images/000.exr"
    data = first.read_bytes()
    at = data.index(b"dataWindow\0box2i\0") + 21
    first.write_bytes(data[:at] + struct.pack("<4i", 0, 0, 19_999, 19_999) + data[at + 16 :])
    return planned(root, capture={"dynamic_range": "hdr"})


def renamed(root, *names):
    path = root / "data/own"
    document = own.bare(path)
    for entry, name in zip(document["frames"], names, strict=False):
        entry["file_path"] = name
        if name != "/":
            own.save_png(path / name, np.full((48, 64, 3), 0.5))
    own.write_transforms(path, document)
    return planned(root)


case("a path that names no file")(lambda root: renamed(root, "/"))
case("two names that differ in capital letters alone")(lambda root: renamed(root, "images/000a.png", "images/000A.png"))


@case("a key twice in transforms.json")
def _(root):
    path = root / "data/own"
    text = json.dumps(own.bare(path))
    (path / "transforms.json").write_text(text[:-1] + ', "w": 64}')
    return planned(root)


case("a focal length that no lens has")(lambda root: changed(root, fl_x=1e10, fl_y=1e10))
case("a number without meaning in transforms.json")(lambda root: changed(root, fl_x=1e308))


@case("an exposure without meaning")
def _(root):
    own.bare(root / "data/own")
    exposures = {"000": 1.0, "001": 1e308, "002": 1.0}
    (root / "data/own/exposures.json").write_text(json.dumps(exposures))
    return planned(root)


@case("mesh whose header announces more than there is")
def _(root):
    own.bare(root / "data/own")
    path = root / "data/own/mesh.ply"
    path.write_text(path.read_text().replace("element face 24", "element face 40000000"))
    return planned(root)


@case("OBJ cut short in its last line")
def _(root):
    return planned(root) if obj_instead(root, lambda text: text + "f 1 2") else ""


@case("OBJ cut short between two lines")
def _(root):
    vertices, faces, _ = own.room_mesh()
    extra = "".join(f"v {x} 0 1\n" for x in range(12))  # of faces that are not there
    obj_instead(root, lambda text: extra + text, shift=12)
    return noted(root, "cut short")


def obj_instead(root, change, shift=0):
    """A photographed scene whose mesh is an OBJ file that `change` has changed."""
    path = root / "data/own"
    own.photographed(path, count=3)
    (path / "mesh.ply").unlink()
    vertices, faces, _ = own.room_mesh()
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in vertices) + "".join(
        f"f {a + 1 + shift} {b + 1 + shift} {c + 1 + shift}\n" for a, b, c in faces
    )
    (path / "mesh.obj").write_text(change(text))
    return path


case("settings: anchors that grow")(
    lambda root: loaded(
        root,
        "a: &a [1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(f"{b}: &{b} [{', '.join(['*' + a] * 8)}]\n" for a, b in zip("abcdefg", "bcdefgh", strict=True)),
    )
)
case("settings: nested too deeply")(lambda root: loaded(root, "x: " + "[" * 100 + "]" * 100 + "\n"))
case("settings: a number without meaning")(lambda root: loaded(root, "capture: {views: .inf}\n"))
case("settings: a value of the wrong form")(lambda root: loaded(root, "capture: {views: !!int x}\n"))


# ---------------------------------------------------------------------------------------------------------- other sources


@functools.cache
def miniature():
    """The tiny room and six photographs of it through a fisheye."""
    room = mini.room()
    return room, mini.photographs(room)


def model(root):
    """A folder with a COLMAP model of four photographs."""
    room, views = miniature()
    return test_colmap.scene(root / "data/own", room, views[:4])


@case("COLMAP: no model where `cameras` says")
def _(root):
    model(root)
    return planned(root, source={"cameras": "sparse/1"})


@case("COLMAP: lens that is not read")
def _(root):
    test_colmap.cameras(model(root), "1 FOV 146 97 60 60 73 48 0.9")
    return planned(root)


@case("COLMAP: file cut short")
def _(root):
    test_colmap.cameras(model(root), "1 PINHOLE 146 97 60")
    return planned(root)


@case("COLMAP: mesh of another scale")
def _(root):
    own.save_mesh(model(root) / "mesh.ply", miniature()[0].vertices * 1.3, miniature()[0].faces)
    return captured(root)


@case("COLMAP: counts that the file cannot hold")
def _(root):
    place = model(root) / "sparse/0"
    test_colmap.to_binary(place)
    for path in place.glob("*.txt"):
        path.unlink()
    data = (place / "points3D.bin").read_bytes()
    (place / "points3D.bin").write_bytes(struct.pack("<Q", 10**9) + data[8:])
    return captured(root)


@case("COLMAP: intrinsics changed")
def _(root):
    test_colmap.cameras(model(root), "1 OPENCV_FISHEYE 146 97 72.4 48.9 65.8 66.1 0 0 0 0")
    return captured(root)


@case("COLMAP: images without pose")
def _(root):
    mini.save_jpeg(model(root) / "images/DSC00099.JPG", miniature()[1][0][1])
    return noted(root, "no pose")


def scannetpp(root):
    """A released scene at data/all/mini and the settings that name it."""
    home = mini.release(root / "data/all/mini", *miniature())
    return home, {"kind": "scannetpp", "path": "data/all/mini"}


@case("ScanNet++: the folder of all scenes")
def _(root):
    _, source = scannetpp(root)
    return planned(root, source={**source, "path": "data/all"})


@case("ScanNet++: poses in another world than COLMAP's")
def _(root):
    _, source = scannetpp(root)
    return planned(root, source={**source, "world": "mesh"})


@case("ScanNet++: anonymisation mask missing")
def _(root):
    home, source = scannetpp(root)
    (home / "dslr/resized_anon_masks/DSC00001.png").unlink()
    return planned(root, source=source)


@case("ScanNet++: anonymisation mask empty")
def _(root):
    home, source = scannetpp(root)
    (home / "dslr/resized_anon_masks/DSC00001.png").write_bytes(b"")
    return planned(root, source=source)


@case("ScanNet++: mesh is an error page")
def _(root):
    home, source = scannetpp(root)
    (home / "scans/mesh_aligned_0.05.ply").write_text("<!DOCTYPE html><title>404</title>")
    return planned(root, source=source)


@case("ScanNet++: no annotation")
def _(root):
    home, source = scannetpp(root)
    (home / "scans/segments_anno.json").unlink()
    return planned(root, source=source, segmentation={"kind": "given"})


@case("ScanNet++: photograph listed for train and test")
def _(root):
    home, source = scannetpp(root)
    path = home / "dslr/train_test_lists.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"test": ["DSC00000.JPG"]}))
    return planned(root, source=source)


@case("ScanNet++: segments of another mesh")
def _(root):
    home, source = scannetpp(root)
    (home / "scans/segments.json").write_text(json.dumps({"segIndices": [100] * 7}))
    return captured(root, source=source)


@case("ScanNet++: bad photographs")
def _(root):
    return noted(root, "bad", source=scannetpp(root)[1])


@case("FIPT: neither layout")
def _(root):
    test_fipt.real(root / "data/own")
    (root / "data/own/cam.txt").unlink()
    return planned(root, source={"kind": "fipt"}, capture={"dynamic_range": "hdr"})


@case("FIPT: look-at point and up exchanged")
def _(root):
    test_fipt.real(root / "data/own")
    path = root / "data/own/cam.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], lines[3], lines[2], *lines[4:]]))
    return planned(root, source={"kind": "fipt"}, capture={"dynamic_range": "hdr"})


def sam2(root, **keys):
    """The message while Snakemake plans, where SAM 2 is to make the masks."""
    own.bare(root / "data/own")
    own.project(root, segmentation={"kind": "masks", "sam2": {"accept_license": True} | keys})
    with own.working_in(root), pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(root / "hub"))
        return error(lambda: fingerprint.fingerprint("segmentation", "own", "draft"))


def sam2_folder(root, model, weights):
    """A folder in transformers' layout: config.json says `model`."""
    folder = root / "sam2"
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"model_type": model}))
    (folder / "model.safetensors").write_bytes(weights)
    return str(folder)


HEADER = b'{"a": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]}}'
ONE_TENSOR = len(HEADER).to_bytes(8, "little") + HEADER
case("SAM 2: no weights here")(sam2)
case("SAM 2: licence not accepted")(
    lambda root: sam2(root, checkpoint=sam2_folder(root, "sam2", ONE_TENSOR), accept_license=False)
)
case("SAM 2: another model's folder")(lambda root: sam2(root, checkpoint=sam2_folder(root, "clip", ONE_TENSOR)))
case("SAM 2: weights cut short")(lambda root: sam2(root, checkpoint=sam2_folder(root, "sam2", ONE_TENSOR[:20])))


@case("masks to read and a model to make them")
def _(root):
    own.project(root, segmentation={"kind": "masks", "path": "elsewhere", "sam2": {}})
    with own.working_in(root):
        return error(lambda: settings.load("own"))


# ------------------------------------------------------------------------------------------------------------------
# relighting


def relit(**more):
    return Relighting(**{"name": "a", **more}).model_dump(mode="json")


def put_in(path):
    """The message about a mesh that is put in."""

    def checked():
        entry = relit(insert=[{"file": str(path), "position": [0, 0, 0]}])
        settings.relight_files([entry])
        light_of(load_insert(path), entry["insert"][0])

    return error(checked)


@case("plan that is not there")
def _(root):
    (root / "config/relight").mkdir(parents=True)
    (root / "config/relight/night.yaml").write_text("relight: [{name: a}]")
    return error(lambda: relight_plans.plan_layer("nihgt", root))


@case("codec that is not there")
def _(root):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(video.ENCODERS, "av1", "libnothing")
        return error(lambda: video.require_codec("av1", "a"))


def vase(root, **material):
    """A triangle in a GLB."""
    shape = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]], process=False)
    material = trimesh.visual.material.PBRMaterial(**material)
    shape.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1]], material=material)
    (root / "vase.glb").write_bytes(trimesh.Scene({"a": shape}).export(file_type="glb"))
    return root / "vase.glb"


def gltf(root, **keys):
    (root / "vase.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, **keys}))
    return root / "vase.gltf"


@case("mesh to put in: not there")
def _(root):
    return put_in(vase(root).with_name("vaes.glb"))


@case("mesh to put in: cut short")
def _(root):
    path = vase(root)
    path.write_bytes(path.read_bytes()[:-40])
    return put_in(path)


@case("mesh to put in: empty")
def _(root):
    vase(root).write_bytes(b"")
    return put_in(root / "vase.glb")


@case("mesh to put in: no GLB")
def _(root):
    (root / "vase.glb").write_text("a text, and longer than the header of a GLB")
    return put_in(root / "vase.glb")


case("mesh to put in: texture not there")(lambda root: put_in(gltf(root, images=[{"uri": "wood.png"}])))
case("mesh to put in: compressed")(lambda root: put_in(gltf(root, extensionsRequired=["EXT_meshopt_compression"])))


@case("mesh to put in: texture of emission")
def _(root):
    picture = Image.fromarray(np.full((2, 2, 3), 200, np.uint8))
    return put_in(vase(root, name="screen", emissiveTexture=picture, emissiveFactor=[1, 1, 1]))


def of_room(**more):
    """The message of a room with walls and a lamp."""
    return error(lambda: Inventory(["walls", "lamp"], [Lamp(0, (1,))]).check(relit(**more)))


@case("object put in far from the room")
def _(root):
    entry = relit(insert=[{"file": "vase.glb", "position": [200, 0, 0]}])
    return error(lambda: check_places(entry, np.zeros(3), np.array([5.0, 4, 3])))


case("object that is not there, painted")(lambda root: of_room(materials={"wals": {"metallic": 0}}))
case("lamp that is not there")(lambda root: of_room(lamps={"lmap": 0}))


@pytest.mark.parametrize("name", sorted(CASES))
def test_row(name, tmp_path):
    message = CASES[name](tmp_path)
    named(message, *data_of(ROWS[name]))
    assert "Traceback" not in message and "\n" not in message.strip()


def test_every_photograph_without_a_pose_is_named(tmp_path):
    path = tmp_path / "data/own"
    document = own.bare(path, 30)
    for entry in document["frames"][2:]:
        del entry["transform_matrix"]
    own.write_transforms(path, document)
    message = planned(tmp_path, capture={"views": 30})
    for i in range(2, 22):
        assert f"frames[{i}] (images/{i:03d}.png)" in message
    assert "and 8 more: `transform_matrix` missing" in message and "frames[22]" not in message


@pytest.mark.parametrize("key", ["_name", "_mask", "_seen", "_split", "_where", "_mask_full"])
def test_keys_that_begin_with_an_underscore_are_not_taken_from_a_file(tmp_path, key):
    """They carry what the readers themselves know; a name from outside would lead out of results/."""
    path = tmp_path / "data/own"
    document = own.bare(path)
    dumped = own.settings_of(path)
    expected = transforms.read(dumped["source"], dumped["capture"]).frames
    document["frames"][1][key] = "../../evil"
    own.write_transforms(path, document)
    found = transforms.read(dumped["source"], dumped["capture"]).frames
    assert [frame.name for frame in found] == ["000", "001", "002"]
    assert [(f.mask, f.mask_full, f.split, f.seen) for f in found] == [(f.mask, f.mask_full, f.split, f.seen) for f in expected]


def test_a_folder_with_a_similar_name_is_suggested(tmp_path):
    own.bare(tmp_path / "data/office")
    message = planned(tmp_path, source={"path": "data/ofice"})
    assert message.endswith("Did you mean data/office?")


def test_every_example_of_the_guide_is_valid():
    guide, programs = ((PAGE.parents[2] / f"docs/guide/{name}.md").read_text() for name in ("own-data", "programs"))
    examples = re.findall(r"```yaml\n(.*?)```", guide + programs, re.DOTALL)
    kinds = {settings.SceneSettings.model_validate(yaml.safe_load(text)).source.kind for text in examples}
    assert kinds == {"folder", "photographs", "scannetpp", "fipt"}
    matrix = json.loads(re.search(r"```json\n(.*?)```", guide, re.DOTALL)[1])["frames"][0]["transform_matrix"]
    assert np.linalg.det(np.array(matrix)[:3, :3]) == pytest.approx(1, abs=0.02)
