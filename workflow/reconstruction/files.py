"""What stage reconstruction writes for people and for the capture: cameras, mesh, a picture of both."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import numpy as np

from iif_core.reconstruction.sweep import Picture
from iif_core.reconstruction.walls import Walls
from workflow.reconstruction.cameras import Sparse

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
SHOWN = 6  # depth maps in the picture
_DOTS = 30_000
_CELL = 0.05  # metres


def transforms_json(sparse: Sparse) -> bytes:
    """Return transforms.json of nerfstudio, with OpenGL axes, pixel centres at half-integers and a camera for each photograph."""
    frames = []
    for name, camera, k1, pose in zip(sparse.names, sparse.pinholes, sparse.radial, sparse.world_from_camera, strict=True):
        own = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        frames.append({"file_path": name, **own, "k1": float(k1), "transform_matrix": (pose @ OPENGL).tolist()})
    document = {"camera_model": "OPENCV", "pixel_centres_at": "half", "frames": frames}
    return (json.dumps(document, indent=1) + "\n").encode()


def _seen_edge_on(points: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles (k, 2) of the cells of a plan in which points (n, 2) lie, and the share of each that is `found` (n,)."""
    cells, of = np.unique(np.floor(points / _CELL).astype(int), axis=0, return_inverse=True)
    return (cells + 0.5) * _CELL, np.bincount(of.ravel(), found, len(cells)) / np.bincount(of.ravel(), minlength=len(cells))


def overview_png(
    sparse: Sparse, vertices: np.ndarray, walls: Walls, pictures: Sequence[Picture], depths: Sequence[np.ndarray]
) -> bytes:
    """Draw the plan and a side view of mesh, added walls and cameras, and photographs beside their depth."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    colours = LinearSegmentedColormap.from_list("built to found", ["tab:orange", "tab:green"])
    figure = Figure(figsize=(12, 9), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subfigures(2, 1, height_ratios=(3, 2))
    centre, ahead = sparse.world_from_camera[:, :3, 3], sparse.world_from_camera[:, :3, 2]
    dots = vertices[:: max(1, len(vertices) // _DOTS)]
    middle, normal = walls.vertices[walls.faces].mean(1), walls.sides.normal[walls.side]
    level, across = np.abs(normal[:, 2]) >= 0.5, np.abs(normal[:, 1]) < 0.5
    for axes, (i, j), title, cut in zip(
        above.subplots(1, 2), ((0, 1), (0, 2)), ("from above", "from the side"), (~level, level | across), strict=True
    ):
        place, share = _seen_edge_on(middle[cut][:, [i, j]], walls.found[cut])
        sides = axes.scatter(*place.T, c=share, s=4, cmap=colours, vmin=0, vmax=1)
        axes.plot(dots[:, i], dots[:, j], ",", color="0.4", label="surface that photographs show")
        axes.quiver(centre[:, i], centre[:, j], ahead[:, i], ahead[:, j], color="tab:blue", width=0.003, label="camera")
        axes.set(aspect="equal", xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[j]} (m)", title=title)
    above.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, markerscale=6)
    bar = above.colorbar(sides, ax=above.axes, shrink=0.6, ticks=(0, 1))
    bar.set_ticklabels(["built", "found"])
    bar.set_label("flat sides: share where surface was found", fontsize=8)
    shown = np.unique(np.linspace(0, len(pictures) - 1, SHOWN).round().astype(int))
    rows = below.subplots(2, len(shown), squeeze=False)
    far = float(np.nanquantile(np.concatenate([z[::4, ::4].ravel() for z in depths]), 0.98))
    for column, view in enumerate(shown):
        rows[0, column].imshow(pictures[view].grey, cmap="gray", vmin=0, vmax=1)
        rows[0, column].set_title(sparse.names[view][-24:], fontsize=8)
        drawn = rows[1, column].imshow(depths[view], cmap="viridis", vmin=0, vmax=far)
        for axes in rows[:, column]:
            axes.set_axis_off()
    below.colorbar(drawn, ax=rows[1, :], label="depth (m)")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()
