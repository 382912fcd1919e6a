"""Cameras of photographs by COLMAP's incremental structure from motion, through pycolmap, on the CPU."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from iif_core.camera.distortion import Distortion, Pinhole, undistort_image
from iif_core.errors import InputError
from iif_core.numerics.color import key_exposure, tone_map
from iif_core.reconstruction.sweep import Picture
from workflow.sources.folder_scene import images

LONGEST = 1600
"""Pixels along the longer side at which photographs are compared; features of more are hardly placed better."""
FEATURES = 4096
"""Largest number of a photograph."""
EVERY_PAIR = 150
"""Photographs up to which each is compared with each; of more, each with those next to it in the order of their names."""
BESIDE = 20
INLIERS = 50, 0.4
"""Points that must agree on the place of a photograph, and their share (COLMAP: 30 and 0.25): fewer agree on wrong places where
bricks and tiles repeat."""
REPROJECTED = 1.5
"""Pixels of the copies between a feature and its point, beyond which the two are not of each other (COLMAP: 4): matches that
are a little wrong, as along bricks, bend a ring of cameras."""
FAINT = 0.002
"""Least contrast of a feature (COLMAP: 0.0067) where too few photographs hang together without: rooms of plain walls have few."""
ENOUGH = 0.9
"""Share of the photographs with a camera from which on fainter features are not looked for: they take longer, and what is found
without them is as right."""
RANGES = 8
"""Names, or first and last names, that a message lists."""
LEAST, LEAST_SHARE = 3, 0.5
"""Photographs that must hang together, and share of all."""
_SEED = 0

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Sparse:
    """Cameras that were found, and the points by which they were.

    Attributes:
        names: (v) of the photographs.
        pinholes, radial: (v) cameras at the full size of the upright photographs, and k1 of their lenses.
        camera_from_world: (v, 3, 4) OpenCV axes, in a frame and unit of their own.
        points: (p, 3).
        point, view: (n,) observations.
        left_out: name -> why it has no camera.
    """

    names: list[str]
    pinholes: list[Pinhole]
    radial: np.ndarray
    camera_from_world: np.ndarray
    points: np.ndarray
    point: np.ndarray
    view: np.ndarray
    left_out: dict[str, str]

    @property
    def world_from_camera(self) -> np.ndarray:
        """(v, 4, 4)."""
        rotation = self.camera_from_world[:, :, :3].transpose(0, 2, 1)
        out = np.tile(np.eye(4), (len(self.names), 1, 1))
        out[:, :3, :3] = rotation
        out[:, :3, 3] = -np.einsum("vij,vj->vi", rotation, self.camera_from_world[:, :, 3])
        return out

    def without(self, gone: Sequence[int], why: str) -> Sparse:
        """Return the same without some views."""
        kept = np.setdiff1d(np.arange(len(self.names)), np.asarray(gone, np.int64))
        number = np.full(len(self.names), -1)
        number[kept] = np.arange(len(kept))
        own = number[self.view] >= 0
        return replace(
            self,
            names=[self.names[i] for i in kept],
            pinholes=[self.pinholes[i] for i in kept],
            radial=self.radial[kept],
            camera_from_world=self.camera_from_world[kept],
            point=self.point[own],
            view=number[self.view][own],
            left_out=self.left_out | {self.names[i]: why for i in gone},
        )

    def placed(self, turn: np.ndarray, shift: np.ndarray, scale: float) -> Sparse:
        """Return the same in the frame x' = scale (turn x + shift)."""
        rotation = self.camera_from_world[:, :, :3] @ turn.T
        centre = (self.world_from_camera[:, :3, 3] @ turn.T + shift) * scale
        moved = np.concatenate([rotation, -np.einsum("vij,vj->vi", rotation, centre)[..., None]], -1)
        return replace(self, camera_from_world=moved, points=(self.points @ turn.T + shift) * scale)


def find_cameras(root: Path, names: Sequence[str], colour: str, progress: Progress) -> Sparse:
    """Find the cameras of photographs, in one thread: which of several is the first to end would change numbers, and cameras.

    Args:
        root: folder that the names count from.
        names: of the photographs. Those of one size, model of camera and focal length by EXIF are of one camera.
        colour: `source.colour`.
        progress: called with what is done, of how many, and what it is.

    Raises:
        InputError: too few hang together.
    """
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    with tempfile.TemporaryDirectory(prefix="iif-") as folder:
        work, cameras = Path(folder) / "images", Counter()
        sizes = []
        for number, name in enumerate(names):
            sizes.append(_working_copy(root / name, work, number, cameras, colour))
            progress(number + 1, len(names), "photographs read")
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1
        options.random_seed = _SEED
        options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = INLIERS
        options.mapper.filter_max_reproj_error = REPROJECTED
        options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = REPROJECTED
        groups: list[Any] = []
        for faint in (False, True):
            sparse, database = Path(folder) / f"sparse{faint:d}", Path(folder) / f"{faint:d}.db"
            sparse.mkdir()
            pycolmap.set_random_seed(_SEED)
            _compare(database, work, len(names), faint, progress)
            found = pycolmap.incremental_mapping(database, work, sparse, options).values()
            groups = max(groups, sorted(found, key=_size, reverse=True), key=lambda own: _size(own[0]) if own else (0, 0))
            if groups and groups[0].num_reg_images() >= ENOUGH * len(names):
                break
    count = groups[0].num_reg_images() if groups else 0
    least = max(LEAST, int(np.ceil(LEAST_SHARE * len(names))))
    if count < least:
        raise InputError(
            f"{root}: {count} of {len(names)} photographs hang together; at least {least} must. {_told(groups, names)}"
        )
    return _plain(groups[0], names, sizes)


def _size(model: Any) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _told(groups: Sequence[Any], names: Sequence[str]) -> str:
    """Say which photographs hang together, and what to do: `IMG_1 to IMG_8, IMG_20`."""
    found = [ranges({int(Path(image.name).stem) for image in own.images.values() if image.has_pose}, names) for own in groups]
    rule = (
        "each of which shows most of what another shows, from another place (not only turned), sharp, and of things with texture"
        " (docs/guide/programs.md#photographs-alone)"
    )
    if len(found) > 1:
        return (
            f"They fall into {len(found)} groups: {'; '.join(found)}. Take more photographs between the groups, {rule}; or leave"
            " those of one group alone in the folder, for that part of the room"
        )
    return f"{f'These do: {found[0]}. ' if found else ''}Take more of them, {rule}"


def ranges(places: Collection[int], names: Sequence[str]) -> str:
    """Return names by their place in the order of all, those that follow each other as `first to last`; of many, some.

    >>> ranges({0, 1, 2, 4}, ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"])
    'a.jpg to c.jpg, e.jpg'
    """
    ordered, out = sorted(places), []
    starts = [i for i, place in enumerate(ordered) if not i or place != ordered[i - 1] + 1]
    for first, end in zip(starts, [*starts[1:], len(ordered)], strict=False):
        own = [names[ordered[first]], names[ordered[end - 1]]]
        out.append(own[0] if end - first == 1 else " to ".join(own))
    return ", ".join([*out[:RANGES], *([f"{len(out) - RANGES} more"] if len(out) > RANGES else [])])


def _compare(database: Path, work: Path, count: int, faint: bool, progress: Progress) -> None:
    """Find features and matches of the working copies, into COLMAP's database; `faint`: also features of little contrast, and
    more matches along the lines on which those that are found allow them."""
    import pycolmap

    cpu = pycolmap.Device.cpu
    extraction, matching, reader = (
        pycolmap.FeatureExtractionOptions(),
        pycolmap.FeatureMatchingOptions(),
        pycolmap.ImageReaderOptions(),
    )
    extraction.num_threads = matching.num_threads = 1
    extraction.sift.max_num_features = FEATURES
    if faint:
        extraction.sift.peak_threshold, matching.guided_matching = FAINT, True
    reader.camera_model = "SIMPLE_RADIAL"
    by_folder = pycolmap.CameraMode.PER_FOLDER
    progress(0, count, "fainter features" if faint else "features")
    pycolmap.extract_features(
        database, work, camera_mode=by_folder, reader_options=reader, extraction_options=extraction, device=cpu
    )
    progress(0, count, "photographs compared")
    if count <= EVERY_PAIR:
        pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
    else:
        # By number: COLMAP's own order is that of the folders, one for each camera.
        copies = sorted(work.rglob("*.jpg"), key=lambda path: path.stem)
        places = [path.relative_to(work).as_posix() for path in copies]
        pairs = [f"{a} {b}" for i, a in enumerate(places) for b in places[i + 1 : i + 1 + BESIDE]]
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(database.with_name("pairs.txt"))
        Path(pairing.match_list_path).write_text("\n".join(pairs) + "\n")
        pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=pairing, device=cpu)
    progress(0, count, "cameras placed")


def _plain(model: Any, names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> Sparse:
    """Return what COLMAP found as arrays, with cameras at the size (width, height) of the photographs."""
    number = {key: i for i, key in enumerate(sorted(model.points3D))}
    points = np.array([model.points3D[key].xyz for key in number]).reshape(-1, 3)
    posed = sorted((int(Path(image.name).stem), image) for image in model.images.values() if image.has_pose)
    pinholes, radial, poses, point, view = [], [], [], [], []
    for own, (place, image) in enumerate(posed):
        camera, (width, height) = model.cameras[image.camera_id], sizes[place]
        sx, sy = width / camera.width, height / camera.height
        focal, cx, cy, k1 = (float(value) for value in camera.params)
        pinholes.append(Pinhole(focal * sx, focal * sy, cx * sx, cy * sy, width, height))
        radial.append(k1)
        poses.append(image.cam_from_world().matrix())
        seen = [number[p.point3D_id] for p in image.points2D if p.has_point3D()]
        point += seen
        view += [own] * len(seen)
    there = {place for place, _ in posed}
    left_out = {name: "it shares too little with the others" for i, name in enumerate(names) if i not in there}
    return Sparse(
        [names[place] for place, _ in posed],
        pinholes,
        np.array(radial),
        np.array(poses, np.float64),
        points,
        np.array(point, np.int64),
        np.array(view, np.int64),
        left_out,
    )


def _working_copy(path: Path, work: Path, number: int, cameras: Counter[Any], colour: str) -> tuple[int, int]:
    """Write a photograph upright, in sRGB and reduced, into a folder for its camera, with its EXIF, by which COLMAP knows the
    focal length; return the size (width, height) of the whole."""
    header = images.header(path)
    photo = images.load_photo(path, header.orientation, colour=colour)
    height, width = photo.valid.shape
    picture = _shown(path, photo, *images.fitted_size(width, height, LONGEST, LONGEST))
    exif, lens = images.exif_upright(path)
    key = (width, height, lens)
    folder = work / f"{list(cameras).index(key) if key in cameras else len(cameras):03d}"
    cameras[key] += 1
    folder.mkdir(parents=True, exist_ok=True)
    levels = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(levels).save(folder / f"{number:06d}.jpg", quality=95, subsampling=0, exif=exif)
    return width, height


def _shown(path: Path, photo: images.Photo, width: int, height: int) -> np.ndarray:
    """(height, width, 3) sensor values of a photograph, or tone-mapped radiance."""
    reduced, valid = images.reduce_area(photo.pixels, photo.valid, width, height)
    return tone_map(reduced, key_exposure(reduced, valid)) if path.suffix.lower() == ".exr" else reduced


def picture_of(root: Path, sparse: Sparse, view: int, longest: int, colour: str) -> Picture:
    """Return a photograph in grey, without distortion, reduced to `longest` pixels, with its camera."""
    path, full = root / sparse.names[view], sparse.pinholes[view]
    photo = images.load_photo(path, images.header(path).orientation, colour=colour)
    width, height = images.fitted_size(full.width, full.height, longest, longest)
    grey = _shown(path, photo, width, height).mean(-1, keepdims=True).astype(np.float32)
    sx, sy = width / full.width, height / full.height
    camera = Pinhole(full.fx * sx, full.fy * sy, full.cx * sx, full.cy * sy, width, height)
    if sparse.radial[view]:
        grey, _ = undistort_image(grey, Distortion("radial_tangential", (sparse.radial[view], 0.0, 0.0, 0.0)), camera, camera)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return Picture(np.ascontiguousarray(grey[..., 0], np.float32), matrix, sparse.camera_from_world[view])
