"""Stage reconstruction: cameras and a mesh of photographs alone (docs/method/reconstruction.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from iif_core.errors import InputError
from iif_core.numerics.parallel import map_in_order
from iif_core.reconstruction.agreement import agreed, votes
from iif_core.reconstruction.flat import flat_depth, textured
from iif_core.reconstruction.frame import RoomFrame, room_frame
from iif_core.reconstruction.fusing import fused_mesh, large_pieces
from iif_core.reconstruction.neighbours import neighbours
from iif_core.reconstruction.sweep import Picture, swept_depth
from iif_core.reconstruction.walls import CLOSES, Walls, flat_walls, turn_to_walls
from iif_core.surface.triangles import face_geometry
from workflow.reconstruction.cameras import Sparse, find_cameras, picture_of, ranges
from workflow.reconstruction.files import overview_png, transforms_json
from workflow.runtime.job import Job
from workflow.sources.folder_scene.frames import folder_at
from workflow.sources.folder_scene.mesh import DIAGONAL
from workflow.sources.photographs import CAMERAS, MESH, POINTS, chosen

NEAREST, FARTHEST = 0.3, 1.25
"""Depths that are searched, over those of the points that a photograph shows: their quantile 0.02, and 0.99."""
LEAST_OF_MEDIAN = 0.05
"""Least depth that is searched, over the median."""
AGREE = 2
"""Depth maps of other photographs that must have the same surface."""
SWEPT, ASKED = 6, 16
"""Photographs with which each one is compared, and those whose depth speaks for or against its flat regions."""
FOR_EACH_AGAINST = 2
"""Depth maps that must show a surface for each one that looks through it."""
NEAR_FLAT = 0.06
"""Relative difference up to which the plane of a region replaces depth that others confirm."""
DOUBTFUL = 0.2
"""Share of a photograph whose depth others confirm, over the median of all, below which its camera is taken for wrong."""
MANY = 0.1
"""Share of photographs without a camera from which a person is warned."""
LEAST_CONFIRMED = 0.1
"""Least share of all pixels whose depth others confirm."""
HELD = 0.5, 2.5
"""Metres above the floor between which people hold cameras."""
VOXELS = 2.0
"""Edge of a voxel in sizes of a pixel on the surface (median)."""


def run(job: Job) -> None:
    """Write transforms.json, mesh.ply, points.parquet, reconstruction.json and overview.png.

    Raises:
        InputError: the photographs do not hang together, or show no surface that several of them agree on.
    """
    source = job.settings.source
    root = folder_at(vars(source), "photographs")
    names = chosen(root, source.most)
    with job.timed("cameras"):
        sparse = find_cameras(root, names, source.colour, job.progress)
    job.log.info("%d of %d photographs have a camera; %d points", len(sparse.names), len(names), len(sparse.points))
    with job.timed("depth"):
        sparse, pictures, depths = _depths(job, sparse, root)
    with job.timed("mesh"):
        footprint = np.median([np.nanmedian(z) / p.intrinsics[0, 0] for z, p in zip(depths.used, pictures, strict=True)])
        vertices, faces = fused_mesh(depths.used, pictures, VOXELS * float(footprint))
        if not len(faces):
            raise InputError(
                f"{root}: no surface on which several photographs agree; take them closer to each other, and of things with"
                " texture (docs/guide/programs.md#photographs-alone)"
            )
        frame = room_frame(vertices, faces, sparse.world_from_camera)
        scale, basis = _metres(source, frame, sparse)
        size = scale * np.linalg.norm(np.ptp(vertices, axis=0))
        if not size <= DIAGONAL[1]:
            raise InputError(
                f"{root}: the room would be {size:.3g} m across (allowed {DIAGONAL[1]:g}): floor and ceiling were not found, or"
                f" `source.{basis}` is in another unit than metres"
            )
        shift = np.array([0.0, 0.0, -frame.floor])
        sparse = sparse.placed(frame.turn, shift, scale)
        vertices = (vertices @ frame.turn.T + shift) * scale
        pictures = [p._replace(camera_from_world=c) for p, c in zip(pictures, sparse.camera_from_world, strict=True)]
        # What is taken for flat looks through nothing: it may reach from a wall over the edge of the ceiling.
        trusted = [z * np.float32(scale) for z in depths.trusted]
        walls, flat = flat_walls(vertices, faces, trusted, pictures, sparse.points)
        if source.room_height is not None and (tall := walls.height()):  # flat sides tell it better than the surface did
            again = source.room_height / tall
            sparse, scale = sparse.placed(np.eye(3), np.zeros(3), again), scale * again
            vertices, walls = vertices * again, walls.scaled(again)
        vertices, faces = large_pieces(vertices, faces, ~flat)
        # Along the axes of the world, as fitted walls tell it better than the normals by which the frame was found.
        turn = turn_to_walls(walls)
        sparse, vertices, walls = sparse.placed(turn, np.zeros(3), 1.0), vertices @ turn.T, walls.turned(turn)
        pictures = [p._replace(camera_from_world=c) for p, c in zip(pictures, sparse.camera_from_world, strict=True)]
    shares = {"depth_share": depths.confirmed, "used_share": [float(np.isfinite(z).mean()) for z in depths.used]}
    facts = _facts(sparse, frame, scale, basis, walls, len(faces), VOXELS * float(footprint) * scale, shares)
    job.writer.bytes(CAMERAS, transforms_json(sparse))
    both = np.concatenate([vertices, walls.vertices]), np.concatenate([faces, walls.faces + len(vertices)])
    job.writer.bytes(MESH, trimesh.Trimesh(*both, process=False).export(file_type="ply"))
    seen = sparse.points[sparse.point].astype(np.float32)
    columns = {name: seen[:, i] for i, name in enumerate("xyz")}
    job.writer.table(POINTS, columns | {"view": sparse.view.astype(np.int32)}, dict.fromkeys("xyz", "m"))
    job.writer.bytes("overview.png", overview_png(sparse, vertices, walls, pictures, [z * scale for z in depths.used]))
    job.writer.json("reconstruction.json", facts)
    for note in facts["notes"]:
        job.log.info("%s", note)


class _Depths(NamedTuple):
    """z-depth (H, W) of each photograph, NaN = unknown, in the unit of the cameras.

    Attributes:
        used: where several agree on texture, or a flat region has it.
        trusted: where several agree on texture.
        confirmed: share of the pixels of each photograph on which several agree.
    """

    used: list[np.ndarray]
    trusted: list[np.ndarray]
    confirmed: list[float]


def _depths(job: Job, sparse: Sparse, root: Path) -> tuple[Sparse, list[Picture], _Depths]:
    """Return the views whose camera others confirm, their pictures and their depth."""
    source = job.settings.source
    count = len(sparse.names)
    pictures = []
    for view in range(count):
        pictures.append(picture_of(root, sparse, view, source.detail, source.colour))
        job.progress(view + 1, count, "photographs reduced")
    beside = neighbours(sparse.point, sparse.view, sparse.points, np.array([p.centre for p in pictures]), ASKED)

    def depth_of(view: int) -> np.ndarray:
        if len(beside[view]) < AGREE:
            return np.full(pictures[view].grey.shape, np.nan, np.float32)
        camera = sparse.camera_from_world[view]
        z = (sparse.points[sparse.point[sparse.view == view]] @ camera[:, :3].T + camera[:, 3])[:, 2]
        near = max(NEAREST * float(np.quantile(z, 0.02)), LEAST_OF_MEDIAN * float(np.median(z)))
        far = FARTHEST * float(np.quantile(z, 0.99))
        return swept_depth(pictures[view], [pictures[i] for i in beside[view][:SWEPT]], near, far)

    swept = []
    for view, depth in enumerate(map_in_order(depth_of, count, job.threads)):
        swept.append(depth)
        job.progress(view + 1, count, "depth maps")
    depths = [
        agreed(swept[view], pictures[view], [(swept[i], pictures[i]) for i in beside[view][:SWEPT]], least=AGREE)
        for view in range(count)
    ]
    share = np.array([np.isfinite(depth).mean() for depth in depths])
    if share.mean() < LEAST_CONFIRMED:
        raise InputError(
            f"{root}: photographs confirm each other's depth on {share.mean():.0%} of their pixels; a mesh needs at least"
            f" {LEAST_CONFIRMED:.0%}. Take more of them, closer to each other, and of things with texture"
            " (docs/guide/programs.md#photographs-alone)"
        )
    gone = np.flatnonzero((share < DOUBTFUL * np.median(share)) | (share == 0))
    kept = np.setdiff1d(np.arange(count), gone)
    trusted = [np.where(textured(picture.grey), z, np.nan) for picture, z in zip(pictures, depths, strict=True)]
    used = _filled(job, pictures, trusted, [[i for i in own if i not in gone] for own in beside])
    why = "others hardly confirm its depth: its camera may be placed wrongly (repeated patterns), or it shows plain walls"
    of_kept = _Depths([used[i] for i in kept], [trusted[i] for i in kept], [float(share[i]) for i in kept])
    return sparse.without(gone, why), [pictures[i] for i in kept], of_kept


def _filled(job: Job, pictures: list[Picture], trusted: list[np.ndarray], beside: list[list[int]]) -> list[np.ndarray]:
    """Return the depths (H, W) of pixels with texture and of flat regions, without what other photographs look through.

    Args:
        trusted: where several agree on texture, NaN elsewhere.
        beside: of each view, those that are asked.
    """
    count = len(trusted)

    def merged_of(view: int) -> np.ndarray:
        own, flat = trusted[view], flat_depth(pictures[view].grey, trusted[view])
        with np.errstate(invalid="ignore"):
            is_flat = np.isfinite(flat) & (np.isnan(own) | (np.abs(flat / own - 1) < NEAR_FLAT))
        return np.where(is_flat, flat, own)

    def kept_of(view: int) -> np.ndarray:
        same, through = votes(merged[view], pictures[view], [(merged[i], trusted[i], pictures[i]) for i in beside[view]])
        enough = np.isfinite(trusted[view]) | (same > 0)
        return np.where(enough & (same >= FOR_EACH_AGAINST * through), merged[view], np.nan).astype(np.float32)

    merged = list(map_in_order(merged_of, count, job.threads))
    return list(map_in_order(kept_of, count, job.threads))


def _metres(source: Any, frame: RoomFrame, sparse: Sparse) -> tuple[float, str]:
    """Return metres per unit, and by what they are known.

    Raises:
        InputError: what they would be known by is not there.
    """
    if source.room_height is not None:
        if not (frame.has_floor and frame.has_ceiling):
            raise InputError(
                f"`source.room_height`: the photographs show no {'floor' if not frame.has_floor else 'ceiling'} on which several"
                " agree, so the height of the room is not known; remove it and give `source.camera_height`, the height above"
                " the floor at which most photographs were taken"
            )
        return source.room_height / max(frame.ceiling - frame.floor, 1e-12), "room_height"
    heights = sparse.world_from_camera[:, :3, 3] @ frame.turn[2] - frame.floor
    return source.camera_height / max(float(np.median(heights)), 1e-12), "camera_height"


def scale_notes(basis: str, tall: float, held: float, frame: RoomFrame) -> list[str]:
    """Say by what the metre is known, and whether it can be right: the room is `tall`, and cameras are `held` (median) above its
    floor, metres."""
    if basis == "camera_height":
        above = "floor" if frame.has_floor else "lowest surface, because no floor was found"
        better = "; source.room_height, from floor to ceiling, is better" if frame.has_floor and frame.has_ceiling else ""
        return [f"scale: guessed, from cameras that are held at source.camera_height above the {above}{better}"]
    said = [f"scale: the room is {tall:.3g} m high (source.room_height), and the cameras are {held:.2g} m above its floor"]
    if not HELD[0] <= held <= HELD[1]:
        said.append(
            f"WARNING cameras {held:.2g} m above the floor are no cameras in hands: is source.room_height in metres, and of this"
            " room?"
        )
    return said


def _facts(
    sparse: Sparse,
    frame: RoomFrame,
    scale: float,
    basis: str,
    walls: Walls,
    faces: int,
    voxel: float,
    shares: dict[str, list[float]],
) -> dict[str, Any]:
    area, count = face_geometry(walls.vertices, walls.faces)[1], len(walls.error)
    found, built = (np.bincount(walls.side[own], area[own], count) for own in (walls.found, ~walls.found))
    planes = [
        {
            "normal": walls.sides.normal[i].round(4).tolist(),
            "from_plane": bool(walls.sides.from_plane[i]),
            "error_m": None if np.isnan(walls.error[i]) else round(float(walls.error[i]), 4),
            "found_m2": round(float(found[i]), 2),
            "added_m2": round(float(built[i]), 2),
        }
        for i in range(count)
    ]
    known = walls.error[np.isfinite(walls.error)]
    tall = walls.height() or (frame.ceiling - frame.floor) * scale
    held = float(np.median(sparse.world_from_camera[:, 2, 3]))
    notes = [
        f"cameras and mesh were found from the photographs: {len(sparse.names)} have a camera, {faces} faces, voxels of"
        f" {1000 * voxel:.3g} mm; depth that several confirm on {np.mean(shares['depth_share']):.0%} of the pixels, on"
        f" {np.mean(shares['used_share']):.0%} with regions of one colour that are taken for flat, and without outlines",
        f"flat sides, floor and ceiling included, take the place of {found.sum():.3g} m2 of surface"
        + (f" that lies within {1000 * known.max():.2g} mm of them (standard deviation)" if len(known) else "")
        + f", and {built.sum():.3g} m2 are built where photographs show no texture",
        *scale_notes(basis, tall, held, frame),
    ]
    if len(known) <= CLOSES * count:
        notes.append(
            f"WARNING the room stays open: flat surface was found on {len(known)} of its {count} sides; show walls and ceiling"
            " too, from several places"
        )
    everything = sorted([*sparse.names, *sparse.left_out])
    for why in dict.fromkeys(sparse.left_out.values()):
        names = [name for name, own in sparse.left_out.items() if own == why]
        own = f"{len(names)} photographs are" if len(names) > 1 else "1 photograph is"
        notes.append(f"{own} left out, {ranges([everything.index(name) for name in names], everything)}: {why}")
    share = len(sparse.left_out) / (len(sparse.left_out) + len(sparse.names))
    if share > MANY:
        notes.append(
            f"WARNING {share:.0%} of the photographs are left out: look for gaps and strays among the cameras in overview.png,"
            " and take more photographs between those that are there"
        )
    return {
        "photographs": len(sparse.names),
        "left_out": sparse.left_out,
        "points": len(sparse.points),
        "scale": {"metres_per_unit": scale, "from": basis},
        "room_height_m": round(tall, 3),
        "voxel_m": voxel,
        **{name: [round(share, 4) for share in values] for name, values in shares.items()},
        "planes": planes,
        "notes": notes,
    }
