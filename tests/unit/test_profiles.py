"""Colour spaces of photographs: profiles of PNG and JPEG, and primaries of EXR."""

import io
import struct

import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageCms

from iif_core.numerics.color import REC709_PRIMARIES, linear_from_srgb, rec709_from_primaries, srgb_from_linear
from tests.errors import refused
from tests.unit import own_scene as own
from workflow.sources.folder_scene import images

P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), (0.3127, 0.3290))
ACES = ((0.7347, 0.2653), (0.0, 1.0), (0.0001, -0.077), (0.32168, 0.33767))

P3_TO_REC709 = np.array([[1.22494, -0.22494, 0.0], [-0.04206, 1.04206, 0.0], [-0.01964, -0.07864, 1.09828]])
"""As published: Display P3 and sRGB share their white."""


def profile(matrix, gamma, name, space=b"RGB "):
    """An ICC profile, version 2, of primaries as XYZ columns adapted to D50, and a power curve for all channels."""
    text = name.encode() + b"\0"
    xyz = {tag: b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(v * 65536) for v in column)) for tag, column in matrix.items()}
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256)) + b"\0\0"
    words = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + b"\0" * 78
    tags = {b"desc": words, b"cprt": b"text\0\0\0\0none\0", **xyz} | dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    at, table, data = 128 + 4 + 12 * len(tags), b"", b""
    for tag, content in tags.items():
        content += b"\0" * (-len(content) % 4)
        table += tag + struct.pack(">II", at + len(data), len(content))
        data += content
    size = at + len(data)
    head = struct.pack(">I4sI4s4s4s", size, b"lcms", 0x02400000, b"mntr", space, b"XYZ ") + b"\0" * 12 + b"acsp" + b"\0" * 28
    head += struct.pack(">3i", 63190, 65536, 54061)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


def d50_columns(primaries):
    """XYZ of red, green and blue at D50, from what is known of sRGB there (IEC 61966-2-1, adapted by Bradford)."""
    srgb = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
    columns = srgb @ rec709_from_primaries(primaries)
    return dict(zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns.T, strict=True)) | {b"wtpt": np.array([0.9642, 1.0, 0.8249])}


WIDE = profile(d50_columns(P3), 2.2, "Display P3 of a test")
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def stored(path, pixels, icc):
    Image.fromarray(pixels).save(path, icc_profile=icc, **({"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {}))
    return path


def colours():
    values = np.array([40, 100, 128, 160, 220], np.uint8)
    return np.stack(np.meshgrid(values, values, values, indexing="ij"), -1).reshape(5, 25, 3)


def test_the_matrix_of_display_p3_is_the_published_one():
    np.testing.assert_allclose(rec709_from_primaries(P3), P3_TO_REC709, atol=2e-4)
    np.testing.assert_allclose(rec709_from_primaries(REC709_PRIMARIES), np.eye(3), atol=1e-12)


def test_white_of_any_primaries_stays_white():
    for primaries in (P3, (*P3[:3], (0.32168, 0.33767)), (*P3[:3], (0.3457, 0.3585))):
        np.testing.assert_allclose(rec709_from_primaries(primaries).sum(1), 1, atol=1e-12)


def test_primaries_outside_of_all_colours_are_allowed():
    """Blue of ACES AP0 lies below the axis; its white is adapted to that of Rec. 709."""
    published = [[2.52169, -1.13413, -0.38756], [-0.27648, 1.37272, -0.09624], [-0.01538, -0.15298, 1.16835]]
    np.testing.assert_allclose(rec709_from_primaries(ACES), published, atol=3e-4)


@pytest.mark.parametrize(
    "primaries", [((0.1, 0.1), (0.2, 0.2), (0.3, 0.3), (0.31, 0.33)), (*P3[:3], (0.3, 0.0)), (*P3[:3], (0.3, np.nan)), P3[:3]]
)
def test_primaries_that_span_no_colours_are_refused(primaries):
    with refused():
        rec709_from_primaries(primaries)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_colours_of_a_wide_space_become_those_of_srgb(tmp_path, suffix):
    pixels = colours()
    photo = images.load_photo(stored(tmp_path / f"a{suffix}", pixels, WIDE))
    linear = (pixels / 255.0) ** 2.2 @ P3_TO_REC709.T
    np.testing.assert_allclose(photo.pixels, srgb_from_linear(np.clip(linear, 0, 1)), atol=(3 if suffix == ".png" else 6) / 255)
    assert photo.form == "in Display P3 of a test"
    assert np.abs(photo.pixels - pixels / 255.0).max() > 0.05  # read as they are they would be other colours


def test_greys_and_white_stay_where_they_are(tmp_path):
    grey = np.repeat(np.array([[0, 60, 128, 200, 255]], np.uint8)[..., None], 3, -1)
    photo = images.load_photo(stored(tmp_path / "a.png", grey, profile(d50_columns(P3), 2.2, "P3")))
    assert np.ptp(photo.pixels, axis=-1).max() <= 2 / 255
    assert (photo.pixels[0, -1] == 1).all() and (photo.pixels[0, 0] == 0).all()  # saturated stays saturated


def test_a_profile_of_srgb_changes_nothing(tmp_path):
    pixels = colours()
    plain, tagged = (images.load_photo(stored(tmp_path / f"{n}.png", pixels, icc)) for n, icc in (("a", None), ("b", SRGB)))
    np.testing.assert_array_equal(plain.pixels, tagged.pixels)
    assert tagged.form == ""


def test_transparency_is_kept(tmp_path):
    pixels = np.concatenate([colours(), np.full((5, 25, 1), 255, np.uint8)], -1)
    pixels[0, 0, 3] = 0
    photo = images.load_photo(stored(tmp_path / "a.png", pixels, WIDE))
    assert photo.transparent == 1 and not photo.valid[0, 0] and photo.valid[1:].all()


def test_masks_ids_and_grey_pictures_are_read_as_they_are(tmp_path):
    ids = np.arange(20, dtype=np.uint8).reshape(4, 5)
    Image.fromarray(ids).save(tmp_path / "ids.png", icc_profile=WIDE)
    np.testing.assert_array_equal(images.load_ids(tmp_path / "ids.png"), ids)
    np.testing.assert_array_equal(images.load_photo(tmp_path / "ids.png").pixels[..., 0], np.float32(ids) / np.float32(255))


def sixteen_bits(path, icc):
    """A PNG of 16 bits with a profile, which Pillow cannot write."""
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + np.full((4, 3), 30000, ">u2").tobytes() for _ in range(4))
    head = struct.pack(">IIBBBBB", 4, 4, 16, 2, 0, 0, 0)
    named = chunk(b"iCCP", b"p\0\0" + zlib.compress(icc))
    parts = [chunk(b"IHDR", head), named, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def test_a_wide_space_of_16_bits_is_refused_and_srgb_is_not(tmp_path):
    with refused(tmp_path / "a.png", "Display P3 of a test", "sRGB", "16"):
        images.load_photo(sixteen_bits(tmp_path / "a.png", WIDE))
    photo = images.load_photo(sixteen_bits(tmp_path / "b.png", SRGB))
    np.testing.assert_allclose(photo.pixels, 30000 / 65535, atol=1e-6)


@pytest.mark.parametrize("icc", [b"no profile at all", profile(d50_columns(P3), 2.2, "grey", b"GRAY"), WIDE[:200]])
def test_a_profile_that_cannot_be_read_is_refused(tmp_path, icc):
    with refused(tmp_path / "a.png", "sRGB"):
        images.load_photo(stored(tmp_path / "a.png", colours(), icc))


def exr(path, values, chromaticities):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if chromaticities is not None:
        header["chromaticities"] = tuple(float(v) for pair in chromaticities for v in pair)
    channels = {name: np.ascontiguousarray(values[..., i], np.float32) for i, name in enumerate("RGB")}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def test_linear_colours_of_other_primaries_are_converted(tmp_path):
    values = np.random.default_rng(0).uniform(0.2, 3.0, (6, 7, 3)).astype(np.float32)
    wide = images.load_photo(exr(tmp_path / "a.exr", values, P3))
    np.testing.assert_allclose(wide.pixels, np.maximum(values @ P3_TO_REC709.T, 0), atol=3e-3)
    assert wide.form == "of other primaries"
    for name, primaries in (("b.exr", None), ("c.exr", REC709_PRIMARIES)):
        same = images.load_photo(exr(tmp_path / name, values, primaries))
        np.testing.assert_array_equal(same.pixels, values)
        assert same.form == ""


def test_primaries_of_an_exr_that_span_nothing_name_the_file(tmp_path):
    with refused(tmp_path / "a.exr", "chromaticities"):
        images.load_photo(exr(tmp_path / "a.exr", np.ones((2, 2, 3)), [(0.3, 0.3)] * 4))


def test_the_capture_says_which_photographs_were_converted(tmp_path):
    path = own.project(tmp_path)
    document, _ = own.photographed(path)
    name = path / document["frames"][0]["file_path"]
    plain = np.asarray(Image.open(name))
    stored(name, plain, WIDE)
    notes = own.run(tmp_path, "capture").facts["notes"]
    assert any("1 in Display P3 of a test" in note for note in notes)


def test_the_oracle_itself(tmp_path):
    """The profile of these tests says what it should to Pillow alone: red of P3 lies outside of sRGB, and is cut off there."""
    transform = ImageCms.buildTransform(ImageCms.ImageCmsProfile(io.BytesIO(WIDE)), ImageCms.createProfile("sRGB"), "RGB", "RGB")
    red = np.asarray(ImageCms.applyTransform(Image.new("RGB", (1, 1), (200, 0, 0)), transform))[0, 0]
    expected = srgb_from_linear(np.clip((200 / 255) ** 2.2 * P3_TO_REC709[:, 0], 0, 1)) * 255
    np.testing.assert_allclose(red, expected, atol=3)
    assert linear_from_srgb(red[0] / 255) > (200 / 255) ** 2.2
