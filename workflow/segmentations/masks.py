"""Segmentation `masks`: 2D masks of any tool, clustered across the views by view consensus (docs/method/objects.md#masks)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.objects.mask_clustering import MaskPoints, cluster_masks, gather_masks, masks_at
from iif_core.objects.mask_votes import join_objects, label_faces, merge_votes, part_objects, sightings, view_votes
from iif_core.objects.options import ConsensusOptions, PieceOptions
from iif_core.surface.cells import grid_origin, pack_keys, voxel_indices
from iif_core.surface.segments import fill_within
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import View
from workflow.segmentations import sam2
from workflow.segmentations.geometry import pieces
from workflow.segmentations.mask_files import MaskFiles, mask_files
from workflow.segmentations.surface import Objects, Surface
from workflow.settings.options import options_of

PERTURBED = "every third photograph and its masks left out"

MIN_FACES = 20  # of a piece of the mesh where there are no masks; smaller ones join a neighbour
POINT_FOOTPRINTS = 2.0  # edge of the voxels that sample the surface, in median pixel footprints
GAP, GAP_VOXELS = 0.1, 3.0
"""Parts of a cluster further apart than about this distance (metres, but at least that many voxels) are different objects."""

Load = Callable[[View], np.ndarray]


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List every mask file that a scene reads, or the files of the model that makes the masks.

    Raises:
        InputError: no folder, an empty one, names that no view has, sizes that no photograph has; no such model.
    """
    if document["segmentation"]["sam2"] is not None:
        return sam2.raw_inputs(document["segmentation"]["sam2"])
    return mask_files(document["segmentation"], document["source"], document["capture"]).files()


def prepare(job: Job, surface: Surface) -> None:
    """Make the masks with the model, if the settings name one."""
    if job.settings.segmentation.sam2 is not None:
        surface.kept["labels"] = sam2.label_maps(job, surface.capture)


def segment(surface: Surface, settings: SimpleNamespace, fold: int | None = None) -> Objects:
    """Make objects of the masks, and of pieces of the mesh where there are no masks."""
    own = settings.segmentation
    files = None if own.sam2 is not None else MaskFiles.of_capture(settings, surface.capture)
    options = options_of(ConsensusOptions, own)
    if "piece" not in surface.kept:
        surface.kept["piece"] = pieces(surface, options_of(PieceOptions, own, min_faces=MIN_FACES))
    kept = surface.kept.setdefault("labels", {})

    def load(view: View) -> np.ndarray:
        if view.name not in kept:
            labels = files.labels(view)
            kept[view.name] = labels.astype(np.uint16) if labels.max(initial=0) < 2**16 else labels
        return kept[view.name].astype(np.int32)

    return cluster_views(surface, surface.views(fold), load, options, surface.kept["piece"])


def perturbs(surface: Surface) -> bool:
    """Return True: every run leaves out photographs and masks."""
    return True


def cluster_views(surface: Surface, views: list[View], load: Load, options: ConsensusOptions, piece: np.ndarray) -> Objects:
    """Make objects of the label maps of views (Eq. O.8 to O.17).

    Args:
        surface: mesh and photographs.
        views: to use.
        load: view -> (H, W) int label map, 0 = no mask.
        options: of the clustering.
        piece: (m,) piece of the mesh of every face; decides where no mask does.

    Returns:
        The objects.

    Raises:
        InputError: no mask covers enough surface points.
    """
    edge = POINT_FOOTPRINTS * _footprint(surface.decoded, views)
    points = surface_points(surface, views, edge)
    seen = []
    for view in views:
        camera = (view.fx, view.fy, view.cx, view.cy)
        seen.append(masks_at(points, load(view), surface.decoded.gbuffer(view)[0], camera, view.world_from_camera, edge))
    masks = gather_masks(seen, len(points), options.min_points)
    if not len(masks.view):
        raise InputError(
            f"`segmentation: {{kind: masks}}`: no mask of any view covers {options.min_points} surface points"
            f" ({1000 * edge:.3g} mm apart); check that the files hold ids above 0"
        )
    cluster = cluster_masks(masks, options)

    count, known = int(cluster.max(initial=-1)) + 1, cluster >= 0
    number = np.bincount(cluster[known], minlength=count)
    size = np.bincount(cluster[known], np.asarray(masks.in_mask.sum(1)).ravel()[known], count) / np.maximum(number, 1)
    votes = merge_votes(_votes(surface, views, load, masks, cluster, max(GAP, GAP_VOXELS * edge)))
    label, bare, agreeing = label_faces(votes, size, number, piece)
    elected = np.unique(label[label >= 0])
    home = fill_within(label, piece, bare, surface.pairs)
    label, parted, united = _part_and_join(surface, views, load, home, piece)
    label, voted, agreement = _with_origin(label, home, elected, agreeing)
    facts = {
        "masks": len(cluster),
        "masks_undersegmented": int((~known).sum()),
        "clusters": count,
        "objects_from_masks": int(voted.sum()),
        "objects_from_shape": int((~voted).sum()),
        "objects_parted": parted,
        "objects_joined": united,
    }
    return Objects(label.astype(np.int32), None, agreement, facts)


def _with_origin(
    label: np.ndarray, home: np.ndarray, elected: np.ndarray, agreeing: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renumber the final labels (F,) from 0; `home` are the objects before the views parted or joined them.

    Returns the labels, for each object whether masks made it (it is of `elected`), and the mean agreement over its faces.
    """
    label = np.unique(label, return_inverse=True)[1]
    by_masks = np.isin(home, elected)
    own = np.where(by_masks, agreeing[np.where(by_masks, home, 0)], 1.0)
    return label, np.bincount(label, by_masks) > 0, np.bincount(label, own) / np.bincount(label)


def _part_and_join(
    surface: Surface, views: list[View], load: Load, label: np.ndarray, piece: np.ndarray
) -> tuple[np.ndarray, int, int]:
    """Part objects that the views see as several and join those that they see as one (docs/method/objects.md#part-and-join).

    Returns (F,) new objects, and the numbers of objects that parting added and joining removed.
    """
    pieces_in_all = int(piece.max()) + 1
    code, fragment = np.unique(label.astype(np.int64) * pieces_in_all + piece, return_inverse=True)

    def pixels(view: View) -> tuple[np.ndarray, np.ndarray]:
        labels, maps = load(view), surface.decoded.maps(view, photograph=False)
        masked = maps.hit & (labels > 0)
        return fragment[maps.face[masked]], labels[masked]

    seen = sightings(pixels(view) for view in views)
    elected = code // pieces_in_all
    parted = part_objects(elected, seen)
    united = join_objects(parted, seen)
    before, between, after = (len(np.unique(objects)) for objects in (elected, parted, united))
    return united[fragment], between - before, between - after


def surface_points(surface: Surface, views: list[View], edge: float) -> np.ndarray:
    """Return surface points (n, 3) float32 that photographs show, one per voxel of `edge` metres: the first that was seen."""
    keys, points = np.zeros(0, np.uint64), np.zeros((0, 3), np.float32)
    origin = grid_origin(surface.vertices, edge)
    for view in views:
        maps = surface.decoded.maps(view, photograph=False)
        here = maps.points()[maps.hit]
        keys = np.concatenate([keys, pack_keys(voxel_indices(here, edge, origin))])
        keys, first = np.unique(keys, return_index=True)
        points = np.concatenate([points, here])[first]
    return points


def _footprint(decoded: DecodedViews, views: list[View]) -> float:
    """Return the median size of a pixel on the surface, in metres."""
    sizes = []
    for view in views:
        maps = decoded.maps(view, photograph=False)
        sizes.append(np.median(maps.depth[maps.hit]) / view.fx)
    return float(np.median(sizes))


def _votes(surface: Surface, views: list[View], load: Load, masks: MaskPoints, cluster: np.ndarray, gap: float) -> list:
    origin, out = grid_origin(surface.vertices, gap), []
    for i, view in enumerate(views):
        labels, maps = load(view), surface.decoded.maps(view, photograph=False)
        hit, face = maps.hit, maps.face
        table = np.full(max(int(labels.max()), 0) + 1, -1, np.int32)
        mine = masks.view == i
        table[masks.label[mine]] = cluster[mine]
        label = np.maximum(labels[hit], 0)
        of_pixel = table[label]
        key = pack_keys(voxel_indices(maps.points()[hit], gap, origin), of_pixel)
        out.append(view_votes(face[hit], key, of_pixel >= 0, label > 0, len(surface.faces)))
    return out
