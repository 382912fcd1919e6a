"""Pieces of the mesh (segmentation `geometry`): how pure are they, and how many?

    python lab/benchmarks/mesh_pieces.py results/kitchen/capture results/country-kitchen/capture --areas inf 0.003 0.01 0.03

Reads captures (made by `snakemake results/<scene>/capture/manifest.json`) whose mesh has instance ids. Purity: share of the
pixels whose true instance is the most frequent one of their piece; completeness: the same with the roles turned. All settings
but `min_area` are the defaults; `inf`: the number of faces alone counts.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.objects.options import PieceOptions
from tests.unit.spoilt_masks import purity
from workflow.artifacts import StageReader
from workflow.scene.normal_form import CaptureReader
from workflow.segmentations.geometry import pieces
from workflow.segmentations.surface import Surface


def measure(folder: Path, areas: list[float]) -> None:
    """Print a row for every smallest area."""
    capture = CaptureReader(StageReader(folder, "capture", folder.parent.name))
    surface = Surface(capture)
    pixels = surface.pixels()
    seen = pixels > 0
    thing = np.unique(capture.faces()["instance_id"], return_inverse=True)[1][seen]
    for area in areas:
        start = time.process_time()
        piece = pieces(surface, PieceOptions(min_area=area))[seen]
        seconds = time.process_time() - start
        pure, complete = purity(piece, thing, pixels[seen])
        print(
            f"{folder.parent.name}: min_area {area:g}, {len(surface.faces)} faces, {len(np.unique(thing))} things seen, "
            f"{len(np.unique(piece))} pieces seen, {(np.bincount(piece, pixels[seen]) >= 100).sum()} by 100 pixels, "
            f"purity {pure:.3f}, completeness {complete:.3f}, {seconds:.1f} CPU s",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--areas", nargs="+", type=float, default=[np.inf, 0.003, 0.01, 0.03])
    options = parser.parse_args()
    for folder in options.captures:
        measure(folder, options.areas)


if __name__ == "__main__":
    main()
