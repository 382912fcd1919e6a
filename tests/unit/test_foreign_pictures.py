"""Photographs as other programs write them: windows of EXR, colours by chunks and EXIF, black borders, names of other systems."""

import json
import struct
import subprocess
import sys
import unicodedata
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from iif_core.numerics.color import linear_from_srgb, srgb_from_linear
from tests.errors import refused
from tests.unit import own_scene as own
from workflow.intake.names import existing
from workflow.sources.folder_scene import borders, images, transforms
from workflow.sources.folder_scene.photographs import decoded
from workflow.sources.folder_scene.profiles import SPACES

TELEPHONE = Path(__file__).with_name("photograph.heic")
"""64 x 48 pixels, turned by EXIF: red and green rise by 4 and 5 to the right and down, blue is 128; 1/50 s, ISO 200, f/1.8."""

# -------------------------------------------------------------------------------------------------------- windows of EXR


def exr(path, picture, place=(0, 0), display=None):
    """An EXR whose first pixel is at `place` (x, y) of a display window of the given size (width, height)."""
    height, width = picture.shape[:2]
    size = display or (width, height)
    corner = (place[0] + width - 1, place[1] + height - 1)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {"dataWindow": (place, corner), "displayWindow": ((0, 0), (size[0] - 1, size[1] - 1))}
    header = {k: tuple(np.array(c, np.int32) for c in v) if "Window" in k else v for k, v in header.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {c: np.ascontiguousarray(picture[..., k], np.float32) for k, c in enumerate("RGB")}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def picture(width, height):
    return np.random.default_rng(1).uniform(0.1, 1.0, (height, width, 3)).astype(np.float32)


def test_a_crop_stands_where_it_was(tmp_path):
    whole = picture(20, 12)
    path = exr(tmp_path / "a.exr", whole[3:9, 5:18], (5, 3), (20, 12))
    photo = images.load_photo(path, size=(20, 12))
    assert images.header(path).shown == (20, 12) and photo.pixels.shape == (12, 20, 3)
    np.testing.assert_array_equal(photo.pixels[3:9, 5:18], whole[3:9, 5:18])
    held = np.zeros((12, 20), bool)
    held[3:9, 5:18] = True
    np.testing.assert_array_equal(photo.valid, held)
    assert (photo.outside, photo.non_finite) == (240 - 78, 0)


def test_overscan_is_cut_off(tmp_path):
    whole = picture(20, 12)
    path = exr(tmp_path / "a.exr", whole, (-4, -2), (12, 8))
    photo = images.load_photo(path, size=(12, 8))
    np.testing.assert_array_equal(photo.pixels, whole[2:10, 4:16])
    assert photo.valid.all() and photo.outside == 0
    np.testing.assert_array_equal(images.load_photo(path).pixels, whole)  # without a camera, all that the file holds


def test_a_window_beside_the_picture_holds_nothing_of_it(tmp_path):
    photo = images.load_photo(exr(tmp_path / "a.exr", picture(6, 4), (100, 100), (10, 8)), size=(10, 8))
    assert photo.pixels.shape == (8, 10, 3) and not photo.valid.any()


@pytest.mark.parametrize("stated, shape", [((12, 8), (12, 8)), ((20, 12), (20, 12)), (None, (12, 8))])
def test_cameras_belong_to_the_window_of_their_size(tmp_path, stated, shape):
    path = own.project(tmp_path, capture={"dynamic_range": "hdr"})
    document = own.bare(path)
    for i, entry in enumerate(document["frames"]):
        entry["file_path"] = f"images/{i}.exr"
        exr(path / entry["file_path"], picture(20, 12), (-4, -2), (12, 8))
    for key in ("w", "h", "cx", "cy", "fl_x", "fl_y"):
        document.pop(key, None)
    document |= {"fl_x": 15.0} | ({"w": stated[0], "h": stated[1]} if stated else {})
    own.write_transforms(path, document)
    source = {"path": str(path), "cameras": None, "applied_transform": "keep", "alignment": "off"}
    frames = transforms.read(source, {"views": 9, "dynamic_range": "hdr"}).frames
    assert {(f.camera.width, f.camera.height, f.camera.fx) for f in frames} == {(*shape, 15.0)}
    assert decoded(frames[0]).pixels.shape[:2] == shape[::-1]


def test_crops_of_different_sizes_share_intrinsics(tmp_path):
    path = own.project(tmp_path, capture={"dynamic_range": "hdr"})
    document, shots = own.photographed(path, 4, depth=False, hdr=True)
    for i, (_, shot, _, _) in enumerate(shots):
        exr(path / f"images/{i:03d}.exr", shot[2 * i :, 3 * i :], (3 * i, 2 * i), (64, 48))
    for key in ("w", "h"):
        document.pop(key)
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    for i, view in enumerate(capture):
        photo, valid = capture.photo(view)
        assert valid[2 * i :, 3 * i :].all() and not valid[: 2 * i].any() and not valid[:, : 3 * i].any()
        np.testing.assert_allclose(photo[valid], shots[i][1][valid], atol=2e-5)


@pytest.mark.parametrize("place, display", [((10, 6), (100, 80)), ((-4, -2), (56, 44))])
def test_depth_ids_and_truth_follow_the_window_of_the_photograph(tmp_path, place, display):
    """Cameras that belong to the data window: of a crop or of overscan."""
    path = own.project(tmp_path, source={"registration": "off"}, capture={"dynamic_range": "hdr"})
    document, shots = own.photographed(path, 3, depth=False, hdr=True)
    for i, (_, shot, depth, face) in enumerate(shots):
        exr(path / f"images/{i:03d}.exr", shot, place, display)
        grey = np.repeat(depth[..., None], 3, -1)
        exr(path / f"depth/{i:03d}.exr", grey, place, display)
        document["frames"][i]["depth_file_path"] = f"depth/{i:03d}.exr"
        for kind, value in (("albedo", 0.25), ("emission", 0.0), ("roughness", 0.5), ("metallic", 0.0)):
            exr(path / f"truth/{kind}/{i:03d}.exr", np.full_like(shot, value), place, display)
        header = {
            "dataWindow": (place, (place[0] + 63, place[1] + 47)),
            "displayWindow": ((0, 0), (display[0] - 1, display[1] - 1)),
        }
        header = {k: tuple(np.array(c, np.int32) for c in v) for k, v in header.items()} | {"type": OpenEXR.scanlineimage}
        (path / "instances").mkdir(exist_ok=True)
        with OpenEXR.File(header, {"Y": (face // 12).astype(np.uint32)}) as file:
            file.write(str(path / f"instances/{i:03d}.exr"))
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    assert capture.facts["alignment"]["depth_median_disagreement"] < 1e-3
    for view, (_, _, _, face) in zip(capture, shots, strict=True):
        assert (capture.truth(view).albedo == 0.25).all() and capture.photo(view)[1].all()
        np.testing.assert_array_equal(capture.given_instances(view), face // 12)


def test_integers_that_a_crop_lacks_are_not_valid(tmp_path):
    header = {"dataWindow": ((2, 1), (3, 2)), "displayWindow": ((0, 0), (4, 3)), "type": OpenEXR.scanlineimage}
    header = {k: tuple(np.array(c, np.int32) for c in v) if "Window" in k else v for k, v in header.items()}
    with OpenEXR.File(header, {c: np.ones((2, 2), np.uint32) for c in "RGB"}) as file:
        file.write(str(tmp_path / "a.exr"))
    photo = images.load_photo(tmp_path / "a.exr", size=(5, 4))
    assert photo.valid.sum() == 4 and (photo.pixels[~photo.valid] == 0).all()
    assert (photo.outside, photo.non_finite) == (16, 0)


# --------------------------------------------------------------------------------------------------- colours of PNG, JPEG


def png(path, values, chunks, bits=16):
    """A PNG of colours (h, w, 3) in [0, 1] with chunks before its pixels."""
    rows = np.rint(values * (2**bits - 1)).astype(">u2" if bits == 16 else np.uint8)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", rows.shape[1], rows.shape[0], bits, 2, 0, 0, 0)
    parts = [
        chunk(b"IHDR", head),
        *(chunk(*own_chunk) for own_chunk in chunks),
        chunk(b"IDAT", zlib.compress(raw)),
        chunk(b"IEND", b""),
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def gama(gamma):
    return b"gAMA", struct.pack(">I", round(gamma * 100_000))


def chrm(name):
    red, green, blue, white = SPACES[name].primaries
    return b"cHRM", struct.pack(">8I", *(round(v * 100_000) for point in (white, red, green, blue) for v in point))


LIGHT = np.stack(np.meshgrid(*[np.linspace(0.05, 0.6, 4)] * 3, indexing="ij"), -1).reshape(8, 8, 3)
"""Linear Rec. 709, inside every other space."""


def in_space(name, light=LIGHT):
    matrix = SPACES[name].matrix
    return light if matrix is None else light @ np.linalg.inv(matrix).T


def agrees(photo, light=LIGHT, atol=0.001):
    np.testing.assert_allclose(linear_from_srgb(photo.pixels), light, atol=atol)


@pytest.mark.parametrize("bits, atol", [(16, 2e-4), (8, 0.01)])
def test_a_linear_png_that_says_so(tmp_path, bits, atol):
    photo = images.load_photo(png(tmp_path / "a.png", LIGHT, [gama(1.0)], bits))
    agrees(photo, atol=atol)
    assert "gamma 1" in photo.form


def test_gamma_and_primaries_of_png(tmp_path):
    agrees(images.load_photo(png(tmp_path / "a.png", LIGHT ** (1 / 1.8), [gama(1 / 1.8)])), atol=2e-4)
    p3 = srgb_from_linear(in_space("display_p3"))
    agrees(images.load_photo(png(tmp_path / "b.png", p3, [gama(0.45455), chrm("display_p3")])), atol=2e-4)
    wide = np.clip(in_space("rec2020"), 0, 1)
    agrees(images.load_photo(png(tmp_path / "c.png", wide, [gama(1.0), chrm("rec2020")])), atol=2e-4)


@pytest.mark.parametrize(
    "chunks", [[], [(b"sRGB", b"\0")], [gama(0.45455)], [(b"sRGB", b"\0"), gama(1.0)], [(b"cICP", bytes([1, 13, 0, 1]))]]
)
def test_what_is_srgb_stays_as_it_is(tmp_path, chunks):
    photo = images.load_photo(png(tmp_path / "a.png", srgb_from_linear(LIGHT), chunks))
    agrees(photo, atol=2e-4)
    assert photo.form == "16-bit"


def test_code_points_of_png_come_first(tmp_path):
    linear = png(tmp_path / "a.png", LIGHT, [(b"cICP", bytes([1, 8, 0, 1])), gama(0.45455), (b"sRGB", b"\0")])
    agrees(images.load_photo(linear), atol=2e-4)
    p3 = srgb_from_linear(in_space("display_p3"))
    agrees(images.load_photo(png(tmp_path / "b.png", p3, [(b"cICP", bytes([12, 13, 0, 1]))])), atol=2e-4)


@pytest.mark.parametrize(
    "coded, said", [((9, 16, 0, 1), "PQ"), ((9, 18, 0, 1), "HLG"), ((77, 13, 0, 1), "77"), ((1, 13, 0, 0), "range")]
)
def test_curves_for_screens_are_refused_by_name(tmp_path, coded, said):
    with refused("a.png", said):
        images.load_photo(png(tmp_path / "a.png", LIGHT, [(b"cICP", bytes(coded))]))


def test_primaries_that_span_nothing_are_refused(tmp_path):
    same = b"cHRM", struct.pack(">8I", *[30000] * 8)
    with refused("a.png", "cHRM"):
        images.load_photo(png(tmp_path / "a.png", LIGHT, [same]))


def test_adobe_rgb_by_exif_alone(tmp_path):
    values = in_space("adobe_rgb") ** (256 / 563)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 65535
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    stored = Image.fromarray(np.rint(values * 255).astype(np.uint8))
    stored.save(tmp_path / "a.jpg", quality=100, subsampling=0, exif=exif)
    photo = images.load_photo(tmp_path / "a.jpg")
    agrees(photo, atol=0.03)
    assert "Adobe RGB" in photo.form
    plain = Image.Exif()
    plain.get_ifd(0x8769)[0xA005] = {1: "R98"}
    stored.save(tmp_path / "b.jpg", quality=100, subsampling=0, exif=plain)
    assert images.load_photo(tmp_path / "b.jpg").form == ""


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("alpha", [False, True])
def test_a_linear_grey_png(tmp_path, bits, alpha):
    kind = np.uint8 if bits == 8 else ">u2"
    rows = np.rint(LIGHT[..., :1] * (2**bits - 1)).astype(kind)
    rows = np.concatenate([rows, np.full_like(rows, 2**bits - 1)], -1).astype(kind) if alpha else rows

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", 8, 8, bits, 4 if alpha else 0, 0, 0, 0)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    parts = [chunk(b"IHDR", head), chunk(*gama(1.0)), chunk(b"IDAT", zlib.compress(raw)), chunk(b"IEND", b"")]
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    photo = images.load_photo(tmp_path / "a.png")
    agrees(photo, np.repeat(LIGHT[..., :1], 3, -1), atol=0.01 if bits == 8 else 2e-4)
    assert "grey" in photo.form and "gamma 1" in photo.form
    plain = images.load_photo(tmp_path / "a.png", colour="srgb")
    np.testing.assert_allclose(plain.pixels[..., 0], LIGHT[..., 0], atol=0.01)
    assert "gamma" not in plain.form


def test_code_points_of_png_outrank_a_profile(tmp_path):
    from tests.unit.test_profiles import WIDE

    profile = zlib.compress(WIDE)
    chunks = [(b"cICP", bytes([1, 13, 0, 1])), (b"iCCP", b"wide\0\0" + profile)]
    agrees(images.load_photo(png(tmp_path / "a.png", srgb_from_linear(LIGHT), chunks, 8)), atol=0.01)
    agrees(images.load_photo(png(tmp_path / "b.png", srgb_from_linear(LIGHT), chunks)), atol=2e-4)


def test_what_a_prediction_says_of_its_colours_does_not_count(tmp_path):
    """Its encoding is a setting; a roughness of 0.2 is 0.2."""
    from workflow.priors import files

    path = png(tmp_path / "a.png", LIGHT, [gama(1.0), chrm("display_p3")])
    np.testing.assert_allclose(files.load(path, 8, 8, False), LIGHT, atol=1e-4)


@pytest.mark.parametrize("name", sorted(SPACES))
def test_the_setting_overrides_what_a_file_says(tmp_path, name):
    space = SPACES[name]
    light = np.clip(in_space(name), 0, 1)
    encoded = {
        "srgb": srgb_from_linear,
        "display_p3": srgb_from_linear,
        "adobe_rgb": lambda x: x ** (256 / 563),
        "rec2020": lambda x: np.where(x < 0.018, 4.5 * x, 1.099 * x**0.45 - 0.099),
    }.get(name, lambda x: x)
    path = png(tmp_path / "a.png", encoded(light), [gama(1 / 3), chrm("rec2020")])
    agrees(images.load_photo(path, colour=name), atol=5e-4)
    exr(tmp_path / "a.exr", light)
    np.testing.assert_allclose(images.load_photo(tmp_path / "a.exr", colour=name).pixels, LIGHT, atol=0.01)
    assert space.name


# -------------------------------------------------------------------------------------------------------- black borders


def bordered(root, hidden, count=6, suffix=".png", quality=95):
    """Photographs of the room with `hidden` (48, 64) bool in black."""
    path = own.project(root, source={"alignment": "warn"})
    document, shots = own.photographed(path, count, depth=False)
    for i, entry in enumerate(document["frames"]):
        shot = np.where(hidden(i)[..., None], 0.0, shots[i][1])
        (path / entry["file_path"]).unlink()
        entry["file_path"] = entry["file_path"].replace(".png", suffix)
        pixels = Image.fromarray(np.rint(shot * 255).astype(np.uint8))
        pixels.save(path / entry["file_path"], **({"quality": quality} if suffix == ".jpg" else {}))
    own.write_transforms(path, document)
    return own.run(root, "capture")


def curved(_):
    """Cushion-shaped, as an undistorted photograph is."""
    v, u = np.mgrid[-1:1:48j, -1:1:64j]
    r2 = u * u + v * v
    return (np.abs(u) * (1 + 0.15 * r2) > 1.0) | (np.abs(v) * (1 + 0.15 * r2) > 1.0)


def letterbox(_):
    out = np.zeros((48, 64), bool)
    out[:6], out[-6:] = True, True
    return out


@pytest.mark.parametrize(
    "hidden, suffix, rim",
    [(curved, ".png", borders.RIM), (letterbox, ".png", borders.RIM), (letterbox, ".jpg", borders.JPEG_RIM)],
)
def test_a_border_is_left_out_and_told(tmp_path, hidden, suffix, rim):
    from scipy.ndimage import binary_dilation

    capture = bordered(tmp_path, hidden, suffix=suffix)
    for view in capture:
        left_out = ~capture.photo(view)[1]
        assert left_out[hidden(0)].all() and not left_out[~binary_dilation(hidden(0), iterations=rim)].any()
    assert any("border" in note for note in capture.facts["notes"])


def in_the_middle(_):
    out = np.zeros((48, 64), bool)
    out[20:30, 20:30] = True
    return out


def of_some(i):
    return letterbox(i) if i % 2 else np.zeros((48, 64), bool)


def dark_corner(i):
    """Dark surface at the edge, which moves with the camera."""
    out = np.zeros((48, 64), bool)
    out[:10, 10 * i : 10 * i + 12] = True
    return out


def night(i):
    """All but a lit patch that is elsewhere in each photograph."""
    out = np.ones((48, 64), bool)
    row, column = np.random.default_rng(i).integers((4, 4), (28, 40))
    out[row : row + 16, column : column + 20] = False
    return out


def test_a_night_with_a_lamp_keeps_what_is_lit(tmp_path):
    from scipy.ndimage import binary_erosion

    capture = bordered(tmp_path, night, 12)
    for i, view in enumerate(capture):
        assert capture.photo(view)[1][binary_erosion(~night(i), iterations=borders.RIM)].all()


@pytest.mark.parametrize("hidden", [in_the_middle, of_some, dark_corner])
def test_dark_surface_is_no_border(tmp_path, hidden):
    capture = bordered(tmp_path, hidden)
    assert all(capture.photo(view)[1].all() for view in capture)
    assert not any("border" in note for note in capture.facts["notes"])


# ------------------------------------------------------------------------------------- what is written into photographs


def dated(root, text, count=12, size=(320, 240), suffix=".jpg", seed=0):
    """Return what is found in photographs of a wall with a pattern that moves, each with a text at the lower right."""
    from types import SimpleNamespace

    from PIL import ImageDraw, ImageFont

    width, height = size
    rng = np.random.default_rng(seed)
    wall = np.kron(rng.uniform(0.1, 0.9, (90, 120, 3)), np.ones((width // 26, width // 26, 1)))
    frames = []
    for i in range(count):
        row, column = rng.integers(0, wall.shape[0] - height), rng.integers(0, wall.shape[1] - width)
        picture = Image.fromarray(np.rint(255 * wall[row : row + height, column : column + width]).astype(np.uint8))
        if text(i):
            font = ImageFont.load_default(height // 15)
            ImageDraw.Draw(picture).text((0.62 * width, 0.88 * height), text(i), fill=(255, 150, 20), font=font)
        path = root / f"{i:03d}{suffix}"
        picture.save(path)
        frames.append(SimpleNamespace(image=path, camera=SimpleNamespace(width=width, height=height)))
    found = borders.find_borders(frames, True, lambda frame: images.load_photo(frame.image))
    return found.get(size)


@pytest.mark.parametrize("size", [(320, 240), (640, 480)])
def test_a_date_that_is_written_into_photographs_is_left_out(tmp_path, size):
    found = dated(tmp_path, lambda i: f"2026-11-{i + 10}", size=size)
    width, height = size
    rows, columns = np.nonzero(found.written)
    assert not found.border.any() and 0.003 < found.written.mean() < 0.04
    assert rows.min() > 0.8 * height and 0.5 * width < columns.min() < 0.63 * width
    inside = found.written[int(0.9 * height) : int(0.93 * height), int(0.63 * width) : int(0.8 * width)]
    assert inside.all()  # also the digits that change
    (note,) = borders.notes_of({size: found})
    assert "source.borders" in note and f"{width}x{height}" in note


@pytest.mark.parametrize("text", [lambda i: "", lambda i: f"{i} of 12" if i % 2 else ""])
def test_a_pattern_that_moves_is_nothing_written(tmp_path, text):
    assert all(dated(tmp_path, text, seed=seed) is None for seed in range(3))


def test_a_camera_that_stands_still_has_written_nothing(tmp_path):
    from types import SimpleNamespace

    wall = np.kron(np.random.default_rng(0).uniform(0.1, 0.9, (24, 32)), np.ones((10, 10)))
    photo = images.Photo(np.repeat(wall[..., None], 3, -1).astype(np.float32), np.ones(wall.shape, bool))
    one = SimpleNamespace(image=tmp_path / "a.png", camera=SimpleNamespace(width=320, height=240))
    assert borders.find_borders([one] * 12, True, lambda _: photo) == {}


def test_a_dark_frame_that_is_not_black_is_surface():
    pixels = np.full((20, 30, 3), 0.5)
    pixels[:4] = 6 / 255
    assert not borders.black_border(pixels, np.ones((20, 30), bool), True).any()
    pixels[:4] = 1 / 255
    assert borders.black_border(pixels, np.ones((20, 30), bool), True)[:4].all()


# ---------------------------------------------------------------------------------------------- names from other systems


def renamed(tmp_path, on_disk, in_list, masks=False):
    path = own.project(tmp_path)
    document = own.bare(path)
    for i, entry in enumerate(document["frames"]):
        place = path / on_disk.format(i)
        place.parent.mkdir(parents=True, exist_ok=True)
        (path / entry["file_path"]).rename(place)
        entry["file_path"] = in_list.format(i)
        if masks:
            own.save_png(path / "masks" / f"{i}.PNG", np.ones((48, 64)))
            entry["mask_path"] = f"masks\\{i}.png"
    if not any((path / "images").iterdir()):
        (path / "images").rmdir()
    (path / "transforms.json").write_text(json.dumps(document, ensure_ascii=False), encoding="utf-8")
    source = {"path": str(path), "cameras": None, "applied_transform": "keep", "alignment": "off"}
    return transforms.read(source, {"views": 9, "dynamic_range": "ldr"}).frames


COMPOSED = unicodedata.normalize("NFC", "Küche é {}.png")


@pytest.mark.parametrize(
    "on_disk, in_list",
    [
        ("images/f_{}.png", ".\\images\\f_{}.png"),
        ("images/a b/f {}.png", "images\\a b\\f {}.png"),
        ("images/F_{}.PNG", "images/f_{}.png"),
        ("images/F_{}.PNG", "images/F_{}"),
        ("Images/f_{}.png", "images/f_{}"),
        (unicodedata.normalize("NFD", COMPOSED), COMPOSED),
        (COMPOSED, unicodedata.normalize("NFD", COMPOSED)),
    ],
)
def test_files_are_found_under_the_names_of_other_systems(tmp_path, on_disk, in_list):
    frames = renamed(tmp_path, on_disk, in_list, masks=True)
    assert [f.image.is_file() and f.mask.is_file() for f in frames] == [True] * 3
    assert len({f.image for f in frames}) == 3


def test_two_files_of_nearly_one_name_are_not_confused(tmp_path):
    (tmp_path / "a.PNG").touch()
    assert existing(tmp_path / "a.png") == tmp_path / "a.PNG"
    (tmp_path / "A.png").touch()
    assert existing(tmp_path / "a.png") == tmp_path / "a.png"  # either could be meant
    assert existing(tmp_path / "A.png") == tmp_path / "A.png"


def test_cameras_of_a_rig_share_names(tmp_path):
    path = own.project(tmp_path)
    document = own.bare(path, 4)
    for i, entry in enumerate(document["frames"]):
        name = f"images/{('left', 'right')[i % 2]}/cam/{i // 2:04d}.png"
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / entry["file_path"]).rename(path / name)
        entry["file_path"] = name
    own.write_transforms(path, document)
    source = {"path": str(path), "cameras": None, "applied_transform": "keep", "alignment": "off"}
    frames = transforms.read(source, {"views": 9, "dynamic_range": "ldr"}).frames
    assert [f.name for f in frames] == ["left_cam_0000", "right_cam_0000", "left_cam_0001", "right_cam_0001"]
    one = transforms.read(source | {"frames": "images/left/*"}, {"views": 9, "dynamic_range": "ldr"}).frames
    assert [f.name for f in one] == ["0000", "0001"]  # alone, they need no more
    fewer = transforms.read(source, {"views": 2, "dynamic_range": "ldr"}).frames
    assert {f.name for f in fewer} <= {f.name for f in frames}  # names do not depend on how many are taken


def test_photographs_that_are_missing_are_looked_for_in_all(tmp_path):
    """A cheap quality takes few photographs, and the next one would fail hours later."""
    path = own.project(tmp_path)
    own.bare(path, 8)
    (path / "images/006.png").unlink()
    source = {"path": str(path), "cameras": None, "applied_transform": "keep", "alignment": "off"}
    with refused("006.png"):
        transforms.read(source, {"views": 2, "dynamic_range": "ldr"})


def test_depth_of_another_shape_is_refused(tmp_path):
    path = own.project(tmp_path)
    document = own.bare(path)
    document["frames"][1]["depth_file_path"] = "depth/1.png"
    own.write_transforms(path, document)
    source = {"path": str(path), "cameras": None, "applied_transform": "keep", "alignment": "off"}
    own.save_depth(path / "depth/1.png", np.ones((24, 32)))
    transforms.read(source, {"views": 9, "dynamic_range": "ldr"})
    own.save_depth(path / "depth/1.png", np.ones((24, 24)))
    images._header.cache_clear()
    with refused("1.png", "24x24", "64x48", "depth_intrinsics"):
        transforms.read(source, {"views": 9, "dynamic_range": "ldr"})


# ---------------------------------------------------------------------------------------------------------- other formats


def test_heic_of_a_telephone_is_read_upright():
    """Its pixels come out turned as they are shown, so that nothing is left to turn."""
    header = images.header(TELEPHONE)
    assert (header.size, header.orientation) == ((48, 64), 1)
    assert header.stated == pytest.approx((200 / 50, 1.8))
    photo = images.load_photo(TELEPHONE)
    right, down = np.meshgrid(np.arange(64), np.arange(48))
    shown = images.TURNS[6](np.stack([4 * right, 5 * down, np.full((48, 64), 128)], -1) / 255)
    np.testing.assert_allclose(photo.pixels, shown, atol=4 / 255)
    assert photo.valid.all() and photo.form == ""


@pytest.mark.parametrize("kept", [0.3, 0.9])
def test_heic_that_is_cut_short_is_refused_before_work(tmp_path, kept):
    data = TELEPHONE.read_bytes()
    (tmp_path / "a.heic").write_bytes(data[: int(kept * len(data))])
    with refused("a.heic", "cut short"):
        images.header(tmp_path / "a.heic")


def test_code_points_of_heic_count(tmp_path):
    """Those of the file are Rec. 709; stated as Display P3, its colours are converted, and PQ is refused."""
    data = bytearray(TELEPHONE.read_bytes())
    at = data.find(b"colrnclx")
    assert at > 0
    plain = images.load_photo(TELEPHONE).pixels
    data[at + 8 : at + 12] = bytes([0, 12, 0, 13])
    (tmp_path / "p3.heic").write_bytes(data)
    np.testing.assert_allclose(images.load_photo(tmp_path / "p3.heic").pixels, SPACES["display_p3"].to_srgb(plain), atol=1e-6)
    data[at + 8 : at + 12] = bytes([0, 9, 0, 16])
    (tmp_path / "pq.heic").write_bytes(data)
    with refused("pq.heic", "PQ"):
        images.load_photo(tmp_path / "pq.heic")


@pytest.mark.parametrize("suffix", ["tif", "webp", "bmp", "png"])
def test_other_formats_need_nothing_that_was_read_before(tmp_path, suffix):
    """In a process of its own: what reads HEIC is loaded for HEIC alone, and other files do without."""
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(np.full((6, 8, 3), 100, np.uint8)).save(path)
    (tmp_path / "b.png").write_bytes(b"no picture")
    probe = f"""
from pathlib import Path
from iif_core.errors import InputError
from workflow.sources.folder_scene import images
assert images.load_photo(Path({str(path)!r})).pixels.shape == (6, 8, 3)
try:
    images.header(Path({str(tmp_path / "b.png")!r}))
except InputError as error:
    assert "none of PNG, JPEG, HEIF" in str(error), error
else:
    raise SystemExit("accepted")
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["8.tif", "16.tif", "8.jpg", "8.webp"])
def test_every_format_is_turned_once(tmp_path, kind, orientation):
    values = np.random.default_rng(0).integers(0, 256, (6, 10, 3), np.uint8)
    values = np.repeat(np.repeat(values, 8, 0), 8, 1)  # JPEG keeps blocks
    path = tmp_path / kind
    exif = Image.Exif()
    exif[274] = orientation
    if kind == "16.tif":
        tifffile.imwrite(path, values.astype(np.uint16) * 257, photometric="rgb", extratags=[(274, 3, 1, orientation, True)])
    else:
        options = {"8.webp": {"lossless": True}, "8.jpg": {"quality": 100, "subsampling": 0}}.get(kind, {})
        Image.fromarray(values).save(path, exif=exif, **options)
    header = images.header(path)
    shown = images.TURNS[orientation](values) / 255
    photo = images.load_photo(path, header.orientation)
    assert photo.pixels.shape == shown.shape
    np.testing.assert_allclose(photo.pixels, shown, atol=0.02)
    turned = header.orientation in (5, 6, 7, 8)
    assert header.size == (shown.shape[:2] if turned else shown.shape[1::-1])


def test_opacity_and_inverted_grey_of_a_tiff(tmp_path):
    colour, alpha = np.full((4, 5, 3), 20000, np.uint16), np.full((4, 5, 1), 40000, np.uint16)
    both = np.concatenate([colour, alpha], -1)
    for name, extra, shown in (("unassociated", "unassalpha", 20000), ("associated", "assocalpha", 32767.5)):
        tifffile.imwrite(tmp_path / f"{name}.tif", both, photometric="rgb", extrasamples=[extra])
        photo = images.load_photo(tmp_path / f"{name}.tif")
        np.testing.assert_allclose(photo.pixels, shown / 65535, atol=2e-5)
        assert photo.valid.all()
    tifffile.imwrite(
        tmp_path / "other.tif", np.concatenate([colour, 0 * alpha], -1), photometric="rgb", extrasamples=["unspecified"]
    )
    assert images.load_photo(tmp_path / "other.tif").valid.all()
    tifffile.imwrite(tmp_path / "white.tif", colour[..., 0], photometric="miniswhite")
    np.testing.assert_allclose(images.load_photo(tmp_path / "white.tif").pixels, 1 - 20000 / 65535, atol=2e-5)


def test_a_thumbnail_is_not_taken_for_the_photograph(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(np.zeros((4, 5, 3), np.uint8), photometric="rgb")
        file.write(np.zeros((40, 50, 3), np.uint8), photometric="rgb")
    with refused("a.tif", "2 pictures", "largest"):
        images.header(tmp_path / "a.tif")


def test_code_points_of_avif_count(tmp_path):
    Image.fromarray(np.full((16, 16, 3), 100, np.uint8)).save(tmp_path / "a.avif", quality=100)
    data = bytearray((tmp_path / "a.avif").read_bytes())
    at = data.find(b"colrnclx")
    assert at > 0 and images.load_photo(tmp_path / "a.avif").form == ""
    data[at + 8 : at + 12] = bytes([0, 9, 0, 16])
    (tmp_path / "b.avif").write_bytes(data)
    with refused("b.avif", "PQ"):
        images.load_photo(tmp_path / "b.avif")


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"planarconfig": "separate"}, {"byteorder": ">"}])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_all_sixteen_bits_of_a_tiff_are_kept(tmp_path, options, channels):
    values = np.random.default_rng(0).integers(0, 65536, (12, 20, channels), np.uint16)
    values[..., 3:] = 65535
    photometric = "minisblack" if channels == 1 else "rgb"
    planes = channels > 1 and options.get("planarconfig")
    shown = values[..., 0] if channels == 1 else np.moveaxis(values, -1, 0) if planes else values
    options = options if channels > 1 or "planarconfig" not in options else {}
    tifffile.imwrite(tmp_path / "a.tif", shown, photometric=photometric, **options)
    photo = images.load_photo(tmp_path / "a.tif")
    expected = np.repeat(values, 3, -1) if channels == 1 else values[..., :3]
    np.testing.assert_allclose(photo.pixels, expected / 65535, atol=1e-7)
    assert photo.form == ("16-bit grey" if channels == 1 else "16-bit")


@pytest.mark.parametrize("suffix", ["tif", "webp", "bmp", "avif"])
def test_eight_bits_of_other_formats(tmp_path, suffix):
    values = np.random.default_rng(0).integers(0, 256, (12, 20, 3), np.uint8)
    options = {"webp": {"lossless": True}, "avif": {"quality": 100, "subsampling": "4:4:4"}}.get(suffix, {})
    Image.fromarray(values).save(tmp_path / f"a.{suffix}", **options)
    photo = images.load_photo(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(photo.pixels, values / 255, atol=1e-7 if suffix != "avif" else 4 / 255)


@pytest.mark.parametrize("suffix", ["webp", "bmp"])
def test_other_formats_that_are_cut_short_are_refused_before_work(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (12, 20, 3), np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:-20])
    with refused(path.name, "cut short"):
        images.header(path)
