"""Changes of a capture after which the stages must find the same room, and how far they are from it.

Every relation changes photographs, cameras, mesh and predictions together so that they show the same room as before, runs all
stages on them, and undoes the change in the result. What remains is compared with the spread of the same room under other
seeds, because most changes make rays and pixels meet other random numbers. It is also compared with the spread of a capture moved
by a part of a cell, because cells that lie elsewhere average other pixels.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.rooms.shapes import quarter
from lab.stability import chain
from lab.stability.chain import Capture, Result
from workflow.scene.normal_form import View

SEEDS = 6
TOLERANCE = 2.0
"""Largest distance of a relation, in units of the largest distance that its yardstick has."""
EXACT, NOISE, CELLS = "equal", "noise", "cells"
"""Yardsticks: rounding alone; other random numbers; other random numbers and other cells."""
ROUNDING = 1e-4
"""Largest distance of a relation that must be equal."""

Change = Callable[[Capture, np.random.Generator], Capture]
Undo = Callable[[Result], Result]


@dataclass(frozen=True)
class Relation:
    """A change and its inverse on the result.

    Attributes:
        power, radiance: factors by which the light scales; explained: why the relation does not hold, where it cannot.
    """

    name: str
    change: Change
    yardstick: str
    undo: Undo = lambda result: result
    power: float = 1.0
    radiance: float = 1.0
    explained: str = ""


class Distance(NamedTuple):
    """How far a result is from another: root mean square over the pixels that both see, and logarithms of the light.

    `flipped`: share of the pixels whose roughness or metallic moved by more than 0.1; `decisions`: components of the plan that
    were decided otherwise.
    """

    albedo: float
    roughness: float
    metallic: float
    light: float
    flipped: float
    decisions: float


def distance(result: Result, reference: Result) -> Distance:
    """Compare two results of the same views."""
    names = [name for name in reference.maps if name in result.maps]
    both = {name: result.seen[name] & reference.seen[name] for name in names}
    apart = np.concatenate([(result.maps[name].astype(np.float64) - reference.maps[name])[both[name]] for name in names])
    rms = np.sqrt((apart**2).mean(0))
    light = np.abs(np.log(_light(result) / _light(reference)))
    moved = (np.abs(apart[:, 3:]) > 0.1).any(1).mean()
    differ = sum(result.decisions.get(key) != value for key, value in reference.decisions.items())
    albedo = float(np.sqrt((rms[:3] ** 2).mean()))
    return Distance(albedo, float(rms[3]), float(rms[4]), float(light.max()), float(moved), float(differ))


def _light(result: Result) -> NDArray:
    return np.maximum(result.power + np.pi * result.environment, 1e-300)


# ------------------------------------------------------------------------------------------------------------ changes


def _moved(rotation: NDArray, shift: NDArray, scale: float = 1.0) -> Change:
    """The world turned, scaled and shifted; settings that are lengths are scaled along."""

    def change(capture: Capture, rng: np.random.Generator) -> Capture:
        views = []
        for view in capture.views:
            pose = view.world_from_camera.copy()
            pose[:3, :3], pose[:3, 3] = rotation @ pose[:3, :3], scale * rotation @ pose[:3, 3] + shift
            views.append(replace(view, world_from_camera=pose))
        vertices = (scale * capture.vertices.astype(np.float64) @ rotation.T + shift).astype(np.float32)
        depth = {name: (scale * z).astype(np.float32) for name, z in capture.depth.items()}
        moved = replace(capture, views=tuple(views), vertices=vertices, depth=depth)
        if scale == 1.0:
            return moved
        lengths = {section: {key: scale * float(moved.document[section][key])} for section, key in LENGTHS}
        return moved.with_settings(**lengths)

    return change


LENGTHS = (("emission", "cache_edge"), ("shading", "cell_edge"))
"""Settings in metres."""


def _turn(axis: NDArray, angle: float) -> NDArray:
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _of_photos(change: Callable[[NDArray], NDArray]) -> Callable[[Mapping[str, NDArray]], dict[str, NDArray]]:
    return lambda rasters: {name: np.ascontiguousarray(change(raster)) for name, raster in rasters.items()}


def _brighter(factor: float) -> Change:
    """Brighter linear photographs; photographs of a sensor stay as they are, and are exposed so much less."""

    def change(capture: Capture, rng: np.random.Generator) -> Capture:
        emission = capture.emission * np.float32(factor)
        if capture.facts["dynamic_range"] == "ldr":
            views = tuple(replace(view, exposure=view.exposure / factor) for view in capture.views)
            return replace(capture, views=views, emission=emission)
        photo = {name: image * np.float32(factor) for name, image in capture.photo.items()}
        return replace(capture, photo=photo, emission=emission)

    return change


def _views_permuted(capture: Capture, rng: np.random.Generator) -> Capture:
    order = rng.permutation(len(capture.views))
    return replace(capture, views=tuple(replace(capture.views[i], view_id=number) for number, i in enumerate(order)))


def _predictions_permuted(capture: Capture, rng: np.random.Generator) -> Capture:
    return replace(capture, maps={name: maps[rng.permutation(len(maps))] for name, maps in capture.maps.items()})


def _predictions_twice(capture: Capture, rng: np.random.Generator) -> Capture:
    return replace(capture, maps={name: np.concatenate([maps, maps]) for name, maps in capture.maps.items()})


def _colours_permuted(capture: Capture, rng: np.random.Generator) -> Capture:
    turned = _of_photos(lambda image: image[..., [2, 0, 1]])
    maps = {name: np.concatenate([maps[..., [2, 0, 1]], maps[..., 3:]], -1) for name, maps in capture.maps.items()}
    return replace(capture, photo=turned(capture.photo), emission=capture.emission[:, [2, 0, 1]], maps=maps)


def _colours_back(result: Result) -> Result:
    back = [1, 2, 0]
    maps = {name: np.concatenate([values[..., back], values[..., 3:]], -1) for name, values in result.maps.items()}
    return replace(result, maps=maps, power=result.power[back], environment=result.environment[back])


def _faces_permuted(capture: Capture, rng: np.random.Generator) -> Capture:
    order = rng.permutation(len(capture.faces))
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return _with_faces(capture, capture.faces[order], order, number)


def _with_faces(capture: Capture, faces: NDArray, parent: NDArray, child: NDArray) -> Capture:
    """Other faces, each a part of `parent`; `child` is one new face of every old one."""
    face = {name: np.where(ids >= 0, child[ids], -1).astype(np.int32) for name, ids in capture.face.items()}
    return replace(capture, faces=faces, instance=capture.instance[parent], emission=capture.emission[parent], face=face)


def _vertices_permuted(capture: Capture, rng: np.random.Generator) -> Capture:
    order = rng.permutation(len(capture.vertices))
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return replace(capture, vertices=capture.vertices[order], faces=number[capture.faces])


def _corners_turned(capture: Capture, rng: np.random.Generator) -> Capture:
    return replace(capture, faces=np.roll(capture.faces, 1, axis=1))


def _objects_permuted(capture: Capture, rng: np.random.Generator) -> Capture:
    order = rng.permutation(len(capture.names))
    names = tuple(capture.names[list(order).index(number)] for number in range(len(order)))
    instance = np.where(capture.instance >= 0, order[capture.instance], -1).astype(np.int32)
    return replace(capture, instance=instance, names=names)


def _ids_with_gaps(capture: Capture, rng: np.random.Generator) -> Capture:
    return replace(capture, instance=np.where(capture.instance >= 0, 1000 + 7 * capture.instance, -1).astype(np.int32), names=())


def _copies(which: Callable[[int], bool]) -> Change:
    def change(capture: Capture, rng: np.random.Generator) -> Capture:
        views = list(capture.views)
        out = {name: dict(getattr(capture, name)) for name in ("photo", "valid", "depth", "face", "maps")}
        for view in capture.views:
            if which(view.view_id):
                views.append(replace(view, view_id=len(views), name=f"{view.name}_again"))
                for rasters in out.values():
                    rasters[views[-1].name] = rasters[view.name]
        return replace(capture, views=tuple(views), **out)

    return change


def _mirrored(capture: Capture, rng: np.random.Generator) -> Capture:
    """x becomes -x; pictures are mirrored so that the cameras stay right-handed."""
    flip = np.diag([-1.0, 1.0, 1.0])
    views = []
    for view in capture.views:
        pose = view.world_from_camera.copy()
        pose[:3, :3], pose[:3, 3] = flip @ pose[:3, :3] @ flip, flip @ pose[:3, 3]
        views.append(replace(view, world_from_camera=pose, cx=view.width - view.cx))
    columns = _of_photos(lambda raster: raster[:, ::-1])
    maps = {name: np.ascontiguousarray(maps[:, :, ::-1]) for name, maps in capture.maps.items()}
    rasters = {name: columns(getattr(capture, name)) for name in ("photo", "valid", "depth", "face")}
    vertices = (capture.vertices @ flip.T).astype(np.float32)
    faces = np.ascontiguousarray(capture.faces[:, ::-1])
    return replace(capture, views=tuple(views), maps=maps, vertices=vertices, faces=faces, **rasters)


def _mirrored_back(result: Result) -> Result:
    columns = _of_photos(lambda raster: raster[:, ::-1])
    return replace(result, maps=columns(result.maps), seen=columns(result.seen))


def _rolled(capture: Capture, rng: np.random.Generator) -> Capture:
    """Cameras turned by 90 degrees about their axis, and pictures turned back."""
    views: list[View] = []
    for view in capture.views:
        # New x is the old y and new y the old -x.
        roll = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        pose = view.world_from_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ roll
        place = {"fx": view.fy, "fy": view.fx, "cx": view.cy, "cy": view.width - view.cx}
        views.append(replace(view, width=view.height, height=view.width, world_from_camera=pose, **place))
    turned = _of_photos(lambda raster: np.rot90(raster))
    rasters = {name: turned(getattr(capture, name)) for name in ("photo", "valid", "depth", "face")}
    maps = {name: np.ascontiguousarray(np.rot90(maps, axes=(1, 2))) for name, maps in capture.maps.items()}
    return replace(capture, views=tuple(views), maps=maps, **rasters)


def _rolled_back(result: Result) -> Result:
    turned = _of_photos(lambda raster: np.rot90(raster, -1))
    return replace(result, maps=turned(result.maps), seen=turned(result.seen))


def _subdivided(capture: Capture, rng: np.random.Generator) -> Capture:
    """Every face in four by the middles of its edges; neighbours share the new vertices."""
    vertices, faces = quarter(capture.vertices, capture.faces)
    count = len(capture.faces)
    parent, first = np.repeat(np.arange(count), 4), 4 * np.arange(count, dtype=np.int32)
    moved = replace(capture, vertices=vertices.astype(np.float32))
    divided = _with_faces(moved, faces.astype(np.int32), parent, first)
    return replace(divided, face=_true_faces(divided, capture))


def _true_faces(divided: Capture, before: Capture) -> dict[str, NDArray]:
    """The part of each face that a pixel shows: of the four, the one whose corners hold its point."""
    out = {}
    for view in before.views:
        ids = before.face[view.name]
        hit = ids >= 0
        point = view.world_from_camera[:3, 3] + before.depth[view.name][..., None] * view.directions()
        best, inside = np.full(ids.shape, -1, np.int32), np.full(ids.shape, -np.inf)
        for part in range(4):
            number = 4 * np.where(hit, ids, 0) + part
            corners = divided.vertices[divided.faces[number]].astype(np.float64)
            least = _barycentric(point.astype(np.float64), corners).min(-1)
            better = hit & (least > inside)
            best[better], inside[better] = number[better], least[better]
        out[view.name] = best
    return out


def _barycentric(point: NDArray, corners: NDArray) -> NDArray:
    a, b, c = (corners[..., i, :] for i in range(3))
    normal = np.cross(b - a, c - a)
    size = np.maximum((normal**2).sum(-1), 1e-300)
    u = (np.cross(c - b, point - b) * normal).sum(-1) / size
    v = (np.cross(a - c, point - c) * normal).sum(-1) / size
    return np.stack([u, v, 1 - u - v], -1)


def _split_at_objects(capture: Capture, rng: np.random.Generator) -> Capture:
    """Objects share no vertices any more."""
    pairs = np.stack([capture.faces.reshape(-1), np.repeat(capture.instance, 3)], 1)
    unique, number = np.unique(pairs, axis=0, return_inverse=True)
    return replace(capture, vertices=capture.vertices[unique[:, 0]], faces=number.reshape(-1, 3).astype(np.int32))


def _unwelded(capture: Capture, rng: np.random.Generator) -> Capture:
    """Faces share no vertices any more."""
    faces = np.arange(3 * len(capture.faces), dtype=np.int32).reshape(-1, 3)
    return replace(capture, vertices=capture.vertices[capture.faces.reshape(-1)], faces=faces)


def _hidden_added(capture: Capture, rng: np.random.Generator) -> Capture:
    """A small box far outside, which nothing sees; it is a separate object."""
    low = capture.vertices.min(0) - 3.0
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) * 0.5 + low.astype(np.float32)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(a, b, c) for a, b, c, _ in sides] + [(a, c, d) for a, _, c, d in sides], np.int32) + len(capture.vertices)
    count = len(faces)
    return replace(
        capture,
        vertices=np.concatenate([capture.vertices, corners]),
        faces=np.concatenate([capture.faces, faces]),
        instance=np.concatenate([capture.instance, np.full(count, len(capture.names), np.int32)]),
        names=(*capture.names, "hidden"),
        emission=np.concatenate([capture.emission, np.zeros((count, 3), np.float32)]),
    )


def _names_changed(capture: Capture, rng: np.random.Generator) -> Capture:
    new = {view.name: f"z{len(capture.views) - view.view_id:03d}" for view in capture.views}
    rasters = {
        kind: {new[name]: raster for name, raster in getattr(capture, kind).items()}
        for kind in ("photo", "valid", "depth", "face", "maps")
    }
    return replace(capture, views=tuple(replace(view, name=new[view.name]) for view in capture.views), **rasters)


def _of_scale(scale: float, explained: str = "") -> Relation:
    change = _moved(np.eye(3), np.zeros(3), scale)
    return Relation(f"world scaled by {scale:g}", change, NOISE, power=scale**2, explained=explained)


_MILLIMETRES = "new rays begin 0.1 mm off the surface, which is much in a room of 5 mm; sources refuse rooms below 0.5 m"


def _of_radiance(factor: float) -> Relation:
    return Relation(f"radiance times {factor:g}", _brighter(factor), NOISE, power=factor, radiance=factor)


_EVIDENCE = "pixels are taken for independent, so that twice the photographs weigh twice against what is assumed beforehand"
TILT = _turn(np.array([1.0, 2.0, 0.5]), 0.7)
QUARTER = _turn(np.array([0.0, 0.0, 1.0]), np.pi / 2).round()
RELATIONS = (
    Relation("two threads", lambda capture, rng: replace(capture, threads=2), EXACT),
    Relation("three threads", lambda capture, rng: replace(capture, threads=3), EXACT),
    Relation("views permuted", _views_permuted, NOISE),
    Relation("views renamed", _names_changed, EXACT),
    Relation("objects permuted", _objects_permuted, NOISE),
    Relation("object ids with gaps, no names", _ids_with_gaps, EXACT),
    Relation("predictions permuted", _predictions_permuted, NOISE),
    Relation("every prediction twice", _predictions_twice, NOISE),
    Relation("colour channels permuted", _colours_permuted, NOISE, _colours_back),
    Relation("faces permuted", _faces_permuted, NOISE),
    Relation("vertices permuted", _vertices_permuted, EXACT),
    Relation("corners of faces turned", _corners_turned, NOISE),
    Relation("faces subdivided", _subdivided, NOISE),
    Relation("objects share no vertices", _split_at_objects, EXACT),
    Relation("faces share no vertices", _unwelded, EXACT),
    Relation("a hidden object outside", _hidden_added, CELLS),
    Relation("one photograph twice", _copies(lambda view: view == 0), NOISE),
    Relation("every photograph twice", _copies(lambda view: True), NOISE, explained=_EVIDENCE),
    Relation("cameras rolled by 90 degrees", _rolled, NOISE, _rolled_back),
    Relation("world mirrored", _mirrored, CELLS, _mirrored_back),
    Relation("world turned by 90 degrees", _moved(QUARTER, np.zeros(3)), CELLS),
    Relation("world turned and tilted", _moved(TILT, np.array([0.31, -0.2, 1.7])), CELLS),
    Relation("world shifted by 1 km", _moved(np.eye(3), np.array([1000.0, 0.0, 0.0])), CELLS),
    _of_scale(1e-3, _MILLIMETRES),
    *(_of_scale(scale) for scale in (0.1, 10.0, 1e3)),
    *(_of_radiance(factor) for factor in (1e-6, 1e-3, 1e3, 1e6)),
)


class Related(NamedTuple):
    """A relation on a room: its distance, the largest of its yardstick, and whether it is within the tolerance."""

    room: str
    relation: str
    yardstick: str
    found: Distance
    allowed: Distance
    explained: str = ""

    @property
    def beyond(self) -> list[str]:
        """Names of what is further apart than allowed."""
        return [name for name, value, most in zip(Distance._fields, self.found, self.allowed, strict=True) if value > most]


def measure(room: str, relations: tuple[Relation, ...] = RELATIONS) -> Iterator[Related]:
    """Run one of `chain.ROOMS` under other seeds, moved by parts of a cell, and under every relation."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        capture = chain.make_capture(folder / "capture", chain.ROOMS[room])
        reference = chain.run(capture, folder / "reference")
        apart = [distance(chain.run(_seeded(capture, seed), folder / "seed"), reference) for seed in range(1, SEEDS)]
        noise = _largest(apart)
        yield Related(room, f"{SEEDS - 1} other seeds", "", noise, _unlimited())
        edge = float(reference.documents["base"]["cell_edge_m"])
        parts = [np.array([0.5, 0.3, 0.1]), np.array([0.2, 0.5, 0.4]), np.array([0.4, 0.1, 0.5])]
        padded = [_padded(capture, edge * part) for part in parts]
        cells = _largest([noise, *(distance(chain.run(one, folder / "cells"), reference) for one in padded)])
        yield Related(room, "cells moved by parts of their edge", "", cells, _unlimited())
        for number, relation in enumerate(relations):
            rng = np.random.default_rng([11, number])
            result = relation.undo(chain.run(relation.change(capture, rng), folder / "relation"))
            light = {"power": result.power / relation.power, "environment": result.environment / relation.radiance}
            found = distance(_matched(replace(result, **light), reference), reference)
            allowed = {EXACT: _rounding(), NOISE: _times(noise), CELLS: _times(cells)}[relation.yardstick]
            limit = _unlimited() if relation.explained else allowed
            yield Related(room, relation.name, relation.yardstick, found, limit, relation.explained)


def _matched(result: Result, reference: Result) -> Result:
    """Views in the names of the reference, where all of them were renamed."""
    if set(result.maps) & set(reference.maps):
        return result
    names = dict(zip(sorted(result.maps, reverse=True), sorted(reference.maps), strict=True))

    def renamed(rasters: Mapping[str, NDArray]) -> dict[str, NDArray]:
        return {names[name]: raster for name, raster in rasters.items()}

    return replace(result, maps=renamed(result.maps), seen=renamed(result.seen))


def _seeded(capture: Capture, seed: int) -> Capture:
    return replace(capture, document={**capture.document, "seed": seed})


def _padded(capture: Capture, by: NDArray) -> Capture:
    """A capture whose grids begin elsewhere: three stray vertices beyond its corner, which belong to no face that is seen."""
    low = capture.vertices.min(0).astype(np.float64) - by - 3.0
    triangle = (low + np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]])).astype(np.float32)
    n = len(capture.vertices)
    return replace(
        capture,
        vertices=np.concatenate([capture.vertices, triangle]),
        faces=np.concatenate([capture.faces, np.array([[n, n + 1, n + 2]], np.int32)]),
        instance=np.concatenate([capture.instance, np.array([len(capture.names)], np.int32)]),
        names=(*capture.names, "stray"),
        emission=np.concatenate([capture.emission, np.zeros((1, 3), np.float32)]),
    )


def _largest(found: list[Distance]) -> Distance:
    return Distance(*np.max(np.array(found), axis=0).tolist())


def _times(yardstick: Distance) -> Distance:
    """What is allowed; a thousandth where the yardstick itself hardly moves."""
    return Distance(*(max(TOLERANCE * value, 1e-3) for value in yardstick[:5]), yardstick.decisions)


def _rounding() -> Distance:
    return Distance(ROUNDING, ROUNDING, ROUNDING, ROUNDING, 0.0, 0.0)


def _unlimited() -> Distance:
    return Distance(*([float("inf")] * 6))
