"""xatlas in a process of its own: threads of its task scheduler race, which ends the process in about 1 of 500 calls.

The crash comes whatever the mesh is (a worker calls a task whose group is already gone), so that the same call succeeds when it
is made again.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TRIES = 5


@dataclass(frozen=True)
class Packed:
    """Charts of meshes as xatlas packed them.

    Attributes:
        width, height: texels; 0 where nothing was packed.
        atlases: pictures that were needed.
        charts: number of charts.
        meshes: for each mesh, the given vertex of each new one (v,), the faces (m, 3) of new vertices, their coordinates (v, 2),
            of which 1 is the width or height, and the chart of each new vertex (v,), -1 in none.
    """

    width: int
    height: int
    atlases: int
    charts: int
    meshes: list[tuple[NDArray, NDArray, NDArray, NDArray]]


def pack(meshes: Sequence[tuple[NDArray, NDArray]], padding: int, texels_per_unit: float) -> Packed:
    """Cut meshes into charts and pack these in one picture.

    Args:
        meshes: vertices (n, 3) float32 and faces (m, 3) uint32 of each.
        padding: texels between charts.
        texels_per_unit: of length.

    Raises:
        RuntimeError: xatlas crashed in all of its tries, or said what is wrong.
    """
    for _ in range(_TRIES):
        # By its path, because a child does not know where its parent found the package; -P keeps modules next to it from being
        # taken for others of their name.
        command = [sys.executable, "-P", __file__]
        done = subprocess.run(command, input=pickle.dumps((list(meshes), padding, texels_per_unit)), capture_output=True)
        if done.returncode == 0:
            return Packed(**pickle.loads(done.stdout))
        if done.returncode > 0:  # an error of Python, which another try would meet again
            break
    raise RuntimeError(f"xatlas ended with {done.returncode}: {done.stderr.decode(errors='replace')[-1000:]}")


def _child() -> None:
    """Pack what comes on the standard input, and answer on the standard output."""
    import xatlas

    meshes, padding, texels_per_unit = pickle.load(sys.stdin.buffer)
    atlas = xatlas.Atlas()
    for vertices, faces in meshes:
        atlas.add_mesh(vertices, faces)
    options = xatlas.PackOptions()
    options.padding, options.bilinear = padding, True
    options.texels_per_unit, options.resolution = texels_per_unit, 0
    atlas.generate(xatlas.ChartOptions(), options, False)
    made = []
    if atlas.atlas_count == 1:
        for number in range(len(meshes)):
            chart = np.asarray(atlas.get_mesh_vertex_assignment(number)[1]).astype(np.int32)
            made.append((*atlas.get_mesh(number), chart))
    answer = dict(width=atlas.width, height=atlas.height, atlases=atlas.atlas_count, charts=atlas.chart_count, meshes=made)
    sys.stdout.buffer.write(pickle.dumps(answer))


if __name__ == "__main__":
    _child()
