"""What the verdict of the report says of good and of spoilt captures, next to the truth.

    python lab/benchmarks/verdicts.py FOLDER [--count 10] [--jobs 1]

Makes small captures of the built-in rooms with the errors of real captures (8 photographs of 96 x 96 pixels and 2 held out),
spoils most of them as captures of people are spoilt (`SPOILS`), and gives each to the product as a folder without truth, with
prior `learned` and objects from the mesh. A row for each capture is added to lab/notebook/data/verdicts.csv as it is finished:
the lights, what they were judged by, and the truth. Captures that the file has are skipped, so a run that was stopped goes on.
FOLDER keeps captures and artefacts.

Without FOLDER it judges the rows of the file again by the thresholds as they are, writes what the report says of the lights
(workflow/report/calibration.json), and makes the tables of lab/notebook/verdicts.md: what each light means, also with thresholds
chosen without the room that is judged (`chosen`), and how well each evidence separates right from wrong.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import importlib
import itertools
import json
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from iif_core.errors import InputError
from iif_core.evaluation.metrics import MIRROR_ROUGHNESS
from lab.loose import Loose, document_of
from lab.packing import OPENGL
from lab.rooms.lamps_found import NEAR, away, lamps_found
from workflow.report import calibration
from workflow.report.verdict import AMBER, GREEN, LIMITS, MEANS, RED, Evidence, Limit, judge
from workflow.runtime import device, native
from workflow.scene.normal_form import CaptureReader

Array = np.ndarray
REPOSITORY = Path(__file__).resolve().parents[2]
FILE, PAGE = REPOSITORY / "lab/notebook/data/verdicts.csv", REPOSITORY / "lab/notebook/verdicts.md"
VIEWS, TEST_EVERY, SIZE = 10, 5, 96
STAGES = (
    *("capture", "plan", "prior", "segmentation", "base", "emission"),
    *("shading", "second_look", "affines", "render", "metrics"),
)
ROOMS = ("kitchen", "tiny", "sky", "sun", "lamps", "gloss", "white", "evening", "blinds", "curtains", "door", "single")


@dataclass(frozen=True)
class Taken:
    """A capture in memory, as it will be written to a folder.

    Attributes:
        names: of the photographs; photos: (H, W, 3) uint8 each; poses: (4, 4) `world_from_camera` each, x right, y down.
        focal: of each, pixels; held_out: of each.
        vertices: (n, 3) metres; faces: (m, 3); shines: (m,) bool, the faces of true lamps.
        moved: (4, 4) by which the spoilt mesh was moved against the true room.
        axes: what poses are written with, on the right.
    """

    names: list[str]
    photos: list[Array]
    poses: list[Array]
    focal: list[float]
    held_out: list[bool]
    vertices: Array
    faces: Array
    shines: Array
    moved: Array = dataclasses.field(default_factory=lambda: np.eye(4))
    axes: Array = dataclasses.field(default_factory=lambda: OPENGL)

    def only(self, chosen: Sequence[int]) -> Taken:
        """Return the capture with some of its photographs."""
        kept = {name: [getattr(self, name)[i] for i in chosen] for name in ("names", "photos", "poses", "focal", "held_out")}
        return replace(self, **kept)

    def without(self, gone: Array) -> Taken:
        """Return the capture without some faces (m,) of the mesh."""
        return replace(self, faces=self.faces[~gone], shines=self.shines[~gone])

    def transformed(self, matrix: Array) -> Taken:
        """Return the capture with the mesh moved and the cameras left where they were."""
        return replace(self, vertices=self.vertices @ matrix[:3, :3].T + matrix[:3, 3], moved=matrix @ self.moved)


Change = Callable[[Taken, np.random.Generator], Taken]


# ------------------------------------------------------------------------------------------------------------- cameras


def shifted(pixels: float) -> Change:
    """Shift where every photograph shows things, by so many pixels in a direction of its own."""

    def change(taken: Taken, rng: np.random.Generator) -> Taken:
        return turned(np.degrees(pixels / taken.focal[0]))(taken, rng)

    return change


def turned(degrees: float) -> Change:
    """Turn every camera about a random axis across its view."""

    def change(taken: Taken, rng: np.random.Generator) -> Taken:
        from scipy.spatial.transform import Rotation

        poses = []
        for pose in taken.poses:
            angle = rng.uniform(0, 2 * np.pi)
            turn = Rotation.from_rotvec(np.radians(degrees) * np.array([np.cos(angle), np.sin(angle), 0])).as_matrix()
            poses.append(np.block([[pose[:3, :3] @ turn, pose[:3, 3:]], [np.array([[0, 0, 0, 1]])]]))
        return replace(taken, poses=poses)

    return change


def drifted(metres: float) -> Change:
    """Move the cameras along a line, the last by so many metres: tracking that drifts."""

    def change(taken: Taken, rng: np.random.Generator) -> Taken:
        way, poses = rng.normal(size=3), []
        for i, pose in enumerate(taken.poses):
            pose = pose.copy()
            pose[:3, 3] += metres * i / (len(taken.poses) - 1) * way / np.linalg.norm(way)
            poses.append(pose)
        return replace(taken, poses=poses)

    return change


def focal(factor: float) -> Change:
    """State a focal length that is wrong by a factor."""
    return lambda taken, rng: replace(taken, focal=[factor * f for f in taken.focal])


def other_axes(taken: Taken, rng: np.random.Generator) -> Taken:
    """Write the poses with the axes of OpenCV where those of OpenGL are expected."""
    return replace(taken, axes=np.eye(4))


def next_pose(taken: Taken, rng: np.random.Generator) -> Taken:
    """Give every photograph the pose of the next."""
    return replace(taken, poses=[*taken.poses[1:], taken.poses[0]])


def swapped(taken: Taken, rng: np.random.Generator) -> Taken:
    """Swap the poses of two pairs of photographs."""
    poses = list(taken.poses)
    for a, b in rng.permutation(len(poses))[:4].reshape(2, 2):
        poses[a], poses[b] = poses[b], poses[a]
    return replace(taken, poses=poses)


def few(taken: Taken, rng: np.random.Generator) -> Taken:
    """Keep three photographs, and one held out."""
    used, held = ([i for i, out in enumerate(taken.held_out) if out == of] for of in (False, True))
    return taken.only(sorted([*used[::3][:3], *held[:1]]))


# ------------------------------------------------------------------------------------------------------------- mesh


def scaled(factor: float) -> Change:
    """Scale the mesh, and not the poses."""
    return lambda taken, rng: taken.transformed(np.diag([factor] * 3 + [1.0]))


def as_feet(taken: Taken, rng: np.random.Generator) -> Taken:
    """Take the metres of mesh and poses for feet."""
    poses = [np.block([[p[:3, :3], p[:3, 3:] * 0.3048], [np.array([[0, 0, 0, 1]])]]) for p in taken.poses]
    return replace(scaled(0.3048)(taken, rng), poses=poses)


def y_up(taken: Taken, rng: np.random.Generator) -> Taken:
    """Write the mesh with y up where the poses have z up."""
    return taken.transformed(np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))


def mirrored(taken: Taken, rng: np.random.Generator) -> Taken:
    """Mirror the mesh in x about its middle."""
    middle = (taken.vertices[:, 0].min() + taken.vertices[:, 0].max()) / 2
    matrix = np.diag([-1.0, 1, 1, 1])
    matrix[0, 3] = 2 * middle
    return replace(taken.transformed(matrix), faces=taken.faces[:, ::-1])


def raised(metres: float) -> Change:
    """Shift the mesh against the poses, upwards."""
    matrix = np.eye(4)
    matrix[2, 3] = metres
    return lambda taken, rng: taken.transformed(matrix)


def _centres(taken: Taken) -> Array:
    return taken.vertices[taken.faces].mean(1)


def _end(taken: Taken, axis: int, share: float) -> Array:
    """Return which faces (m,) lie within a share of the extent from the far end of the room along an axis."""
    low, high = (np.quantile(_centres(taken)[:, axis], q) for q in (0.001, 0.999))
    return _centres(taken)[:, axis] > high - share * (high - low)


def no_ceiling(taken: Taken, rng: np.random.Generator) -> Taken:
    """Leave out the ceiling, as most scans do."""
    return taken.without(_end(taken, 2, 0.03) & ~taken.shines)


def no_wall(taken: Taken, rng: np.random.Generator) -> Taken:
    """Leave out a wall."""
    return taken.without(_end(taken, 0, 0.04) & ~taken.shines)


def holes(taken: Taken, rng: np.random.Generator) -> Taken:
    """Cut eight holes of 0.5 m radius."""
    centres = _centres(taken)
    middles = centres[rng.choice(len(centres), 8, replace=False)]
    gone = (np.linalg.norm(centres[:, None] - middles, axis=2) < 0.5).any(1)
    return taken.without(gone & ~taken.shines)


def no_lamp(taken: Taken, rng: np.random.Generator) -> Taken:
    """Leave the surface of all lamps out of the mesh."""
    return taken.without(taken.shines)


# ------------------------------------------------------------------------------------------------------------- photographs


def _each(work: Callable[[Array, np.random.Generator, int], Array]) -> Change:
    """Change every photograph, linear values (H, W, 3) in [0, 1], as 8-bit sRGB has them."""

    def change(taken: Taken, rng: np.random.Generator) -> Taken:
        from iif_core.numerics.color import linear_from_srgb, srgb_from_linear

        def made(photo: Array, number: int) -> Array:
            linear = np.clip(work(linear_from_srgb(photo / 255), rng, number), 0, 1)
            return np.rint(255 * srgb_from_linear(linear)).astype(np.uint8)

        return replace(taken, photos=[made(photo, i) for i, photo in enumerate(taken.photos)])

    return change


def exposed(stops: float) -> Change:
    """Expose all photographs by so many stops too much or too little."""
    return _each(lambda linear, rng, number: 2.0**stops * linear)


def some_exposed(taken: Taken, rng: np.random.Generator) -> Taken:
    """Overexpose every other photograph by three stops."""
    return _each(lambda linear, rng, number: linear * (8.0 if number % 2 else 1.0))(taken, rng)


def blurred(pixels: float) -> Change:
    """Blur all photographs by a Gaussian of that standard deviation."""
    from scipy.ndimage import gaussian_filter

    return _each(lambda linear, rng, number: gaussian_filter(linear, (pixels, pixels, 0)))


def bordered(taken: Taken, rng: np.random.Generator) -> Taken:
    """Put a black border around all photographs, a tenth of their width."""
    edge = SIZE // 10

    def work(linear: Array, rng: np.random.Generator, number: int) -> Array:
        inside = np.zeros(linear.shape[:2], bool)
        inside[edge:-edge, edge:-edge] = True
        return np.where(inside[..., None], linear, 0.0)

    return _each(work)(taken, rng)


def gamma_twice(taken: Taken, rng: np.random.Generator) -> Taken:
    """Apply the curve of sRGB twice."""
    from iif_core.numerics.color import srgb_from_linear

    return _each(lambda linear, rng, number: srgb_from_linear(linear))(taken, rng)


def as_it_is(taken: Taken, rng: np.random.Generator) -> Taken:
    """Change nothing."""
    return taken


SPOILS: dict[str, tuple[Change, str]] = {
    "good": (as_it_is, "as_captured"),
    "good_again": (as_it_is, "again"),
    "shifted_4": (shifted(4), "as_captured"),
    "shifted_10": (shifted(10), "as_captured"),
    "turned_3": (turned(3), "as_captured"),
    "drifted": (drifted(0.3), "as_captured"),
    "focal_1.1": (focal(1.1), "as_captured"),
    "focal_0.9": (focal(0.9), "as_captured"),
    "other_axes": (other_axes, "as_captured"),
    "next_pose": (next_pose, "as_captured"),
    "swapped": (swapped, "as_captured"),
    "few": (few, "as_captured"),
    "scaled_1.1": (scaled(1.1), "as_captured"),
    "scaled_100": (scaled(100), "as_captured"),
    "as_feet": (as_feet, "as_captured"),
    "y_up": (y_up, "as_captured"),
    "mirrored": (mirrored, "as_captured"),
    "raised": (raised(0.2), "as_captured"),
    "no_ceiling": (no_ceiling, "as_captured"),
    "no_wall": (no_wall, "as_captured"),
    "holes": (holes, "as_captured"),
    "no_lamp": (no_lamp, "as_captured"),
    "over_2": (exposed(2), "as_captured"),
    "under_4": (exposed(-4), "as_captured"),
    "some_over_3": (some_exposed, "as_captured"),
    "blurred": (blurred(2.5), "as_captured"),
    "bordered": (bordered, "as_captured"),
    "gamma_twice": (gamma_twice, "as_captured"),
    "other_light": (as_it_is, "other_light"),
    "lamp_unseen": (as_it_is, "lamp_unseen"),
}
"""Name -> what is done to the folder, and which capture of the room it is done to (`capture_of`)."""

GOOD = ("good", "good_again")
WHERE: dict[str, tuple[str, ...]] = {
    "other_light": ("lamps", "evening", "kitchen"),
    "lamp_unseen": ("kitchen", "white", "tiny"),
    "no_lamp": ("tiny", "gloss", "lamps"),
}
"""Rooms of spoils that not every room can have."""


def cases() -> list[tuple[str, str]]:
    """Return (room, spoil): every room twice as it is, and three rooms for every spoil; any beginning of the list has both."""
    spoils = [name for name in SPOILS if name not in GOOD]
    rest = []
    for turn in range(3):
        for number, name in enumerate(spoils):
            rooms = WHERE.get(name, ROOMS)
            at = 5 * number + 7 * turn + number // 12
            rest.append((rooms[turn] if name in WHERE else rooms[at % len(rooms)], name))
    good = [(room, name) for name in GOOD for room in ROOMS]
    order = np.random.default_rng(0).permutation(len(spoils))
    spoilt = [rest[len(spoils) * turn + i] for turn in range(3) for i in order]
    out = []
    while good or spoilt:
        out += [*good[:1], *spoilt[:3]]
        good, spoilt = good[1:], spoilt[3:]
    return out


# ------------------------------------------------------------------------------------------------------------- captures


def capture_of(room_name: str, variant: str, folder: Path) -> CaptureReader:
    """Photograph a room once: `as_captured`; `again`: with other errors; `other_light`: with half of the lamps off, or a tenth of
    the light from outside; `lamp_unseen`: from where no photograph shows a lamp."""
    place = folder / "rooms" / f"{room_name}-{variant}"
    settings = {
        "seed": int(variant == "again"),
        "source": {"kind": "builtin", "scene": room_name},
        "capture": {"views": VIEWS, "width": SIZE, "height": SIZE, "test_every": TEST_EVERY, "realism": "as_captured"},
    }
    loose = Loose(place, document_of(settings))
    if not (place / "capture/manifest.json").exists():
        shutil.rmtree(place, ignore_errors=True)
        from lab.sources.builtin import photograph_room

        job = loose.job("capture")
        photograph_room(job, room_of(room_name, variant))
        job.writer.finish()
    return CaptureReader(loose.open("capture"))


@cache
def room_of(name: str, variant: str) -> Any:
    """Return the room of which the photographs of a capture are."""
    from lab import rooms

    return {"other_light": _dimmed, "lamp_unseen": _turned_away}.get(variant, lambda as_is: as_is)(rooms.build(name))


def _dimmed(room: Any) -> Any:
    """Return the room with every other lamp off, or with a tenth of its light if it has one lamp, and of that from outside."""
    lamps = [o for o in range(len(room.names)) if room.emission[room.object_id == o].any()]
    factor = np.ones(len(room.names))
    factor[lamps[::2]] = 0.0 if len(lamps) > 1 else 0.1
    outside = None if room.environment is None else 0.1 * room.environment
    return replace(room, emission=(factor[room.object_id, None] * room.emission).astype(np.float32), environment=outside)


def _turned_away(room: Any) -> Any:
    """Return the room with only those cameras from which no lamp is seen."""
    from iif_core.camera.pinhole import pixel_directions
    from iif_core.light.transport.geometry import build_geometry, trace

    geometry, width = build_geometry(room.vertices, room.faces, room.object_id), 48
    lens = 0.5 * width / np.tan(np.radians(room.field_of_view / 2))
    unseen = []
    for pose in room.cameras(200):
        ways = pixel_directions(lens, lens, width / 2, width / 2, width, width, pose)
        face, _ = trace(geometry, pose[:3, 3], ways.reshape(-1, 3))
        if not room.emission[face[face >= 0]].any():
            unseen.append((pose[:3, 3], pose[:3, 3] + pose[:3, 2]))
    if len(unseen) < VIEWS:
        raise InputError(f"{room.name}: only {len(unseen)} of 200 cameras see no lamp; needed: {VIEWS}")
    chosen = np.linspace(0, len(unseen) - 1, VIEWS).astype(int)
    return replace(room, shots=np.array([unseen[i] for i in chosen]))


def taken_of(room: str, variant: str, folder: Path) -> Taken:
    """Return a capture of a room as a person has it."""
    capture = capture_of(room, "as_captured" if variant == "other_light" else variant, folder)
    vertices, faces = capture.mesh()
    columns = capture.faces()
    shines = np.stack([columns[f"emission_{c}"] for c in "rgb"], 1).any(1)
    sources = {view.name: (capture, view) for view in capture.views}
    if variant == "other_light":
        dimmed = capture_of(room, "other_light", folder)
        sources |= {view.name: (dimmed, view) for view in dimmed.views if int(view.name) % 2 and view.name in sources}
    photos = [np.rint(255 * np.clip(reader.photo(view, held_out=True)[0], 0, 1)) for reader, view in sources.values()]
    return Taken(
        list(sources),
        [photo.astype(np.uint8) for photo in photos],
        [np.asarray(view.world_from_camera, np.float64) for view in capture.views],
        [view.fx for view in capture.views],
        [view.split == "test" for view in capture.views],
        vertices.astype(np.float64),
        faces,
        shines,
    )


def write_folder(taken: Taken, folder: Path) -> None:
    """Write photographs, transforms.json and mesh.ply."""
    import trimesh
    from PIL import Image

    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    frames = []
    for name, photo, pose, fl in zip(taken.names, taken.photos, taken.poses, taken.focal, strict=True):
        Image.fromarray(photo).save(folder / f"images/{name}.png")
        camera = {"fl_x": fl, "fl_y": fl, "cx": SIZE / 2, "cy": SIZE / 2, "w": SIZE, "h": SIZE}
        frames.append({"file_path": f"images/{name}.png", **camera, "transform_matrix": (pose @ taken.axes).tolist()})
    held = [frame["file_path"] for frame, out in zip(frames, taken.held_out, strict=True) if out]
    document = {"camera_model": "PINHOLE", "test_filenames": held, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    trimesh.Trimesh(taken.vertices, taken.faces, process=False).export(folder / "mesh.ply", vertex_normal=False)


# ------------------------------------------------------------------------------------------------------------- judging


def evidence(loose: Loose) -> Evidence:
    """Return what the report knows of a result, without the stages that write files for other programs."""
    from workflow.exporters.object_table import csv_bytes, read_csv, recovered_objects
    from workflow.report.evidence import evidence_of
    from workflow.report.reported import Reported
    from workflow.scene.base_scene import read_base
    from workflow.scene.recovered import read_recovered

    job = loose.job("render")
    readers = {stage: loose.open(stage) for stage in STAGES}
    recovered = read_recovered(job)
    objects = recovered_objects(recovered, readers["affines"], readers["segmentation"].table("objects.parquet"))
    rows, summary = read_csv(csv_bytes(objects)), readers["metrics"].json("summary.json")
    readers |= {"export": readers["emission"], "base": read_base(job)}
    return evidence_of(Reported(readers, CaptureReader(readers["capture"]), recovered, summary, rows))


def truth(loose: Loose, room_name: str, variant: str, moved: Array) -> dict[str, float]:
    """Compare the result with the room.

    Args:
        loose: the finished stages.
        room_name: of the room.
        variant: of the capture that was spoilt (`capture_of`).
        moved: (4, 4) by which the spoilt mesh was moved.

    Returns:
        offset: how far photographs and mesh are apart, median over pixels, third quartile of the photographs, as a share of
            the width.
        missing: share of the area of the room that the mesh lacks within `NEAR`.
        albedo, albedo_scaled: root mean square error of the albedo that photographs show, weighted by pixels, without lamps and
            mirrors, as it is, and with one factor on all of it; level: geometric mean of albedo over true albedo.
        false_m2: area that is taken for a lamp and is none, m^2 of the true room; false_power: its share of the power of what was
            found; missed_power: share of the power of the true lamps whose surface was not taken for a lamp.
    """
    from iif_core.surface.closest import closest_points
    from iif_core.surface.triangles import face_geometry
    from workflow.scene.base_scene import read_base
    from workflow.scene.recovered import read_recovered

    job = loose.job("render")
    recovered, cells = read_recovered(job), read_base(job).table("cells.parquet", ("coverage",))
    room = room_of(room_name, "as_captured")
    scan = room.scan
    lit = scan.emission.any(1) | np.isin(scan.material_id, list(room.scanned))  # light passes through blinds and curtains
    back = np.linalg.inv(moved)

    def true(points: Array) -> Array:
        return points @ back[:3, :3].T + back[:3, 3]

    at, face, _ = closest_points(scan.vertices, scan.faces, true(recovered.cell_centres))
    albedo, roughness, _ = room.materials.numpy(at, scan.material_id[face])
    found = recovered.surface.cell_values[:, :3].astype(np.float64)
    kept = (cells["coverage"] > 0) & ~lit[face] & (roughness >= MIRROR_ROUGHNESS) & (albedo.mean(1) > 0.01)
    out = _albedo_errors(found[kept], np.asarray(albedo, np.float64)[kept], cells["coverage"][kept].astype(np.float64))

    surface, shines = recovered.surface, np.flatnonzero(recovered.emitter_id >= 0)
    lamps = lamps_found(
        room, surface.vertices, surface.faces[shines], recovered.light.radiance.mean(1)[shines], list(room.scanned), back
    )
    out |= {"false_m2": lamps.false_m2(), "false_power": lamps.false_power(), "missed_power": lamps.missed_power()}
    area = face_geometry(scan.vertices, scan.faces)[1]
    some = np.random.default_rng(0).choice(len(area), 4000, p=area / area.sum())
    gone = away(true(surface.vertices), surface.faces, scan.vertices[scan.faces[some]].mean(1), NEAR)
    capture = CaptureReader(loose.open("capture"))
    return out | {"missing": float(gone.mean()), "offset": _offset(capture, room_of(room_name, variant), true)}


def _albedo_errors(found: Array, albedo: Array, weight: Array) -> dict[str, float]:
    factor = (weight[:, None] * found * albedo).sum() / max((weight[:, None] * found**2).sum(), 1e-12)
    ratio = np.log(np.maximum(found.mean(1), 1e-3)) - np.log(albedo.mean(1))
    return {
        "albedo": float(np.sqrt(np.average(((found - albedo) ** 2).mean(1), weights=weight))),
        "albedo_scaled": float(np.sqrt(np.average(((factor * found - albedo) ** 2).mean(1), weights=weight))),
        "level": float(np.exp(np.average(ratio, weights=weight))),
    }


def _offset(capture: CaptureReader, room: Any, true: Callable[[Array], Array]) -> float:
    """Return how far what a photograph shows is from where its camera sees it on the mesh, as a share of the width."""
    from iif_core.camera.pinhole import project

    poses, lens, of_view = room.cameras(VIEWS), 0.5 * SIZE / np.tan(np.radians(room.field_of_view / 2)), []
    for view in capture.views:
        depth, face = capture.gbuffer(view)
        row, column = np.nonzero(face >= 0)
        points = true(view.points(depth, np.float64)[row, column])
        u, v, z = project(points, lens, lens, SIZE / 2, SIZE / 2, poses[int(view.name)])
        apart = np.hypot(u - column - 0.5, v - row - 0.5)
        of_view.append(np.median(np.where((z > 0) & np.isfinite(apart), apart, np.inf)) / SIZE if len(row) else np.inf)
    return float(np.quantile(of_view, 0.75, method="higher"))


FACTS = {field.name: str(field.type) for field in dataclasses.fields(Evidence) if field.name != "worst"}  # words alone
TRUTH = ("offset", "missing", "albedo", "albedo_scaled", "level", "false_m2", "false_power", "missed_power")
LIGHTS = ("geometry", "light", "materials", "scale")
COLUMNS = (
    *("room", "spoil", "status", "reason", "seconds", "verdict"),
    *LIGHTS,
    *(f"true_{name}" for name in TRUTH),
    *(f"saw_{name}" for name in FACTS),
)


def case_row(room: str, spoil: str, folder: Path) -> dict[str, Any]:
    """Make a capture and its result, unless they are there, and return its row; a refusal of the product is one, too."""
    change, variant = SPOILS[spoil]
    place = folder / "cases" / f"{room}-{spoil}"
    native.prepare()
    device.mitsuba()
    row: dict[str, Any] = {"room": room, "spoil": spoil, "status": "done"}
    number = list(SPOILS).index(spoil)
    taken = change(taken_of(room, variant, folder), np.random.default_rng([number, len(room), *room.encode()]))
    begin = time.process_time()
    folder_of = place / "folder"
    capture = {"width": SIZE, "height": SIZE, "exposure": "estimate"}
    settings = {"source": {"kind": "folder", "path": str(folder_of)}, "capture": capture}
    loose = Loose(place, document_of(settings))
    try:
        if not (place / "metrics/manifest.json").exists():
            write_folder(taken, folder_of)
            for stage in STAGES:
                job = loose.job(stage)
                importlib.import_module(job.stage.module).run(job)
                job.writer.finish()
        found = evidence(loose)
    except InputError as error:
        return row | {"status": "refused", "reason": str(error)[:200], "seconds": round(time.process_time() - begin, 1)}
    row |= {f"saw_{name}": getattr(found, name) for name in FACTS if name != "warnings"}
    row["saw_warnings"] = json.dumps(list(found.warnings))
    row |= {f"true_{name}": value for name, value in truth(loose, room, variant, taken.moved).items()}
    return row | judged(found) | {"seconds": round(time.process_time() - begin, 1)}


# ------------------------------------------------------------------------------------------------------------- tables

TUNED: dict[str, tuple[float, ...]] = {
    "misfit": (0.04, 0.05, 0.06, 0.08, 0.1),
    "doubtful_area": (0.25, 0.5),
    "uncertainty": (0.1, 0.11, 0.12, 0.15),
    "photographed": (0.6, 0.5, 0.4),
    "agreement": (0.8, 0.7, 0.6),
    "rerendering": (22.0, 20.0, 18.0),
    "light_scale": (1.2, 1.3, 1.4),
}
"""Evidence whose last green value the rows choose -> values that are tried, strictest first. The other thresholds have reasons of
their own."""
HOLDS = 0.95
SEVERE_AREA, SEVERE_SCORE = 1.0, 12.0
"""m^2 of false lamp, and dB of a re-rendering, next to which nothing is green."""


def read_rows(file: Path) -> list[dict[str, Any]]:
    """Return the rows of the file that have a result, with `evidence`, and of each light whether it is `right`."""
    with file.open() as opened:
        rows: list[dict[str, Any]] = [dict(row) for row in csv.DictReader(opened)]
    for row in rows:
        if row["status"] == "done":
            row["evidence"] = _evidence_of(row)
            true = {name: float(row[f"true_{name}"] or "nan") for name in TRUTH}
            true["level_factor"] = max(true["level"], 1 / true["level"])
            row["true"] = true
            row["right"] = {light: all(true[n] <= most for n, most in MEANS[light].within.items()) for light in LIGHTS}
            scores = [s for s in (row["evidence"].held_out, row["evidence"].used) if s is not None]
            row["severe"] = true["false_m2"] >= SEVERE_AREA or min(scores) < SEVERE_SCORE
    return rows


def _evidence_of(row: Mapping[str, str]) -> Evidence:
    values: dict[str, Any] = {}
    for name, kind in FACTS.items():
        text = row.get(f"saw_{name}", "")  # rows of before have not all of it
        if name == "warnings":
            values[name] = [tuple(one) for one in json.loads(text)]
        elif text or kind == "str":
            values[name] = {"bool": lambda t: t == "True", "int": int, "str": str}.get(kind.split(" ")[0], float)(text)
    return Evidence(**values)


@contextmanager
def limits(greens: Mapping[str, float]) -> Iterator[None]:
    """Judge by other last green values."""
    before = dict(LIMITS)
    LIMITS.update({name: Limit(value, *before[name][1:]) for name, value in greens.items()})
    try:
        yield
    finally:
        LIMITS.update(before)


def greens_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
    """Return of each evidence of `TUNED` which lights are green, (values, lights, rows) bool, at each of its values while the
    others have their loosest. A light is green where no finding is worse, so it is green at any values where it is at each."""
    loosest, out = {name: values[-1] for name, values in TUNED.items()}, {}
    for name, values in TUNED.items():
        found = []
        for value in values:
            with limits({**loosest, name: value}):
                colours = [judged(row["evidence"]) for row in rows]
            found.append([[of_row[light] == GREEN for of_row in colours] for light in LIGHTS])
        out[name] = np.array(found)
    return out


def chosen(rows: Sequence[Mapping[str, Any]], greens: Mapping[str, Array]) -> dict[str, float]:
    """Choose the last green values of `TUNED`: of those under which each light is right in `HOLDS` of its greens, and no green is
    next to a severe fault, those under which most right lights of captures that nobody spoilt are green; of equals the strictest.
    `greens`: of these rows."""
    good = np.array([row["spoil"] in GOOD for row in rows])
    right = np.array([[row["right"][light] for row in rows] for light in LIGHTS])
    severe = np.array([row["severe"] for row in rows])
    best, values = (np.inf, 0), ()
    for at in itertools.product(*(range(len(tried)) for tried in TUNED.values())):
        green = np.logical_and.reduce([greens[name][i] for name, i in zip(TUNED, at, strict=True)])
        wrong = np.maximum((green & ~right).sum(1) - (1 - HOLDS) * green.sum(1), 0).sum()
        cost = (right & good & ~green).sum() + 1e3 * (wrong + (green & severe).sum())
        if (cost, sum(at)) < best:
            best, values = (cost, sum(at)), at
    return {name: tried[i] for (name, tried), i in zip(TUNED.items(), values, strict=True)}


def counted(rows: Sequence[Mapping[str, Any]], colours: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    """Count, of each light and colour, the rows (`of`) and those of which green would be true (`right`)."""
    out: dict[str, Any] = {}
    for light in LIGHTS:
        out[light] = {}
        for colour in (GREEN, AMBER, RED):
            mine = [row for row, found in zip(rows, colours, strict=True) if found[light] == colour]
            out[light][colour] = {"of": len(mine), "right": sum(row["right"][light] for row in mine)}
    return out


def left_out(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return the colours of every row by thresholds that the other rooms have made."""
    found: dict[str, dict[str, float]] = {}
    greens = greens_of(rows)
    for room in sorted({row["room"] for row in rows}):
        others = [i for i, row in enumerate(rows) if row["room"] != room]
        found[room] = chosen([rows[i] for i in others], {name: green[..., others] for name, green in greens.items()})
        print(f"without {room}: {found[room]}", file=sys.stderr, flush=True)
    out = []
    for row in rows:
        with limits(found[row["room"]]):
            out.append(judged(row["evidence"]))
    return out


def separation(right: Sequence[bool], value: Sequence[float | None], limit: Limit) -> float | None:
    """Return the probability that a right row has better evidence than a wrong one (area under the curve); None without both."""
    sign = 1 if limit.red >= limit.amber else -1
    good, bad = ([sign * v for r, v in zip(right, value, strict=True) if r == of and v is not None] for of in (True, False))
    if not (good and bad):
        return None
    return float(np.mean([(g < b) + 0.5 * (g == b) for g in good for b in bad]))


def summarise(file: Path) -> None:
    """Judge the rows again, write the counts of the report, and make the tables of the notebook."""
    every = read_rows(file)
    rows = [row for row in every if row["status"] == "done"]
    colours = [judged(row["evidence"]) for row in rows]
    for row, found in zip(rows, colours, strict=True):
        row.update(found)
    with file.open("w", newline="") as opened:
        table = csv.DictWriter(opened, COLUMNS, lineterminator="\n", extrasaction="ignore")
        table.writeheader()
        table.writerows(every)
    found, apart = counted(rows, colours), left_out(rows)
    without = counted(rows, apart)
    document = {
        "captures": len(rows),
        "rooms": len({row["room"] for row in rows}),
        "lights": {light: {**found[light], "left_out": without[light][GREEN]} for light in LIGHTS},
    }
    calibration.FILE.write_text(json.dumps(document, indent=1) + "\n")
    print(f"chosen from all rooms: {chosen(rows, greens_of(rows))}", file=sys.stderr)
    page = PAGE.read_text()
    tables = {
        "lights": _lights_table(rows, colours, apart),
        "evidence": _evidence_table(rows),
        "captures": _captures_table(every),
    }
    for name, text in tables.items():
        head, rest = page.split(f"<!-- table: {name} -->\n", 1)
        page = f"{head}<!-- table: {name} -->\n\n{text}\n<!-- end -->{rest.split('<!-- end -->', 1)[1]}"
    PAGE.write_text(page)


def _lights_table(rows: Sequence[Mapping[str, Any]], colours: Sequence[Any], apart: Sequence[Any]) -> str:
    found, without = counted(rows, colours), counted(rows, apart)
    lines = ["| light | green | right of these | by the other rooms | amber | right | red | right | good captures, green |"]
    lines.append("| --- " + "| ---: " * 8 + "|")
    for light in LIGHTS:
        of, right = (without[light][GREEN][key] for key in ("of", "right"))
        good = [(row, c) for row, c in zip(rows, colours, strict=True) if row["spoil"] in GOOD and row["right"][light]]
        cells = [f"{found[light][c][key]}" for c in (GREEN, AMBER, RED) for key in ("of", "right")]
        green = sum(c[light] == GREEN for _, c in good)
        line = [light, *cells[:2], f"{right} of {of}", *cells[2:], f"{green} of {len(good)}"]
        lines.append("| " + " | ".join(line) + " |")
    return "\n".join(lines) + "\n"


def _evidence_table(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = ["| evidence | " + " | ".join(LIGHTS) + " |", "| --- " + "| ---: " * len(LIGHTS) + "|"]
    for name, limit in LIMITS.items():
        values = [row["evidence"].held_out if name == "rerendering" else getattr(row["evidence"], name, None) for row in rows]
        areas = [separation([row["right"][light] for row in rows], values, limit) for light in LIGHTS]
        if any(area is not None for area in areas):
            lines.append(f"| `{name}` | " + " | ".join("" if area is None else f"{area:.2f}" for area in areas) + " |")
    return "\n".join(lines) + "\n"


def _captures_table(every: Sequence[Mapping[str, Any]]) -> str:
    heads = [
        "capture",
        "room",
        "geometry",
        "light",
        "materials",
        "scale",
        "apart, %",
        "albedo",
        "up to scale",
        "level",
        "false m²",
    ]
    lines = ["| " + " | ".join(heads) + " |", "| --- " * 6 + "| ---: " * (len(heads) - 6) + "|"]
    of = [("offset", 100, ".1f"), ("albedo", 1, ".2f"), ("albedo_scaled", 1, ".2f"), ("level", 1, ".2f"), ("false_m2", 1, ".1f")]
    for row in sorted(every, key=lambda row: list(SPOILS).index(row["spoil"])):
        own = [f"`{row['spoil']}`", row["room"]]
        if row["status"] == "done":
            own += [row[light] for light in LIGHTS] + [format(k * row["true"][name], form) for name, k, form in of]
        lines.append(
            "| " + " | ".join(own if row["status"] == "done" else [*own, row["status"], *[""] * (len(heads) - 3)]) + " |"
        )
    return "\n".join(lines) + "\n"


def judged(found: Evidence) -> dict[str, str]:
    """Return the colours of the verdict and of its lights."""
    verdict = judge(found)
    return {"verdict": verdict.level, **{light.name: light.level for light in verdict.lights}}


def _written(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: f"{value:.5g}" if isinstance(value, float | np.floating) else value for name, value in row.items()}


def _worked(case: tuple[str, str], folder: Path) -> dict[str, Any]:
    try:
        return case_row(*case, folder)
    except Exception as error:  # of the benchmark or the product: the other captures go on
        traceback.print_exc()
        return {"room": case[0], "spoil": case[1], "status": "failed", "reason": f"{type(error).__name__}: {error}"[:200]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--count", type=int, help="captures to have in the file, by default all")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--file", type=Path, default=FILE)
    arguments = parser.parse_args()
    if arguments.folder is None:
        return summarise(arguments.file)
    known = set()
    if arguments.file.exists():
        with arguments.file.open() as file:
            known = {(row["room"], row["spoil"]) for row in csv.DictReader(file)}
    todo = [case for case in cases()[: arguments.count] if case not in known]
    folder = arguments.folder.resolve()
    with arguments.file.open("a", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if not file.tell():
            table.writeheader()

        def keep(row: dict[str, Any]) -> None:
            table.writerow(_written(row))
            file.flush()
            print(" ".join(str(row.get(c, "")) for c in COLUMNS[:10]), [row.get(f"true_{c}") for c in TRUTH], flush=True)

        if arguments.jobs == 1:
            for case in todo:
                keep(_worked(case, folder))
            return
        with ProcessPoolExecutor(arguments.jobs) as pool:
            for one in [pool.submit(_worked, case, folder) for case in todo]:
                keep(one.result())


if __name__ == "__main__":
    main()
