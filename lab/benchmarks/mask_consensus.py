"""View consensus on spoilt masks of rendered scenes: how pure are the objects, and what does it cost?

    python lab/benchmarks/mask_consensus.py results/kitchen/capture results/country-kitchen/capture --output masks.parquet

Reads captures (made by `snakemake results/<scene>/capture/manifest.json`) whose mesh has instance ids. The true masks of every
view are spoilt (tests/unit/spoilt_masks.py: 30 % swallowed by a neighbour, 25 % cut in two), the settings are the defaults.
Purity: share whose true instance is the most frequent one of its object, over the mesh's vertices that are seen; over points
evenly spread on the photographed surface, as the vertices of a scan are; and over pixels. Completeness: the same with the
roles turned, 1 = nothing is in pieces. Rand: the adjusted Rand index. CPU seconds of one thread: `cluster` masks to objects,
`pieces` Felzenszwalb.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.objects.options import ConsensusOptions, PieceOptions
from iif_core.surface.cells import grid_origin, pack_keys, voxel_indices
from iif_core.surface.segments import partition_agreement
from tests.unit.spoilt_masks import purity, spoil_masks
from workflow.artifacts import StageReader
from workflow.artifacts.files import write_parquet
from workflow.scene.normal_form import CaptureReader
from workflow.segmentations import masks
from workflow.segmentations.geometry import pieces
from workflow.segmentations.surface import Surface


def spread_faces(surface: Surface, edge: float) -> np.ndarray:
    """Face of one photographed point of every voxel."""
    capture, origin = surface.capture, grid_origin(surface.vertices, edge)
    keys, faces = [], []
    for view in capture:
        depth, face = capture.gbuffer(view)
        hit = face >= 0
        keys.append(pack_keys(voxel_indices(capture.points(view, depth)[hit], edge, origin)))
        faces.append(face[hit])
    return np.concatenate(faces)[np.unique(np.concatenate(keys), return_index=True)[1]]


def measure(folder: Path, seed: int, split: float, merge: float) -> dict[str, float | int | str]:
    """One row: a scene, a seed."""
    capture = CaptureReader(StageReader(folder, "capture", folder.parent.name))
    surface = Surface(capture)
    instance, pixels = capture.faces()["instance_id"], surface.pixels()
    thing = np.unique(instance, return_inverse=True)[1]
    rng, labels, parts = np.random.default_rng(seed), {}, []
    for view in capture:
        face = capture.gbuffer(view)[1]
        labels[view.name] = spoil_masks(np.where(face >= 0, instance[face], -1), rng, split, merge)
        parts.append(len(np.unique(labels[view.name])) - 1)
    start = time.process_time()
    piece = pieces(surface, PieceOptions(min_faces=masks.MIN_FACES))
    middle = time.process_time()
    found = masks.cluster_views(surface, surface.views(), lambda view: labels[view.name], ConsensusOptions(), piece)
    end = time.process_time()
    seen = pixels > 0
    vertex, corner = np.unique(surface.faces[seen].ravel(), return_index=True)
    of_vertex = np.flatnonzero(seen)[corner // 3]
    spread = spread_faces(surface, masks.POINT_FOOTPRINTS * masks._footprint(surface.decoded, surface.views()))
    row: dict[str, float | int | str] = {"scene": folder.parent.name, "seed": seed, "views": len(capture.views)}
    row |= {"masks_a_view": float(np.mean(parts)), "things": len(np.unique(instance[seen]))}
    row |= {"objects": len(np.unique(found.object_of_face[seen])), "faces": len(surface.faces), "vertices_seen": len(vertex)}
    for name, at, weight in (("vertices", of_vertex, None), ("surface", spread, None), ("pixels", seen, pixels[seen])):
        here, true = found.object_of_face[at], thing[at]
        row[f"purity_{name}"], row[f"complete_{name}"] = purity(here, true, weight)
        row[f"rand_{name}"] = partition_agreement(here, true, np.ones(len(here)) if weight is None else weight)[0]
    return row | {"cpu_pieces": middle - start, "cpu_cluster": end - middle}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--split", type=float, default=0.25)
    parser.add_argument("--merge", type=float, default=0.3)
    options = parser.parse_args()
    rows = []
    for folder in options.captures:
        for seed in range(options.seeds):
            rows.append(measure(folder, seed, options.split, options.merge))
            print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    if options.output:
        write_parquet(options.output, {name: np.array([row[name] for row in rows]) for name in rows[0]}, {})


if __name__ == "__main__":
    main()
