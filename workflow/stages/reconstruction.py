"""Stage reconstruction: cameras and a mesh of photographs alone (docs/method/reconstruction.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from iif_core.errors import InputError
from iif_core.numerics.parallel import map_in_order
from iif_core.reconstruction.frame import RoomFrame, room_frame
from iif_core.reconstruction.fusing import fused_mesh, large_pieces
from iif_core.reconstruction.neighbours import neighbours
from iif_core.reconstruction.sweep import Picture, agreed, swept_depth
from iif_core.reconstruction.walls import CLOSES, Walls, flat_walls, turn_to_walls
from iif_core.surface.triangles import face_geometry
from workflow.reconstruction.cameras import Sparse, find_cameras, picture_of
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
DOUBTFUL = 0.2
"""Share of a photograph whose depth others confirm, over the median of all, below which its camera is taken for wrong."""
MANY = 0.1
"""Share of photographs without a camera from which a person is warned."""
LEAST_CONFIRMED = 0.1
"""Least share of all pixels whose depth others confirm."""
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
        footprint = np.median([np.nanmedian(z) / p.intrinsics[0, 0] for z, p in zip(depths, pictures, strict=True)])
        vertices, faces = fused_mesh(depths, pictures, VOXELS * float(footprint))
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
        depths = [z * np.float32(scale) for z in depths]
        walls, flat = flat_walls(vertices, faces, depths, pictures, sparse.points)
        vertices, faces = large_pieces(vertices, faces, ~flat)
        # Along the axes of the world, as fitted walls tell it better than the normals by which the frame was found.
        turn = turn_to_walls(walls)
        sparse, vertices, walls = sparse.placed(turn, np.zeros(3), 1.0), vertices @ turn.T, walls.turned(turn)
        pictures = [p._replace(camera_from_world=c) for p, c in zip(pictures, sparse.camera_from_world, strict=True)]
    shares = [float(np.isfinite(z).mean()) for z in depths]
    facts = _facts(sparse, frame, scale, basis, walls, len(faces), VOXELS * float(footprint) * scale, shares)
    job.writer.bytes(CAMERAS, transforms_json(sparse))
    both = np.concatenate([vertices, walls.vertices]), np.concatenate([faces, walls.faces + len(vertices)])
    job.writer.bytes(MESH, trimesh.Trimesh(*both, process=False).export(file_type="ply"))
    seen = sparse.points[sparse.point].astype(np.float32)
    columns = {name: seen[:, i] for i, name in enumerate("xyz")}
    job.writer.table(POINTS, columns | {"view": sparse.view.astype(np.int32)}, dict.fromkeys("xyz", "m"))
    job.writer.bytes("overview.png", overview_png(sparse, vertices, walls, pictures, depths))
    job.writer.json("reconstruction.json", facts)
    for note in facts["notes"]:
        job.log.info("%s", note)


def _depths(job: Job, sparse: Sparse, root: Path) -> tuple[Sparse, list[Picture], list[np.ndarray]]:
    """Return the views whose camera others confirm, their pictures, and z-depth (H, W) where several agree, NaN elsewhere."""
    source = job.settings.source
    count = len(sparse.names)
    pictures = []
    for view in range(count):
        pictures.append(picture_of(root, sparse, view, source.detail, source.colour))
        job.progress(view + 1, count, "photographs reduced")
    beside = neighbours(sparse.point, sparse.view, sparse.points, np.array([p.centre for p in pictures]))

    def depth_of(view: int) -> np.ndarray:
        if len(beside[view]) < AGREE:
            return np.full(pictures[view].grey.shape, np.nan, np.float32)
        camera = sparse.camera_from_world[view]
        z = (sparse.points[sparse.point[sparse.view == view]] @ camera[:, :3].T + camera[:, 3])[:, 2]
        near = max(NEAREST * float(np.quantile(z, 0.02)), LEAST_OF_MEDIAN * float(np.median(z)))
        return swept_depth(pictures[view], [pictures[i] for i in beside[view]], near, FARTHEST * float(np.quantile(z, 0.99)))

    swept = []
    for view, depth in enumerate(map_in_order(depth_of, count, job.threads)):
        swept.append(depth)
        job.progress(view + 1, count, "depth maps")
    depths = [
        agreed(swept[view], pictures[view], [(swept[i], pictures[i]) for i in beside[view]], least=AGREE) for view in range(count)
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
    why = "others hardly confirm its depth: its camera may be placed wrongly (repeated patterns), or it shows plain walls"
    return sparse.without(gone, why), [pictures[i] for i in kept], [depths[i] for i in kept]


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


def _facts(
    sparse: Sparse, frame: RoomFrame, scale: float, basis: str, walls: Walls, faces: int, voxel: float, shares: list[float]
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
    notes = [
        f"cameras and mesh were found from the photographs: {len(sparse.names)} have a camera, {faces} faces, voxels of"
        f" {1000 * voxel:.3g} mm; depth that several confirm on {np.mean(shares):.0%} of the pixels",
        f"flat sides, floor and ceiling included, take the place of {found.sum():.3g} m2 of surface"
        + (f" that lies within {1000 * known.max():.2g} mm of them (standard deviation)" if len(known) else "")
        + f", and {built.sum():.3g} m2 are built where photographs show no texture",
        {
            "room_height": f"scale: the room is {(frame.ceiling - frame.floor) * scale:.3g} m high (source.room_height)",
            "camera_height": "scale: guessed, from cameras that are held at source.camera_height above the "
            + ("floor" if frame.has_floor else "lowest surface, because no floor was found")
            + ("; source.room_height, from floor to ceiling, is better" if frame.has_floor and frame.has_ceiling else ""),
        }[basis],
    ]
    if len(known) < CLOSES * count:
        notes.append(
            f"WARNING the room stays open: flat surface was found on {len(known)} of its {count} sides; show walls and ceiling"
            " too, from several places"
        )
    for why in dict.fromkeys(sparse.left_out.values()):
        names = [name for name, own in sparse.left_out.items() if own == why]
        notes.append(f"{len(names)} photographs are left out, such as {names[0]}: {why}")
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
        "room_height_m": round((frame.ceiling - frame.floor) * scale, 3),
        "voxel_m": voxel,
        "depth_share": [round(share, 4) for share in shares],
        "planes": planes,
        "notes": notes,
    }
