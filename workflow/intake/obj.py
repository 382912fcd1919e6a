"""Vertices and faces of OBJ files: absolute and relative indices, polygons, lines that go on in the next."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from iif_core.errors import InputError
from workflow.intake.meshes import AGAIN, check_faces
from workflow.intake.polygons import naming, triangulated

Array = np.ndarray


def read_obj(path: Path) -> tuple[Array, Array]:
    """Return vertices (n, 3) float64 and triangles (m, 3) int64 of an OBJ file.

    A relative index counts back from the vertices that stand above its face. Colours behind a vertex, texture coordinates,
    normals, lines and materials are not read.

    Raises:
        InputError: a vertex or an index is no number, or a face names a vertex that is not there.
    """
    lines = re.sub(rb"\\\r?\n", b" ", path.read_bytes()).replace(b"\t", b" ").splitlines()
    stripped = [line.strip() for line in lines]
    of_vertices = [i for i, line in enumerate(stripped) if line[:2] == b"v "]
    of_faces = [i for i, line in enumerate(stripped) if line[:2] == b"f "]
    vertices = _numbers(path, stripped, of_vertices)
    # Vertices above each face, from which relative indices count back.
    above = np.searchsorted(np.array(of_vertices, np.int64), np.array(of_faces, np.int64))
    return vertices, _faces(path, stripped, of_faces, above, vertices)


def _numbers(path: Path, lines: list[bytes], which: list[int]) -> Array:
    out = np.empty((len(which), 3))
    for row, number in enumerate(which):
        words = lines[number].split(None, 4)
        try:
            out[row] = float(words[1]), float(words[2]), float(words[3])
        except (ValueError, IndexError):
            said = lines[number][:60].decode(errors="replace")
            raise InputError(f"{path}, line {number + 1}: {said!r} is no vertex of three numbers; {AGAIN}") from None
    return out


def _faces(path: Path, lines: list[bytes], which: list[int], above: Array, vertices: Array) -> Array:
    # Of `7/2/5` the first number is the vertex.
    words = [re.sub(rb"/[^ ]*", b"", lines[number]).split()[1:] for number in which]
    count = np.array([len(own) for own in words], np.int64)
    try:
        flat = np.array([int(word) for own in words for word in own], np.int64)
    except (ValueError, OverflowError):
        wrong = next(i for i, own in enumerate(words) if not all(re.fullmatch(rb"[-+]?\d{1,18}", word) for word in own))
        said = lines[which[wrong]][:60].decode(errors="replace")
        raise InputError(f"{path}, line {which[wrong] + 1}: {said!r} names no vertices; {AGAIN}") from None
    owner = np.repeat(np.arange(len(count)), count)
    flat = np.where(flat < 0, above[owner] + flat, flat - 1)
    outside = np.flatnonzero((flat < 0) | (flat >= len(vertices)))
    if len(outside):
        number = which[owner[outside[0]]]
        said = lines[number][:60].decode(errors="replace")
        raise InputError(f"{path}, line {number + 1}: {said!r} names a vertex that is not there (of {len(vertices)}); {AGAIN}")
    check_faces(path, int(np.maximum(count - 2, 0).sum()))
    start = np.cumsum(count) - count
    some = ((k, np.flatnonzero(count == k)) for k in np.unique(count))
    with naming(path):
        return triangulated(vertices, [(own, flat[start[own][:, None] + np.arange(k)]) for k, own in some])[0]
