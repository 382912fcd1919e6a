"""The door for files from strangers: names, limits before memory, and one message for whatever a parser throws."""

import os
import struct
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from iif_core.errors import InputError
from lab.sources import mitsuba
from tests.errors import missing, refused
from tests.lab.test_mitsuba_source import ROOM, write
from tests.unit import own_scene as own
from workflow.artifacts.files import inside
from workflow.intake import limits
from workflow.intake.arrays import read_npy
from workflow.intake.documents import parse_json, read_json, read_text, reading
from workflow.intake.names import LONGEST, fault_of_name, same_name, shown
from workflow.intake.pictures import check_texture, opened
from workflow.relighting.inserts import load_insert
from workflow.runtime.fingerprint import raw_inputs
from workflow.scene.response_file import read_response_file
from workflow.settings.yaml_file import read_yaml
from workflow.sources.folder_scene import images, mesh, transforms

BAD_NAMES = ("", " ", ".", "..", ".x", "a/b", "a\\b", "a\0b", "a\nb", "a\x1b[31m", "\u202egpj", "\ud800", "x" * (LONGEST + 1))


def refuses(action, *names):
    with refused(*names) as caught:
        action()
    assert str(caught.value).replace("\n", "").isprintable()


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_become_no_files(tmp_path, name):
    assert fault_of_name(name)
    if name not in ("a/b", "x" * (LONGEST + 1)):  # a folder and a file; and longer than the name of a view, but not of a file
        with refused(repr(name)):
            inside(tmp_path, name)


def test_names_that_do():
    for name in ("000", "DSC 0001 (2)", "Küche", "写真", "a.b", "x" * LONGEST, "Screenshot 10.31\u202fAM"):
        assert not fault_of_name(name)
    assert same_name("STRASSE.A") == same_name("straße.a") and same_name("a\u0308") == same_name("\u00e4") != same_name("a")
    assert len(shown("x" * 5000)) == 80 and "bits" in shown(10**400)


def test_keys_of_the_readers_are_never_taken_from_a_file(tmp_path):
    """A file that sets `_name` wrote wherever it said; none of these keys reaches a reader."""
    document = own.bare(tmp_path)
    evil = {"_name": "../../../escaped/evil", "_mask": "/etc/passwd", "_split": "test", "_seen": [[0, 0, 0]], "_mask_full": True}
    for i, entry in enumerate(document["frames"]):
        entry |= {**evil, "_name": f"{evil['_name']}{i}"}
    own.write_transforms(tmp_path, document)
    tree = own.settings_of(tmp_path)
    frames = transforms.read(tree["source"], tree["capture"]).frames
    assert [f.name for f in frames] == ["000", "001", "002"]
    assert all(f.mask is None and f.split is None and f.seen is None and not f.mask_full for f in frames)


def test_a_message_does_not_steer_a_terminal():
    assert str(InputError("a\x1b[2J\x07b\u202ec\nd ü")) == "a\\x1b[2J\\x07b\\u202ec\nd ü"


# ------------------------------------------------------------------------------------------------------------ documents


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (b"", ["JSON"]),
        ("{}".encode("utf-16"), ["UTF-16", "UTF-8"]),
        (b"\xff{}", ["byte 0", "UTF-8"]),
        (b"[" * 100_000, ["JSON"]),
        (b'{"a": 1, "a": 2}', ["'a'"]),
        (b"[" + b"9" * 400 + b"]", [400]),
    ],
)
def test_documents(tmp_path, data, names):
    (tmp_path / "x.json").write_bytes(data)
    refuses(lambda: read_json(tmp_path / "x.json"), tmp_path / "x.json", *names)


def test_files_that_are_none(tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_bytes(bytes(10))
    refuses(lambda: read_text(tmp_path / "folder"), tmp_path / "folder")
    refuses(lambda: read_text(tmp_path / "pipe"), tmp_path / "pipe")
    refuses(lambda: read_text(tmp_path / "nowhere"), tmp_path / "nowhere")
    refuses(lambda: read_text(tmp_path / "large", 9), tmp_path / "large", 10, 9)
    refuses(lambda: read_text(tmp_path / ("x" * 300)), tmp_path / ("x" * 300))
    assert parse_json(tmp_path, "[1, NaN]")[0] == 1


@pytest.mark.parametrize("error", [MemoryError(), RecursionError(), OSError(5, "x"), KeyError("a"), UnicodeError("b")])
def test_whatever_a_parser_throws_is_one_message(tmp_path, error):
    def fail():
        with reading(tmp_path, "cannot be read"):
            raise error

    refuses(fail, tmp_path)


@pytest.mark.parametrize("text", ["[" * 900_000, "- " * 400_000 + "x", "{a: " * 100_000])
def test_deep_settings_do_not_kill_the_process(tmp_path, text):
    """libyaml composes by recursion in C. This runs in a separate process, because without the check a signal would end it."""
    (tmp_path / "x.yaml").write_text(text)
    code = "import sys, pathlib\nfrom workflow.settings.yaml_file import read_yaml\nread_yaml(pathlib.Path(sys.argv[1]))"
    run = subprocess.run([sys.executable, "-c", code, tmp_path / "x.yaml"], capture_output=True, text=True)
    assert run.returncode == 1 and not missing(run.stderr, "x.yaml", 32)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("x: &x [*x]", ["anchors", 32]),
        ("\n".join(f"k{i}: 1" for i in range(40_000)), [20000]),
        ("a: 2026-02-30", ["YAML"]),
        ("a: 1e308", ["line 1", "1e308", "1e+12"]),
        ("a: .nan", ["nan", "1e+12"]),
        (f"a: {'9' * 400}", ["9" * 40, "1e+12"]),
        (f"a: {'x' * 5000}", ["line 1", 5000, 4096]),
        ('a: "\\0"', ["line 1", "byte"]),
        ("? [a]\n: 1", ["line 1", "key"]),
        ("a: 1\na: 2", ["line 2", "`a`"]),
        ("a: !!python/object/apply:os.system [true]", ["line 1", "python/object/apply:os.system"]),
    ],
)
def test_settings(tmp_path, text, names):
    (tmp_path / "x.yaml").write_text(text)
    refuses(lambda: read_yaml(tmp_path / "x.yaml"), tmp_path / "x.yaml", *names)


@pytest.mark.parametrize("path", ["x" * 300, "/", "/dev/zero", "x/" * 1500, "a\0b"])
def test_paths_of_settings_that_no_disk_has(tmp_path, path):
    tree = own.settings_of(tmp_path, {"path": path})
    for document in (tree, {**tree, "affines": {**tree["affines"], "response": {"file": path}}}):
        stage = "capture" if document is tree else "emission"
        refuses(lambda document=document, stage=stage: raw_inputs(stage, document))


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is unreadable for root")
def test_unreadable_files(tmp_path):
    own.bare(tmp_path)
    (tmp_path / "transforms.json").chmod(0)
    refuses(lambda: raw_inputs("capture", own.settings_of(tmp_path)), "transforms.json", "Permission denied")


# ------------------------------------------------------------------------------------------------- pictures, arrays, meshes


@pytest.mark.parametrize("start", [b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", b"GIF89a\x01\0\x01\0\0\0\0"])
def test_only_the_readers_of_photographs_are_open(tmp_path, start):
    (tmp_path / "x.png").write_bytes(start)
    refuses(lambda: images.header(tmp_path / "x.png"), tmp_path / "x.png", "PNG, JPEG")


def test_photographs_convert_in_strips(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (37, 23, 4), dtype=np.uint8)).save(tmp_path / "x.png")
    whole = images.load_photo(tmp_path / "x.png")
    reduced = images.reduce_area(whole.pixels, whole.valid, 7, 5)
    monkeypatch.setattr(images, "STRIP_PIXELS", 50)
    strips = images.load_photo(tmp_path / "x.png")
    assert (strips.pixels == whole.pixels).all() and (strips.valid == whole.valid).all()
    assert strips.transparent == whole.transparent > 0
    for a, b in zip(images.reduce_area(strips.pixels, strips.valid, 7, 5), reduced, strict=True):
        assert (a == b).all()


def test_arrays(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros(3))
    (tmp_path / "a.npz").rename(tmp_path / "z.npy")
    np.save(tmp_path / "o.npy", np.array([{}], object), allow_pickle=True)
    np.save(tmp_path / "a.npy", np.zeros((3, 4)))
    data = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "l.npy").write_bytes(data.replace(b"(3, 4), }          ", b"(3, 4000000000), } "))
    refuses(lambda: read_npy(tmp_path / "z.npy"), "z.npy", ".npz", "np.save")
    refuses(lambda: read_npy(tmp_path / "o.npy"), "o.npy", "object")
    refuses(lambda: read_npy(tmp_path / "l.npy"), "l.npy", len(data), "(3, 4000000000)")
    assert read_npy(tmp_path / "a.npy").shape == (3, 4)


def test_response_tables_with_lists_or_too_many_rows(tmp_path, monkeypatch):
    import pyarrow
    import pyarrow.parquet

    x = np.linspace(0, 1, 9)
    table = {"x": x, "R": [[v, v] for v in x], "G": x, "B": x}
    pyarrow.parquet.write_table(pyarrow.table(table), tmp_path / "r.parquet")
    refuses(lambda: read_response_file(tmp_path / "r.parquet"), "r.parquet", "column R")
    pyarrow.parquet.write_table(pyarrow.table({**table, "R": x}), tmp_path / "r.parquet")
    read_response_file(tmp_path / "r.parquet")
    monkeypatch.setattr(limits, "TABLE_ROWS", 8)
    refuses(lambda: read_response_file(tmp_path / "r.parquet"), "r.parquet", 9)


@pytest.mark.parametrize("line", ["4 0 1 2 3", "255 0 1 2", "3 0 1 99", "3 -1 0 1", "0"])
def test_ragged_faces(tmp_path, line):
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(tmp_path / "m.ply", vertices, faces)
    lines = (tmp_path / "m.ply").read_text().split("\n")
    lines[-2] = line
    (tmp_path / "m.ply").write_text("\n".join(lines))
    try:
        found = mesh.load(tmp_path / "m.ply", 1.0)
    except InputError:
        return
    assert found.faces.max() < len(found.vertices)


def glb(path, change):
    """A box whose JSON `change` has changed."""
    path.write_bytes(trimesh.creation.box().export(file_type="glb"))
    own.rewrite_glb(path, change)
    return path


def test_glb_that_announces_more_than_it_holds(tmp_path):
    def endless(document):
        document["accessors"][0] = {"componentType": 5126, "type": "VEC3", "count": 10**9}

    def repeated(document):
        document["nodes"] = [{"mesh": 0}] * 2000
        document["scenes"] = [{"nodes": list(range(2000))}]

    data = bytearray(glb(tmp_path / "d.glb", lambda document: None).read_bytes())
    struct.pack_into("<I", data, 20 + struct.unpack_from("<I", data, 12)[0], 1 << 31)  # the length of the second part
    (tmp_path / "d.glb").write_bytes(data)
    refuses(lambda: load_insert(tmp_path / "d.glb"), "d.glb", 2147483648)
    refuses(lambda: load_insert(glb(tmp_path / "a.glb", endless)), "a.glb", "accessor 0", 1000000000)
    load_insert(glb(tmp_path / "b.glb", lambda document: None))
    glb(tmp_path / "c.glb", repeated)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "INSERT_FACES", 10_000)
        refuses(lambda: load_insert(tmp_path / "c.glb"), "c.glb", "nodes")


def test_colmap_counts(tmp_path):
    from workflow.sources.folder_scene import colmap

    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24)
    image = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0"
    points = struct.pack("<Q", 0)
    for number, files in enumerate(
        (
            (struct.pack("<Q", 10**9), struct.pack("<Q", 1) + image + struct.pack("<Q", 0), points),
            (cameras, struct.pack("<Q", 2**63) + image, points),
            (cameras, struct.pack("<Q", 1) + image + struct.pack("<Q", 10**18), points),
            (cameras, struct.pack("<Q", 1) + image + struct.pack("<Q", 0), struct.pack("<Q", 10**9)),
        )
    ):
        for part, data in zip(colmap.PARTS, files, strict=True):
            (tmp_path / f"{part}.bin").write_bytes(data)
        refused(
            lambda: colmap.read(tmp_path),
            f"{colmap.PARTS[(0, 1, 1, 2)[number]]}.bin: not a COLMAP file, or cut short .* announced",
        )


# ------------------------------------------------------------------------------------------------------- Mitsuba scenes


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<include filename="scene.xml"/>' * 20, "includes? itself|levels deep"),
        ("<shape>" * 3000 + "</shape>" * 3000, "nested more than 64 levels"),
        (
            "".join(f'<default name="{"a" * i}" value="{("$" + "a" * (i - 1)) * 2}"/>' for i in range(40, 1, -1))
            + f'<string name="filename" value="${"a" * 40}"/>',
            "more than 4096 characters",
        ),
        ('<string name="filename" value="' + "x" * 300 + '"/>', "cannot be used|not there"),
        ("<default/>" * 300_000, "more than 200000 elements"),
    ],
)
def test_scenes_that_grow(tmp_path, body, words):
    write(tmp_path, ROOM + body)
    refused(lambda: mitsuba.raw_inputs({"source": {"path": str(tmp_path / "scene.xml")}}), words)


@pytest.mark.parametrize("kind", ["png", "jpg", "bmp", "tga", "ppm"])
def test_textures_of_every_kind_are_opened(tmp_path, kind):
    path = tmp_path / f"t.{kind}"
    Image.new("RGB", (4, 4), (9, 90, 200)).save(path)
    check_texture(path)


def test_two_pictures_in_one_file_of_a_telephone_are_a_photograph(tmp_path):
    first, second = (Image.new("RGB", (4, 4), (value, 0, 0)) for value in (9, 200))
    path = tmp_path / "t.jpg"
    first.save(path, "MPO", save_all=True, append_images=[second])
    with opened(path) as image:
        assert image.format == "MPO" and image.size == (4, 4)


def test_a_picture_of_another_format_than_it_says_is_named(tmp_path):
    path = tmp_path / "t.jpg"
    path.write_bytes(b"GIF89a" + bytes(100))
    with refused("t.jpg", "PNG, JPEG"), opened(path):
        pass


def test_textures_of_scenes_have_a_limit(tmp_path, monkeypatch):
    own.save_png(tmp_path / "t.png", np.zeros((10, 10, 3)))
    write(tmp_path, ROOM + '<texture type="bitmap"><string name="filename" value="t.png"/></texture>')
    tree = {"source": {"path": str(tmp_path / "scene.xml")}}
    assert len(mitsuba.raw_inputs(tree)) == 2
    monkeypatch.setattr(limits, "PICTURE_PIXELS", 99)
    refuses(lambda: mitsuba.raw_inputs(tree), "t.png", "10x10")
