"""Changes of valid files, chosen by a random generator: what breaks in transit, and what somebody who wants harm writes."""

from __future__ import annotations

import copy
import json
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

Random = np.random.Generator
NUMBERS = (
    *("0", "-1", "1", "2", "255", "256", "65535", "65536", "2147483647", "2147483648", "4294967295", "-2147483649"),
    *("1000000000", "1000000000000", "1000000000000000000", "9223372036854775807", "9223372036854775808", "18446744073709551615"),
    *("1e18", "1e30", "1e308", "-1e308", "1e-308", "1e999", "-1e999", "nan", "NaN", "inf", "-inf", "Infinity", "0.5", "-0.0"),
    *("9" * 400, "0x10", "1_000", "١٢", "1e", "--1", "", "null", "true"),
)
"""Numbers, and what is none."""
NAMES = (
    *(
        "../../../escaped/evil",
        "/tmp/evil",
        "/",
        ".",
        "..",
        "",
        " ",
        "a/../../b",
        "a\0b",
        "x" * 300,
        "x" * 5000,
        "a" * 1000 + "/b",
    ),
    *("CON", "000", "a\nb", "a\x1b[31mb", "\u202egpj.exe", "\ud800", "images/000.PNG", "images/../images/000.png", "\\\\host\\x"),
    *("~/x", "$HOME", "%s%n", "{0}", "images", "images/000.png/", "file:///etc/passwd", "/dev/zero", "/dev/stdin", ".hidden.png"),
)
"""Texts where a name belongs."""
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 10**18, 2**63, 2**64, 10**400, 1e308, -1e308, 1e-308, float("nan"), float("inf"), 0.5),
    *([], {}, [[]], [None], {"a": 1}, "", "x", [1, 2, 3], [[1, 2], [3]], "1", "nan", [1e308] * 4, [[1e308] * 4] * 4),
    *NAMES,
)
KEYS = (
    *("_name", "_mask", "_seen", "_split", "_mask_full", "_where", "_at", "__class__", "w", "h", "fl_x", "k1", "k4", "p1", "cx"),
    *("file_path", "mask_path", "depth_file_path", "depth_intrinsics", "camera_model", "is_fisheye", "camera_angle_x", "frames"),
    *("depth_unit_m", "pixel_centres_at", "train_filenames", "test_filenames", "test_frames", "kind", "path", "preset", "limits"),
    *("materials", "components", "relight", "", "<<", "a" * 3000),
)
YAML_LINES = (
    "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\nb: &b [*a, *a, *a, *a, *a, *a, *a, *a]\nc: &c [*b, *b, *b, *b, *b, *b, *b, *b]\n"
    "d: &d [*c, *c, *c, *c, *c, *c, *c, *c]\ne: &e [*d, *d, *d, *d, *d, *d, *d, *d]\nf: &f [*e, *e, *e, *e, *e, *e, *e, *e]\n"
    "relight: &g [*f, *f, *f, *f, *f, *f, *f, *f]\n",
    "x: &x [*x]\n",
    "x: &x {<<: *x}\n",
    "capture: {views: !!int x}\n",
    "title: 2026-02-30\n",
    "title: 2026-02-28\n",
    f"prior: {{samples: {'9' * 400}}}\n",
    "capture: {views: .inf}\n",
    "affines: {scale: .nan}\n",
    "capture: {views: 1e999}\n",
    "x: " + "[" * 3000 + "\n",
    "x: " + "[" * 3000 + "]" * 3000 + "\n",
    "[" * 900_000,
    "- " * 400_000 + "x\n",
    "x: " + "{a: " * 200 + "1" + "}" * 200 + "\n",
    "".join(f"k{i}: 1\n" for i in range(4000)),
    "capture: {" + ", ".join(f"k{i}: 1" for i in range(2000)) + "}\n",
    "source: {kind: folder, path: " + "x" * 5000 + "}\n",
    "source: {kind: folder, path: /}\n",
    "source: {kind: folder}\nsource: {kind: builtin}\n",
    "? [a, b]\n: 1\n",
    "? {a: 1}\n: 1\n",
    "!!python/object/apply:os.system ['true']\n",
    "x: !!binary notbase64!\n",
    "x: !!set {a, b}\n",
    "x: !!omap [a, b]\n",
    "x: !!timestamp y\n",
    "x: 1:2:3\n",
    "--- 1\n--- 2\n",
    "%YAML 9.9\n---\na: 1\n",
    "\t- a\n",
    'x: "\\x00"\n',
    "relight: {a: b}\n",
    "relight: [{name: ../../evil}]\n",
    "relight: [{name: a, exposure: 1e308, insert: [{file: /, position: [1e308, 0, 0]}]}]\n",
    "relight: [{name: a, environment: " + "y" * 5000 + ".exr}]\n",
    "relight: [{name: a, lamps: {? [1] : 2}}]\n",
)
XML_LINES = (
    '<include filename="scene.xml"/>' * 20,
    "<shape>" * 3000 + "</shape>" * 3000,
    "<a>" * 100_000,
    "".join(f'<default name="{"a" * i}" value="{"$" + "a" * (i - 1)}{"$" + "a" * (i - 1)}"/>' for i in range(40, 1, -1))
    + f'<string name="filename" value="${"a" * 40}"/>',
    '<string name="filename" value="/"/>',
    f'<string name="filename" value="{"x" * 5000}"/>',
    '<path value="/dev"/><string name="filename" value="zero"/>',
    "&lol;",
)
DOCTYPE = '<!DOCTYPE scene [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def pick(rng: Random, among: Any) -> Any:
    return among[int(rng.integers(len(among)))]


# ------------------------------------------------------------------------------------------------------------ any bytes


def flipped(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    out = bytearray(data or b"\0")
    for _ in range(int(rng.integers(1, 9))):
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def flipped_early(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """Bits of the header."""
    return flipped(rng, data[:128], []) + data[128:]


def cut(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def without_a_part(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    a, b = sorted(int(v) for v in rng.integers(0, len(data) + 1, 2))
    return data[:a] + data[b:]


def repeated(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    a, b = sorted(int(v) for v in rng.integers(0, len(data) + 1, 2))
    return data[:b] + data[a:b] * int(rng.integers(1, 5)) + data[b:]


def noisy(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return data[:at] + rng.bytes(int(rng.integers(1, 64))) + data[at + int(rng.integers(0, 64)) :]


def spliced(rng: Random, data: bytes, others: list[bytes]) -> bytes:
    other = pick(rng, others or [data])
    return data[: int(rng.integers(len(data) + 1))] + other[int(rng.integers(len(other) + 1)) :]


def extreme_word(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """A count or offset of 1, 2, 4 or 8 bytes becomes extreme, in the first bytes more often."""
    size, order = pick(rng, (1, 2, 4, 8)), pick(rng, "<>")
    value = pick(rng, (0, 1, 2, (1 << 8 * size) - 1, 1 << (8 * size - 1), (1 << (8 * size - 1)) - 1, 10**9 % (1 << 8 * size)))
    reach = len(data) if rng.random() < 0.5 else min(len(data), 64)
    at = int(rng.integers(max(1, reach - size)))
    return data[:at] + struct.pack(order + {1: "B", 2: "H", 4: "I", 8: "Q"}[size], value) + data[at + size :]


def empty(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    return pick(rng, (b"", b"\0", b"\n", b" " * 100, b"\xef\xbb\xbf" + data, b"version https://git-lfs.github.com/spec/v1\n"))


def utf16(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    return data.decode("latin-1").encode(pick(rng, ("utf-16", "utf-16-be", "utf-32", "utf-7", "cp037")))


def archive(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """Another format under the name of this one."""
    import gzip
    import io
    import zipfile

    kind = int(rng.integers(5))
    if kind == 0:
        return gzip.compress(data)
    if kind == 1:
        file = io.BytesIO()
        np.savez(file, a=np.zeros(3))
        return file.getvalue()
    if kind == 2:
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
            zipped.writestr("a", bytes(10_000_000))
        return file.getvalue()
    return pick(
        rng, (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", b"<svg/>", b"GIF89a\xff\xff\xff\xff\0\0\0", b"\x7fELF")
    )


BYTES = (
    flipped,
    flipped,
    flipped_early,
    cut,
    cut,
    without_a_part,
    repeated,
    noisy,
    spliced,
    extreme_word,
    extreme_word,
    empty,
    utf16,
)
ANY = (*BYTES, archive)

# ----------------------------------------------------------------------------------------------------------------- text

_NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


def numbers_replaced(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    text = data.decode("utf-8", "replace")
    places = list(_NUMBER.finditer(text))
    for place in sorted((pick(rng, places) for _ in range(int(rng.integers(1, 4))) if places), key=lambda m: -m.start()):
        text = text[: place.start()] + pick(rng, NUMBERS) + text[place.end() :]
    return text.encode("utf-8", "surrogatepass")


def lines_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        a, b = (int(v) for v in rng.integers(0, len(lines), 2))
        kind = int(rng.integers(4))
        if kind == 0:
            lines.insert(a, lines[b])
        elif kind == 1 and len(lines) > 1:
            del lines[a]
        elif kind == 2:
            lines[a], lines[b] = lines[b], lines[a]
        else:
            words = re.split(rb"([ \t,])", lines[a])
            words[int(rng.integers(len(words)))] = pick(rng, NAMES).encode("utf-8", "surrogatepass")
            lines[a] = b"".join(words)
        lines = lines or [b""]
    return b"\n".join(lines)


def long_line(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return (
        data[:at]
        + pick(rng, (b"9", b"x", b" ", b"[", b"\t", b"(", b"\n", b"$")) * int(pick(rng, (400, 5000, 100_000)))
        + data[at:]
    )


TEXT = (numbers_replaced, numbers_replaced, lines_changed, lines_changed, long_line)

# ------------------------------------------------------------------------------------------------------------ documents


def _places(tree: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    below = tree.items() if isinstance(tree, dict) else enumerate(tree[:50]) if isinstance(tree, list) else ()
    return [at, *(place for key, value in below for place in _places(value, (*at, key)))]


def tree_changed(rng: Random, tree: Any) -> Any:
    """Keys and values of a document: another type, extremes, missing, doubled, renamed, nested."""
    tree = copy.deepcopy(tree)
    for _ in range(int(rng.integers(1, 4))):
        places = [place for place in _places(tree) if place]
        if not places:
            return pick(rng, VALUES)
        *parents, key = pick(rng, places)
        node = tree
        for part in parents:
            node = node[part]
        kind = int(rng.integers(7))
        if kind == 0:
            del node[key]
        elif kind == 1 and isinstance(node, dict):
            node[pick(rng, KEYS)] = pick(rng, VALUES)
        elif kind == 2 and isinstance(node, dict):
            node[pick(rng, KEYS)] = node.pop(key)
        elif kind == 3 and isinstance(node, list):
            node.extend(copy.deepcopy(node[: int(rng.integers(1, 20))]))
        elif kind == 4:
            value: Any = node[key]
            for _ in range(int(pick(rng, (2, 20, 300)))):
                value = [value] if rng.random() < 0.7 else {"a": value}
            node[key] = value
        elif kind == 5 and isinstance(node[key], str):
            node[key] = pick(rng, (node[key].upper(), node[key] + "/../x", "../" * 5 + node[key], *NAMES))
        else:
            node[key] = pick(rng, VALUES)
    return tree


def json_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    tree = tree_changed(rng, json.loads(data))
    text = json.dumps(tree)
    if rng.random() < 0.1:
        text = pick(rng, ("[" * 100_000, '{"a":' * 50_000, text[:-1] + ', "frames": []}', text + text, "[" * 3000 + "]" * 3000))
    return text.encode("utf-8", "surrogatepass")


def manifest_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """Changed and sealed again, as somebody would who has read the source."""
    from workflow.artifacts import manifest

    tree = tree_changed(rng, json.loads(data))
    try:
        return manifest.text_of(tree).encode()
    except (ValueError, AttributeError, TypeError):
        return json.dumps(tree).encode("utf-8", "surrogatepass")


def yaml_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    if rng.random() < 0.3:
        line = pick(rng, YAML_LINES)
        return pick(rng, (line.encode(), line.encode() + data, data + line.encode()))
    try:
        return yaml.safe_dump(tree_changed(rng, yaml.safe_load(data)), sort_keys=False).encode("utf-8", "surrogatepass")
    except (ValueError, TypeError, yaml.YAMLError, RecursionError):
        return b"a: " + pick(rng, NUMBERS).encode()


def xml_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    if rng.random() < 0.3:
        line = pick(rng, XML_LINES).encode()
        if rng.random() < 0.2:
            return data.replace(b"<scene", (DOCTYPE + "]>").encode() + b"<scene", 1).replace(b"</scene>", b"&i;</scene>")
        return data.replace(b"</scene>", line + b"</scene>", 1)
    root = ElementTree.fromstring(data)
    every = list(root.iter())
    for _ in range(int(rng.integers(1, 4))):
        element, other = pick(rng, every), pick(rng, every)
        kind = int(rng.integers(4))
        if kind == 0:
            element.append(copy.deepcopy(other))
        elif kind == 1 and len(element):
            element.remove(element[int(rng.integers(len(element)))])
        elif kind == 2 and element.attrib:
            text = pick(rng, (*NAMES, *NUMBERS, "$a$b", "$folder" * 50))
            element.set(pick(rng, list(element.attrib)), re.sub(r"[^\t\n\x20-\ud7ff]", "", text))
        else:
            element.tag = pick(rng, ("include", "default", "path", "string", "shape", "scene", "alias", "x"))
    return ElementTree.tostring(root)


# ------------------------------------------------------------------------------------------------- headers of binary files


def png_header(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """Another size, depth or kind of colour, with a checksum that fits."""
    body = bytearray(data[12:29])
    if rng.random() < 0.6:
        body[4:12] = struct.pack(
            ">II", pick(rng, (0, 1, 16, 13_000, 65_535, 2**31 - 1)), pick(rng, (0, 1, 12, 13_000, 200_000, 2**31 - 1))
        )
    else:
        body[12 + int(rng.integers(5))] = pick(rng, (0, 1, 2, 3, 4, 6, 8, 16, 255))
    return data[:12] + bytes(body) + struct.pack(">I", zlib.crc32(bytes(body))) + data[33:]


def png_chunks(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """A chunk more: text that grows, EXIF, a profile, a palette."""
    kind = pick(rng, (b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"PLTE", b"tRNS", b"acTL", b"fcTL", b"IHDR", b"IDAT"))
    grows = b"a\0\0" + zlib.compress(bytes(20_000_000))
    body = pick(rng, (b"", grows, rng.bytes(40), b"MM\0*\0\0\0\x08\xff\xff", b"a\0\1\0\0\0" + rng.bytes(9)))
    return data[:33] + struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) + data[33:]


def jpeg_size(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    found = re.search(rb"\xff[\xc0\xc2]..\x08", data, re.DOTALL)
    at = found.end() if found else 2
    return data[:at] + struct.pack(">HH", pick(rng, (0, 1, 13_000, 65_535)), pick(rng, (0, 1, 13_000, 65_535))) + data[at + 4 :]


def exr_window(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    at = data.find(pick(rng, (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0")))
    at = data.find(b"box2i\0", at) + 6 + 4
    sizes = (0, -1, 1, 15, 11, 13_000, 1_000_000, 2**31 - 1, -(2**31))
    return data[:at] + struct.pack("<4i", *(int(pick(rng, sizes)) for _ in range(4))) + data[at + 16 :]


def exr_attribute(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """A byte of one attribute of the header: kind of compression, type and sampling of channels, order of lines."""
    end = data.find(b"\0\0", 60)
    at = int(rng.integers(4, max(5, end)))
    return data[:at] + bytes([pick(rng, (0, 1, 2, 3, 9, 64, 127, 128, 255))]) + data[at + 1 :]


def ply_header(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    head, mark, body = data.partition(b"end_header")
    if rng.random() < 0.6:
        counts = (b"0", b"1", b"25", b"1000000000000", b"50000000", b"4294967295", b"-1", b"1e9", b"", b"9" * 400)
        found = list(re.finditer(rb"element \w+ (\d+)", head))
        if found:
            place = pick(rng, found)
            head = head[: place.start(1)] + pick(rng, counts) + head[place.end(1) :]
    else:
        kinds = (b"uchar", b"int", b"double", b"float", b"list uchar int", b"list double double", b"list", b"int128", b"")
        found = list(re.finditer(rb"property (.*)\n", head))
        if found:
            place = pick(rng, found)
            head = (
                head[: place.start(1)]
                + pick(rng, kinds)
                + b" "
                + pick(rng, (b"x", b"instance", b"vertex_indices", b""))
                + head[place.end(1) :]
            )
    return head + mark + body


def ragged_faces(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    lines = data.split(b"\n")
    rows = [i for i, line in enumerate(lines) if line.startswith(b"3 ")]
    for i in rows[: int(rng.integers(1, 5))] if rows else ():
        lines[i] = pick(
            rng,
            (
                b"4 0 1 2 3",
                b"0",
                b"1 0",
                b"2 0 1",
                b"255 0 1 2",
                b"3 0 1 99",
                b"3 -1 0 1",
                b"5 0 1 2 3 4",
                b"3 0 0 0",
                b"3 nan 0 1",
            ),
        )
    return b"\n".join(lines)


def glb_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    size = struct.unpack_from("<I", data, 12)[0]
    tree, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    if rng.random() < 0.3:
        part = pick(rng, (tree.get("accessors"), tree.get("bufferViews"), tree.get("nodes")) or ([],))
        entry = pick(rng, part) if part else {}
        change = pick(
            rng,
            ({"count": 10**9}, {"byteLength": 10**12}, {"byteOffset": -8}, {"bufferView": None}, {"children": [0]}, {"mesh": 0}),
        )
        entry |= change
        if rng.random() < 0.3:
            entry.pop("bufferView", None)
        if rng.random() < 0.2:
            tree["nodes"] = [{"mesh": 0}] * 3000
            tree["scenes"] = [{"nodes": list(range(3000))}]
    else:
        tree = tree_changed(rng, tree)
    text = json.dumps(tree).encode("utf-8", "surrogatepass")
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<II", 2, 20 + len(text) + len(rest)) + struct.pack("<II", len(text), 0x4E4F534A) + text + rest


def colmap_counts(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """The first number of a file, or the number of keypoints or of a track."""
    at = pick(rng, (0, 0, 8, 12, 51, 55, *range(60, min(len(data), 200), 7)))
    return data[:at] + struct.pack("<Q", pick(rng, (0, 1, 10**9, 10**18, 2**63, 2**64 - 1, 7))) + data[at + 8 :]


def npy_header(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    shape = pick(rng, ("(3, 1000000000000)", "(3,)", "()", "(0, 5)", "(3, -1)", "(3, 65,)", "(1, 3, 65)", "(3, 65", "(3, 2**40)"))
    kind = pick(rng, ("<f8", "|O", "<M8[s]", "|S8", "<f4", ">c16", "|b1", "<U4", "x", "<f8'},'x"))
    head = f"{{'descr': '{kind}', 'fortran_order': {pick(rng, (False, True))}, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    at = 10 + struct.unpack_from("<H", data, 8)[0]
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data[at:]


def odd_parquet(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    """A table with columns of other types."""
    import io

    import pyarrow as pa
    import pyarrow.parquet as pq

    n = 65
    x = np.linspace(0, 1, n)
    columns = (
        pa.array([[1.0, 2.0]] * n),
        pa.array(["a"] * n),
        pa.array([None] * n, pa.float64()),
        pa.array([b"x"] * n),
        pa.array([{"a": 1}] * n),
        pa.array(x).dictionary_encode(),
        pa.array([True] * n),
        pa.array([0] * n, pa.timestamp("s")),
        pa.array(x),
        pa.array(np.full(n, np.nan)),
    )
    table = pa.table({name: pick(rng, columns) if rng.random() < 0.4 else pa.array(x) for name in ("x", "R", "G", "B")})
    if rng.random() < 0.2:
        table = table.slice(0, 0)
    file = io.BytesIO()
    pq.write_table(table, file)
    return file.getvalue()


def tensors_changed(rng: Random, data: bytes, _: list[bytes]) -> bytes:
    size = struct.unpack_from("<Q", data)[0]
    text = json_changed(rng, data[8 : 8 + size], [])
    return struct.pack("<Q", pick(rng, (len(text), len(text), 0, 10**12, 2**64 - 1))) + text + data[8 + size :]


Mutator = Callable[[Random, bytes, list[bytes]], bytes]


def mutators_of(path: Path) -> tuple[Mutator, ...]:
    """Return the mutators of a file by its kind; those that know its structure come more often."""
    kind = path.suffix.lower()
    if path.name == "manifest.json":
        return (*ANY, *TEXT, *(manifest_changed,) * 20)
    own: dict[str, tuple[Mutator, ...]] = {
        ".json": (*TEXT, *(json_changed,) * 25),
        ".gltf": (*TEXT, *(json_changed,) * 25),
        ".yaml": (*TEXT, *(yaml_changed,) * 25),
        ".xml": (*TEXT, *(xml_changed,) * 20),
        ".txt": TEXT * 4,
        ".tsv": TEXT * 4,
        ".csv": TEXT * 4,
        ".obj": TEXT * 4,
        ".mtl": TEXT * 4,
        ".png": (png_header,) * 5 + (png_chunks,) * 3,
        ".jpg": (jpeg_size,) * 5,
        ".exr": (exr_window, exr_attribute) * 4,
        ".glb": (glb_changed,) * 15,
        ".bin": (colmap_counts,) * 8,
        ".npy": (npy_header,) * 8,
        ".parquet": (odd_parquet,) * 5,
        ".safetensors": (tensors_changed,) * 8,
        ".ply": (ply_header,) * 6 + (ragged_faces,) * 3 + TEXT,
    }
    return (*ANY, *own.get(kind, ()))


# --------------------------------------------------------------------------------------------------------------- places


def placed_wrong(rng: Random, path: Path) -> str:
    """Put something else where a file belongs: a folder, a link, a pipe, nothing. Returns what."""
    kind = pick(rng, ("folder", "nothing", "loop", "link out", "dangling", "pipe", "unreadable", "parent is a file"))
    if kind == "unreadable":
        path.chmod(0)
        return kind
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "link out":
        path.symlink_to("/etc/passwd")
    elif kind == "dangling":
        path.symlink_to("nowhere")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "parent is a file" and len(path.parts) > 1 and not any(path.parent.iterdir()):
        path.parent.rmdir()
        path.parent.write_bytes(b"x")
    return kind


def mutate(rng: Random, folder: Path, files: tuple[str, ...]) -> str:
    """Change one or two of the files in a folder; return as text what was done."""
    done = []
    pristine = [(folder / name).read_bytes() for name in files]
    for _ in range(1 if rng.random() < 0.85 else 2):
        name = pick(rng, files)
        path = folder / name
        if not path.is_file() or path.is_symlink():
            continue
        if rng.random() < 0.03:
            done.append(f"{name}: {placed_wrong(rng, path)}")
            continue
        chosen = [pick(rng, mutators_of(path)) for _ in range(1 if rng.random() < 0.8 else 2)]
        data = path.read_bytes()
        for mutator in chosen:
            try:
                data = mutator(rng, data, pristine)
            except (
                ValueError,
                KeyError,
                TypeError,
                IndexError,
                AttributeError,
                struct.error,
                RecursionError,
                ElementTree.ParseError,
            ):
                data = flipped(rng, data, pristine)  # what a first change left is no file of its kind
        path.unlink()
        path.write_bytes(data)
        done.append(f"{name}: {' and '.join(mutator.__name__ for mutator in chosen)}")
    return "; ".join(done)
