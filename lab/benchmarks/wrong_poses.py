"""Edges of photographs and mesh: how well do they correlate with right poses, and how well with wrong ones?

    python lab/benchmarks/wrong_poses.py results/kitchen/capture results/redkitchen/capture

Reads captures (made by `snakemake results/<scene>/capture/manifest.json`). Photographs are given the pose of the next, of the
next but one, or of any other; a wrong focal length is made by enlarging the middle of what a camera sees of the mesh. Printed are
the mean correlation with the own pose, that with the poses of the other photographs, and their difference in standard errors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.surface.triangles import face_geometry
from workflow.artifacts import StageReader
from workflow.scene.normal_form import CaptureReader
from workflow.sources.folder_scene.alignment import SHIFT, edge_correlation, edge_pictures, own_and_others

FOCAL = (1.1, 1.5, 2.0)
View = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def views_of(folder: Path) -> list[View]:
    """Return photograph (h, w, 3), usable pixels, depth and normals of every view."""
    capture = CaptureReader(StageReader(folder, "capture", folder.parent.name))
    normals = face_geometry(*capture.mesh())[0]
    out = []
    for view in capture:
        depth, face = capture.gbuffer(view)
        out.append((*capture.photo(view, held_out=True), depth, np.where(face[..., None] >= 0, normals[face], 0)))
    return out


def enlarged(picture: np.ndarray, factor: float) -> np.ndarray:
    """Return the middle of a picture (h, w, ...), enlarged to its size."""
    rows, columns = (((np.arange(n) + 0.5 - n / 2) / factor + n / 2).astype(int) for n in picture.shape[:2])
    return picture[rows][:, columns]


def cases(views: list[View]) -> Iterator[tuple[str, list[View]]]:
    """Return right and wrong captures by what is wrong with them."""
    yield "as it is", views
    other = np.random.default_rng(0).permutation(len(views))
    for name, order in (("next", np.roll(range(len(views)), 1)), ("next but one", np.roll(range(len(views)), 2)), ("any", other)):
        yield f"pose of {name}", [(*views[j][:2], *views[i][2:]) for i, j in enumerate(order)]
    for factor in FOCAL:
        wrong = [(*view[:2], enlarged(view[2], factor), enlarged(view[3], factor)) for view in views]
        yield f"focal length times {factor:g}", wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    print("| capture | photographs | case | own pose | other poses | standard errors |\n|---|---:|---|---:|---:|---:|")
    for folder in parser.parse_args().captures:
        for name, views in cases(views_of(folder)):
            pictures = [edge_pictures(*view) for view in views]
            found = np.mean([edge_correlation(*pair)[SHIFT, SHIFT] for pair in pictures])
            _, others, apart = own_and_others(pictures)
            print(f"| {folder.parent.name} | {len(views)} | {name} | {found:.3f} | {others:.3f} | {apart:.1f} |", flush=True)


if __name__ == "__main__":
    main()
