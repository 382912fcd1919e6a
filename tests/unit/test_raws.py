"""Raw files: planted colours come back linear in Rec. 709, whatever the picture, and as the file says the lens is."""

import struct

import numpy as np
import pytest
import tifffile
from PIL import Image

from iif_core.numerics.color import linear_from_srgb
from tests.errors import refused
from tests.unit import own_scene as own
from workflow.intake import raws
from workflow.sources import photographs
from workflow.sources.folder_scene import entries, images

XYZ_FROM_REC709 = np.array([[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07217], [0.01933, 0.11919, 0.95030]])
CAMERA_FROM_XYZ = np.array([[0.9, -0.2, -0.1], [-0.4, 1.2, 0.2], [-0.05, 0.15, 0.6]])
"""A sensor that is like none in particular."""
BLACK, WHITE = 64, 4095
COLOURS = np.array([[0.8, 0.8, 0.8], [0.5, 0.1, 0.1], [0.1, 0.5, 0.2], [0.1, 0.15, 0.6], [0.04, 0.03, 0.05], [0.3, 0.3, 0.05]])
HEIGHT, WIDTH, PATCH = 96, 126, 21


def chart(level=1.0):
    return np.repeat(np.repeat(COLOURS * level, PATCH, 0)[None], HEIGHT, 0)


def patches(pixels):
    return np.array([pixels[20:-20, i * PATCH + 7 : (i + 1) * PATCH - 7].mean((0, 1)) for i in range(len(COLOURS))])


def rational(values, scale=10000):
    return tuple(number for value in np.ravel(values) for number in (round(float(value) * scale), scale))


def save_dng(path, linear, mosaic=True, orientation=1, gain=None, opcodes=None, crop=None, make="Planted"):
    """Write what a sensor of `CAMERA_FROM_XYZ` records of linear Rec. 709 colours, white at 1 saturating its strongest channel.

    gain: (H, W) or (H, W, 3) by which the lens darkens; opcodes: {tag: bytes}.
    """
    camera = linear @ (CAMERA_FROM_XYZ @ XYZ_FROM_REC709).T
    neutral = (CAMERA_FROM_XYZ @ XYZ_FROM_REC709).sum(1)
    light = camera / neutral.max() * (1 if gain is None else gain)
    stored = np.clip(np.rint(BLACK + light * (WHITE - BLACK)), 0, WHITE).astype(np.uint16)
    planes = 1 if mosaic else 3
    tags = [
        (50706, 1, 4, bytes([1, 4, 0, 0]), True),
        (50708, 2, 0, "Planted", True),
        (50721, 10, 9, rational(CAMERA_FROM_XYZ), True),
        (50778, 3, 1, 21, True),
        (50728, 5, 3, rational(neutral / neutral.max() * (1.0, 0.9, 0.5)), True),  # what the camera took for white: a warm lamp
        (50714, 3, planes, (BLACK,) * planes, True),
        (50717, 4, planes, (WHITE,) * planes, True),
        (274, 3, 1, orientation, True),
        (271, 2, 0, make, True),
        (272, 2, 0, "Camera 1", True),
    ]
    if crop:
        tags += [(50719, 4, 2, crop[:2], True), (50720, 4, 2, crop[2:], True)]
    tags += [(tag, 7, len(data), data, True) for tag, data in (opcodes or {}).items()]
    if mosaic:
        tags += [(33421, 3, 2, (2, 2), True), (33422, 1, 4, bytes([0, 1, 1, 2]), True)]
        out = stored[..., 1].copy()
        out[::2, ::2], out[1::2, 1::2] = stored[::2, ::2, 0], stored[1::2, 1::2, 2]
        tifffile.imwrite(path, out, photometric=32803, extratags=tags, metadata=None)
    else:
        tifffile.imwrite(path, stored, photometric=34892, planarconfig="contig", extratags=tags, metadata=None)
    return path


def opcode_list(*opcodes):
    """Opcodes (number, flags, parameters) as a DNG holds them."""
    body = b"".join(struct.pack(">4I", number, 0x01030000, flags, len(data)) + data for number, flags, data in opcodes)
    return struct.pack(">I", len(opcodes)) + body


def gain_map(gains, top=0, left=0, pitch=1, plane=0, planes=1):
    down, across = gains.shape
    area = struct.pack(">10I", top, left, HEIGHT, WIDTH, plane, planes, pitch, pitch, down, across)
    grid = struct.pack(">4dI", 1 / (down - 1), 1 / (across - 1), 0.0, 0.0, 1)
    return 9, 1, area + grid + gains.astype(">f4").tobytes()


@pytest.mark.parametrize("mosaic", [True, False])
def test_planted_colours_come_back(tmp_path, mosaic):
    photo = images.load_photo(save_dng(tmp_path / "a.dng", chart(), mosaic))
    found = patches(linear_from_srgb(photo.pixels))
    scale = found[0].mean() / COLOURS[0].mean()
    assert 0.97 < scale < 1.01 and photo.form == "raw" and photo.valid.all()
    np.testing.assert_allclose(found / scale, COLOURS, atol=2e-3)


def test_no_level_follows_the_picture(tmp_path):
    """All are developed by the same constants: half the light is half the value, with and without something bright."""
    bright = chart()
    bright[:10] = 4.0
    files = [(chart(), "a"), (chart(0.5), "b"), (bright, "c"), (chart(0.02), "d")]
    a, b, c, d = (patches(linear_from_srgb(images.load_photo(save_dng(tmp_path / f"{n}.dng", v)).pixels)) for v, n in files)
    np.testing.assert_allclose(b / a, 0.5, rtol=0.03)
    np.testing.assert_allclose(c, a, rtol=1e-3)
    np.testing.assert_allclose(d[:4].mean() / a[:4].mean(), 0.02, rtol=0.05)


def test_what_saturates_is_one(tmp_path):
    photo = images.load_photo(save_dng(tmp_path / "a.dng", np.full((HEIGHT, WIDTH, 3), 3.0)))
    assert photo.pixels.min() > 0.99 and photo.pixels.max() <= 1


def test_orientation_turns_it(tmp_path):
    path = save_dng(tmp_path / "a.dng", chart(), orientation=6)
    header = images.header(path)
    assert header.size == (WIDTH, HEIGHT) and header.orientation == 6
    upright = images.load_photo(path, header.orientation)
    assert upright.pixels.shape == (WIDTH, HEIGHT, 3)
    np.testing.assert_array_equal(upright.pixels, images.load_photo(path).pixels.swapaxes(0, 1)[:, ::-1])


def test_the_border_of_the_sensor_is_left_out(tmp_path):
    """As JPEGs of the camera leave it out, by which other programs found the cameras."""
    whole, crop = chart(), (4, 6, WIDTH - 10, HEIGHT - 8)
    path = save_dng(tmp_path / "a.dng", whole, crop=crop)
    assert images.header(path).size == crop[2:]
    plain = images.load_photo(save_dng(tmp_path / "b.dng", whole)).pixels
    np.testing.assert_array_equal(images.load_photo(path).pixels, plain[6 : 6 + crop[3], 4 : 4 + crop[2]])
    small = save_dng(tmp_path / "c.dng", whole, crop=(4, 6, WIDTH // 2, HEIGHT // 2))  # no border
    assert images.header(small).size == (WIDTH, HEIGHT)


def falloff():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    y, x = y / (HEIGHT - 1), x / (WIDTH - 1)
    return 1 / (1 + 1.5 * x + 0.5 * y)  # what a map of 2 x 2 points undoes exactly


@pytest.mark.parametrize("mosaic", [True, False])
def test_a_gain_map_undoes_the_fall_of_light(tmp_path, mosaic):
    gains = np.array([[1.0, 2.5], [1.5, 3.0]])
    of = [(0, 0), (0, 1), (1, 0), (1, 1)] if mosaic else [None]
    maps = [gain_map(gains, *at, pitch=2) for at in of] if mosaic else [gain_map(gains, planes=3)]
    # Every second pixel from (top, left), as telephones write one map for each colour of the mosaic.
    path = save_dng(tmp_path / "a.dng", chart(), mosaic, gain=falloff()[..., None], opcodes={51009: opcode_list(*maps)})
    plain = save_dng(tmp_path / "b.dng", chart(), mosaic)
    found, wanted = (patches(linear_from_srgb(images.load_photo(p).pixels)) for p in (path, plain))
    np.testing.assert_allclose(found, wanted, atol=4e-3)


def test_a_gain_map_of_one_colour_touches_no_other(tmp_path):
    path = save_dng(tmp_path / "a.dng", chart(), opcodes={51009: opcode_list(gain_map(np.full((2, 2), 2.0), 0, 0, 2))})
    one, other = (np.zeros((HEIGHT, WIDTH)) for _ in range(2))
    gain = raws.corrections(path).mosaic[0]
    one[gain.rows, gain.columns] = gain.over(HEIGHT, WIDTH)[..., 0]
    other[::2, ::2] = 2.0
    np.testing.assert_array_equal(one, other)


def test_a_gain_map_lies_where_it_says():
    """Bilinear between its points, and beyond them as at the last."""
    gains = np.array([[1.0, 2.0, 4.0], [3.0, 5.0, 6.0]])[..., None]
    found = raws.GainMap(slice(1, 11, 2), slice(0, 21), slice(0, 1), gains, (0.5, 0.25), (0.25, 0.1)).over(11, 21)[..., 0]
    y, x = np.arange(11)[1:11:2] / 10, np.arange(21) / 20
    rows = [np.interp(x, [0.1, 0.35, 0.6], row) for row in gains[..., 0]]
    expected = [np.interp(at, [0.25, 0.75], column) for at in y for column in np.transpose(rows)]
    np.testing.assert_allclose(found, np.reshape(expected, (5, 21)), rtol=1e-12)


def test_a_vignette_is_the_polynomial_of_the_standard(tmp_path):
    k, centre = (0.5, 0.25, 0.125, 0.0625, 0.03125), (0.4, 0.6)
    path = save_dng(tmp_path / "a.dng", chart(), opcodes={51022: opcode_list((3, 1, struct.pack(">7d", *k, *centre)))})
    (found,) = raws.corrections(path).picture
    factor = found.over(HEIGHT, WIDTH)
    x, y = (WIDTH - 1) * 0.4, (HEIGHT - 1) * 0.6
    far = np.hypot(WIDTH - 1 - x, y)  # the upper right corner
    for row, column in [(0, 0), (50, 70), (0, WIDTH - 1), (95, 3)]:
        r = np.hypot(column - x, row - y) / far
        assert factor[row, column] == pytest.approx(1 + sum(c * r ** (2 * (i + 1)) for i, c in enumerate(k)), rel=1e-12)
    plain = images.load_photo(save_dng(tmp_path / "b.dng", chart())).pixels
    pixels = linear_from_srgb(images.load_photo(path).pixels)
    np.testing.assert_allclose(pixels, np.minimum(linear_from_srgb(plain) * factor[..., None], 1), atol=2e-4)


def test_distortion_that_is_left_in_is_told(tmp_path):
    path = save_dng(tmp_path / "a.dng", chart(), opcodes={51022: opcode_list((1, 1, b"\0" * 100), (4, 0, b""))})
    assert images.load_photo(path).form == images.BENT


@pytest.mark.parametrize(
    "opcodes",
    [
        {51009: opcode_list((7, 0, b""))},  # a table on the values, not optional
        {51009: b"\0\0\0\5"},
        {51009: opcode_list((9, 1, b"\0" * 76))},
        {51009: opcode_list(gain_map(np.array([[1.0, np.nan], [1.0, 1.0]])))},
        {51009: opcode_list(gain_map(np.array([[1.0, 1e9], [1.0, 1.0]])))},
    ],
)
def test_corrections_that_are_not_known_or_damaged_are_refused(tmp_path, opcodes):
    path = save_dng(tmp_path / "a.dng", chart(), opcodes=opcodes)
    with refused(path, "darktable"):
        images.load_photo(path)


@pytest.mark.parametrize("harm", ["empty", "text", "half", "jpeg"])
def test_what_is_no_raw_file_is_one_error(tmp_path, harm):
    path = save_dng(tmp_path / "a.dng", chart())
    if harm == "jpeg":
        Image.new("RGB", (64, 48)).save(path, format="JPEG")
    else:
        path.write_bytes({"empty": b"", "text": b"no raw file" * 50, "half": path.read_bytes()[:4000]}[harm])
    with refused(path):
        images.load_photo(path)


def test_a_developed_photograph_beside_its_raw_file_is_taken(tmp_path):
    for i in range(6):
        save_dng(tmp_path / f"{i}.DNG", chart())
        Image.new("RGB", (64, 48)).save(tmp_path / f"{i}.jpg")
    assert photographs.chosen(tmp_path, 100) == [f"{i}.jpg" for i in range(6)]
    (tmp_path / "3.jpg").unlink()
    names = [tmp_path / name for name in photographs.chosen(tmp_path, 100)]
    with refused("3.DNG", "0.jpg"):
        entries.one_range(tmp_path, names, "ldr")


def test_a_capture_of_raw_files_is_read(tmp_path):
    """The whole door, with photographs named without extension: what is written is what was photographed."""
    read = {}
    for name in ("raw", "plain"):
        folder = own.project(tmp_path / name)
        document, shots = own.photographed(folder, 3)
        for frame, (_, picture, _, _) in zip(document["frames"], shots, strict=True) if name == "raw" else ():
            path = folder / frame["file_path"]
            save_dng(path.with_suffix(".dng"), linear_from_srgb(picture), mosaic=False)
            path.unlink()
            frame["file_path"] = frame["file_path"].removesuffix(".png")
        own.write_transforms(folder, document)
        read[name] = own.run(tmp_path / name, "capture")
    for view in read["plain"].used:
        a, b = (linear_from_srgb(capture.photo(view)[0]) for capture in read.values())
        np.testing.assert_allclose(a, b * np.median(a / np.maximum(b, 1e-3)), atol=0.02)
    assert any("3 raw" in note for note in read["raw"].facts["notes"])
