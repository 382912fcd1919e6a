"""Do photographs, poses and mesh belong together? Measured, not believed.

With depth images: the mesh's depth in the photograph's camera against the depth image, moved into that camera. Without:
how well edges of the photograph lie on edges of the mesh, against the same picture shifted by a few pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.camera.distortion import Pinhole, undistort
from iif_core.camera.pinhole import pixel_directions, project
from iif_core.errors import InputError
from workflow.sources.folder_scene import images
from workflow.sources.folder_scene.transforms import METRES, Frame, opencv_pose

DEPTH_SAMPLES = 20_000
"""Depth pixels compared a view."""
MIN_COMPARED = 0.2
MIN_POINTS = 20
"""Sparse points that a photograph must see to be compared by them."""
TRIAL_POINTS = 300
TRIAL_VIEWS = 6
TRIAL_WIDTH = 96
EDGE_WIDTH = 160
"""Edges are compared in pictures of at most this width, so that shifts mean the same for any capture size."""
SHIFT = 4
"""Pixels (of such a picture) that the photograph is shifted to either side."""
WEAK_CORRELATION = 0.05
CLEAR_CORRELATION = 0.12
"""Of another reading of the poses, and three times as much as of theirs: then theirs is wrong."""


@dataclass(frozen=True)
class Conventions:
    """How `transform_matrix` is read: `axes`, `metres`, and a change of the matrix before that (None = as written).

    A change of the world (`of_world`) holds for the depth images' own poses too.
    """

    axes: str
    metres: float
    change: Callable[[np.ndarray], np.ndarray] | None = None
    of_world: bool = False

    def pose(self, frame: Frame) -> np.ndarray:
        """`world_from_camera` of the photograph."""
        matrix = self.change(frame.matrix) if self.change else frame.matrix
        return opencv_pose(matrix, self.axes, self.metres)

    def depth_pose(self, frame: Frame) -> np.ndarray:
        """`world_from_camera` of the depth image, where the file gives it its own."""
        if frame.depth_matrix is None:
            return self.pose(frame)
        matrix = self.change(frame.depth_matrix) if self.change and self.of_world else frame.depth_matrix
        return opencv_pose(matrix, "opencv", self.metres)

    def points(self, frame: Frame) -> np.ndarray:
        """(n, 3) sparse points of the photograph in metres."""
        if not (self.change and self.of_world):
            return frame.seen * self.metres
        at = np.tile(np.eye(4), (len(frame.seen), 1, 1))
        at[:, :3, 3] = frame.seen
        return np.array([self.change(m)[:3, 3] for m in at]) * self.metres


def depth_ratio(frame: Frame, conventions: Conventions, view: Pinhole, mesh_depth: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Mesh depth / measured depth (n,) float64 in the photograph's (pinhole) camera `view`, one entry a measured pixel.

    The depth image (H, W, metres, 0 = unknown) is turned into points, and these are looked up in `mesh_depth`, so a
    depth camera beside the colour camera is compared correctly (but for what only one of the two sees: use a median).
    """
    height, width = depth.shape
    step = max(1, int(np.sqrt(depth.size / DEPTH_SAMPLES)))
    rows, columns = np.meshgrid(np.arange(step // 2, height, step), np.arange(step // 2, width, step), indexing="ij")
    z = depth[rows, columns].astype(np.float64).ravel()
    camera = frame.depth_camera or frame.camera
    u = (columns.ravel() + 0.5) * camera.width / width
    v = (rows.ravel() + 0.5) * camera.height / height
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    known = z > 0
    if frame.depth_camera is None and not frame.lens.is_identity:
        at, found = undistort(frame.lens, np.stack([x, y], -1))
        x, y, known = at[:, 0], at[:, 1], known & found
    local = np.stack([x * z, y * z, z], -1)[known]
    pose = conventions.depth_pose(frame)
    points = local @ pose[:3, :3].T + pose[:3, 3]
    return _ratio_at(points, view, conventions.pose(frame), mesh_depth)


def point_ratio(frame: Frame, conventions: Conventions, view: Pinhole, mesh_depth: np.ndarray) -> np.ndarray:
    """Mesh depth / depth of the sparse points that the photograph sees (n,), NaN where no mesh is."""
    return _ratio_at(conventions.points(frame), view, conventions.pose(frame), mesh_depth)


def _ratio_at(points: np.ndarray, view: Pinhole, pose: np.ndarray, mesh_depth: np.ndarray) -> np.ndarray:
    u, v, z = project(points, view.fx, view.fy, view.cx, view.cy, pose)
    inside = (z > 0) & (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    u, v, z = u[inside].astype(int), v[inside].astype(int), z[inside]
    hit = mesh_depth[v, u]
    ratio = np.full(len(inside), np.nan)
    ratio[inside] = np.where(hit > 0, hit / z, np.nan)
    return ratio


def disagreement(ratio: np.ndarray) -> float:
    """Median |mesh depth / measured depth - 1| where both exist; inf when that is less than MIN_COMPARED of the pixels.

    A camera that looks elsewhere, or from very far away, may agree in the few pixels that land on the mesh by chance.
    """
    both = ratio[np.isfinite(ratio)]
    return float(np.median(np.abs(both - 1))) if len(both) and len(both) >= MIN_COMPARED * len(ratio) else float("inf")


def _turned(world: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda matrix: world @ matrix


def _moved(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda matrix: np.concatenate([matrix[:, :3], matrix[:, 3:] * [[factor], [factor], [factor], [1]]], 1)


Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def candidates(axes: str, metres: float, known: bool) -> list[tuple[str, Conventions]]:
    """Other readings of the poses, each with the advice that makes it true. known: the file's format tells the axes."""
    other = "opencv" if axes == "opengl" else "opengl"
    inverse = "the matrices are world-to-camera: write their inverses into transforms.json"
    of_camera = [
        (f"`source.axes: {other}` fits", Conventions(other, metres)),
        (f"{inverse} (axes {axes}) fits", Conventions(axes, metres, np.linalg.inv)),
        (
            f"{inverse} with `source.axes: {other}` fits",
            Conventions(other, metres, np.linalg.inv),
        ),
    ]
    out = [
        *([] if known else of_camera),
        (
            "turning the mesh from y-up to z-up (x, -z, y) fits",
            Conventions(axes, metres, _turned(Z_UP_TO_Y_UP), of_world=True),
        ),
        (
            "turning the mesh from z-up to y-up (x, z, -y) fits",
            Conventions(axes, metres, _turned(Z_UP_TO_Y_UP.T), of_world=True),
        ),
    ]
    for factor in (1000.0, 100.0, 0.01, 0.001):
        text = f"camera positions times {factor:g} fits (mesh and poses are in different units)"
        out.append((text, Conventions(axes, metres, _moved(factor), of_world=True)))
    return out


def explain(
    frames: list[tuple[Frame, Pinhole]],
    trace: Callable[[np.ndarray, np.ndarray], np.ndarray],
    axes: str,
    metres: float,
    known: bool,
    depth_unit: float | None,
    tolerance: float,
) -> str:
    """What would fit the depth images (or sparse points) better, in words; empty when nothing does.

    frames: with either, and their pinhole cameras. trace: (origin, directions (h, w, 3)) -> z-depth (h, w).
    """
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, TRIAL_VIEWS).astype(int))]
    depths = [images.load_depth(frame.depth, depth_unit) if frame.depth else None for frame, _ in chosen]
    some = [replace(f, seen=f.seen[:: max(1, len(f.seen) // TRIAL_POINTS)]) if f.seen is not None else f for f, _ in chosen]
    chosen = [(frame, view) for frame, (_, view) in zip(some, chosen, strict=True)]

    def ratios(conventions: Conventions) -> np.ndarray:
        parts = []
        for (frame, view), depth in zip(chosen, depths, strict=True):
            small = shrunk(view, TRIAL_WIDTH)
            pose = conventions.pose(frame)
            mesh_depth = trace(pose[:3, 3], directions(small, pose))
            parts.append(
                point_ratio(frame, conventions, small, mesh_depth)
                if depth is None
                else depth_ratio(frame, conventions, small, mesh_depth, depth)
            )
        return np.concatenate(parts)

    as_is = ratios(Conventions(axes, metres))
    scores = [(disagreement(ratios(c)), text) for text, c in candidates(axes, metres, known)]
    if np.isfinite(as_is).any() and any(depth is not None for depth in depths):  # sparse points have no metres of their own
        factor = float(np.nanmedian(as_is))
        scores.append((disagreement(as_is / factor), _unit_advice(metres, factor)))
    best, text = min(scores)
    return f"{text} (disagreement {best:.1%})" if best <= min(tolerance, 0.5 * disagreement(as_is)) else ""


def explain_edges(
    trials: list[tuple[Frame, Pinhole, np.ndarray, np.ndarray]],
    trace: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    axes: str,
    metres: float,
    known: bool,
    now: float,
) -> str:
    """Which other reading of the poses brings the mesh's edges onto those of the photographs, in words; empty: none does.

    trials: (frame, pinhole camera, its photograph (h, w, 3), valid (h, w)). trace: (origin, directions (h, w, 3)) ->
    z-depth (h, w) with 0 = miss, unit normals (h, w, 3). now: correlation of the poses as they are read.
    """

    def correlation(conventions: Conventions) -> float:
        found = []
        for frame, camera, photo, valid in trials:
            pose = conventions.pose(frame)
            depth, normal = trace(pose[:3, 3], directions(camera, pose))
            found.append(edge_correlation(photo, valid, depth, normal)[SHIFT, SHIFT] if (depth > 0).any() else 0.0)
        return float(np.mean(found)) if found else 0.0

    best, text = max((correlation(c), text) for text, c in candidates(axes, metres, known))
    return f"{text} (edges correlate {best:.2f}, as read {now:.2f})" if best >= max(CLEAR_CORRELATION, 3 * now) else ""


def _unit_advice(metres: float, factor: float) -> str:
    right = metres / factor
    named = [name for name, value in METRES.items() if abs(value / right - 1) < 0.03]
    unit = named[0] if named else f"{right:.4g}"
    return f"the mesh is {factor:.4g} times as deep as the depth images say: `source.unit: {unit}` fits"


def shrunk(camera: Pinhole, width: int) -> Pinhole:
    """The same camera with fewer pixels."""
    scale = min(1.0, width / camera.width)
    w, h = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return scaled(camera, w, h)


def scaled(camera: Pinhole, width: int, height: int) -> Pinhole:
    """The same camera with width x height pixels; (u + 0.5) coordinates scale about the picture's corner."""
    a, b = width / camera.width, height / camera.height
    return Pinhole(camera.fx * a, camera.fy * b, camera.cx * a, camera.cy * b, width, height)


def directions(camera: Pinhole, pose: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 with camera z 1: distances along them are z-depths."""
    return pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose)


def edge_correlation(photo: np.ndarray, valid: np.ndarray, depth: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Correlation of photograph edges with mesh edges for shifts of the photograph, (2 SHIFT + 1, 2 SHIFT + 1) float64.

    Entry [SHIFT + dy, SHIFT + dx]: mesh pixel (u, v) against photograph pixel (u + dx, v + dy). photo (H, W, 3), valid
    (H, W), depth (H, W) with 0 = miss, normal (H, W, 3) unit. All are reduced to EDGE_WIDTH first. Zeros when the
    picture is too small or has no edges.
    """
    from scipy.ndimage import gaussian_filter

    width, height = images.fitted_size(depth.shape[1], depth.shape[0], EDGE_WIDTH, EDGE_WIDTH)
    photo, valid = images.reduce_area(photo, valid, width, height)
    depth, normal = images.reduce_nearest(depth, width, height), images.reduce_nearest(normal, width, height)
    if min(height, width) < 8 * SHIFT:
        return np.zeros((2 * SHIFT + 1, 2 * SHIFT + 1))
    grey = np.log(0.02 + np.where(valid, photo.mean(-1), 0) / max(float(np.percentile(photo, 99)), 1e-6))
    dv, du = np.gradient(gaussian_filter(grey, 0.7))
    seen = np.where(valid, np.hypot(du, dv), 0)
    mesh = np.zeros((height, width))
    log_depth = np.log(np.where(depth > 0, depth, np.median(depth[depth > 0]) if (depth > 0).any() else 1.0))
    for axis in (0, 1):
        bend = 1 - np.clip((normal * np.roll(normal, -1, axis)).sum(-1), -1, 1)
        jump = np.minimum(np.abs(np.roll(log_depth, -1, axis) - log_depth) * 10, 1)
        edge = np.maximum(bend, jump)
        edge[(-1, slice(None)) if axis == 0 else (slice(None), -1)] = 0
        mesh = np.maximum(mesh, edge)
    seen, mesh = gaussian_filter(np.minimum(seen, 1.0), 1.0), gaussian_filter(mesh, 1.0)
    inner = mesh[SHIFT:-SHIFT, SHIFT:-SHIFT]
    inner = inner - inner.mean()
    out = np.zeros((2 * SHIFT + 1, 2 * SHIFT + 1))
    for dy in range(-SHIFT, SHIFT + 1):
        for dx in range(-SHIFT, SHIFT + 1):
            other = seen[SHIFT + dy : height - SHIFT + dy, SHIFT + dx : width - SHIFT + dx]
            other = other - other.mean()
            norm = np.sqrt((inner**2).sum() * (other**2).sum())
            out[SHIFT + dy, SHIFT + dx] = (inner * other).sum() / norm if norm > 1e-9 else 0.0
    return out


@dataclass
class Alignment:
    """Collects what the views say; `report` for capture.json, `verdict` refuses."""

    ratios: dict[str, np.ndarray]
    edges: dict[str, np.ndarray]
    what: str = "depth images"

    @classmethod
    def empty(cls) -> Alignment:
        return cls({}, {})

    @property
    def depth_disagreement(self) -> float:
        """Median over all compared pixels of all views; inf when depth images are absent or too few pixels meet."""
        return disagreement(np.concatenate(list(self.ratios.values()))) if self.ratios else float("inf")

    def report(self) -> dict[str, Any]:
        """Measured numbers, for capture.json and the notes."""
        out: dict[str, Any] = {}
        if np.isfinite(self.depth_disagreement):
            joined = np.concatenate(list(self.ratios.values()))
            out["depth_median_disagreement"] = round(self.depth_disagreement, 6)
            out["depth_median_ratio"] = round(float(np.nanmedian(joined)), 6)
            out["depth_samples"] = int(np.isfinite(joined).sum())
            each = {name: disagreement(ratio) for name, ratio in self.ratios.items()}
            out["depth_disagreement_of_views"] = {n: round(d, 6) for n, d in each.items() if np.isfinite(d)}
        if self.edges:
            mean = np.mean(list(self.edges.values()), 0)
            dy, dx = np.unravel_index(int(mean.argmax()), mean.shape)
            out["edge_correlation"] = round(float(mean[SHIFT, SHIFT]), 6)
            out["edge_correlation_best"] = round(float(mean.max()), 6)
            out["edge_best_shift"] = [int(dx) - SHIFT, int(dy) - SHIFT]
        return out

    def doubtful(self, tolerance: float) -> list[str]:
        """Views whose own disagreement is above tolerance: one bad pose does not move the median of all."""
        return [name for name, ratio in self.ratios.items() if disagreement(ratio) > tolerance]

    def notes(self, tolerance: float) -> list[str]:
        """The numbers in words."""
        r, out = self.report(), []
        doubtful = self.doubtful(tolerance) if "depth_median_disagreement" in r else []
        if doubtful:
            out.append(f"WARNING alignment: mesh and depth disagree in view(s) {', '.join(doubtful)}: is the pose right?")
        if "depth_median_disagreement" in r:
            out.append(
                f"alignment: mesh depth differs from the {self.what} by {r['depth_median_disagreement']:.2%} (median"
                f" of {r['depth_samples']} pixels)"
            )
        if "edge_correlation" in r:
            dx, dy = r["edge_best_shift"]
            out.append(
                f"alignment: edges of photographs and mesh correlate {r['edge_correlation']:.3f} as posed,"
                f" {r['edge_correlation_best']:.3f} at best (photographs shifted by {dx / EDGE_WIDTH:.1%} to the right,"
                f" {dy / EDGE_WIDTH:.1%} down, of the longer side)"
            )
        return out

    def edge_warning(self) -> str:
        """Words when edges do not lie on edges; empty otherwise."""
        r = self.report()
        if "edge_correlation" not in r:
            return ""
        now, best = r["edge_correlation"], r["edge_correlation_best"]
        shift = max(map(abs, r["edge_best_shift"]))
        if now < WEAK_CORRELATION or (shift >= SHIFT - 1 and best > 1.2 * now):
            return (
                "photographs and mesh may not be aligned: their edges do not lie on each other (correlation"
                f" {now:.3f}, {best:.3f} when shifted by {shift / EDGE_WIDTH:.1%} of the picture); look at the"
                " overlay in the report, check `source.axes`, `source.unit`, that mesh and poses share a frame, and that every"
                " photograph stands with its own pose"
            )
        return ""

    def refuse(self, path: Any, tolerance: float, advice: Callable[[], str]) -> str:
        """The message when depth images contradict the mesh; empty when they agree or there are none."""
        if not self.ratios or self.depth_disagreement <= tolerance:
            return ""
        number = self.depth_disagreement
        found = f"{number:.1%}" if np.isfinite(number) else f"less than {MIN_COMPARED:.0%} of them meet it"
        better = advice()
        return (
            f"{path}: mesh and {self.what} disagree (median relative difference {found}, tolerance {tolerance:.0%})."
            f" {better or 'No usual convention fits: check that mesh, poses and depth belong together'}."
            " To go on anyway: `source.alignment: warn`"
        )


def raise_or_note(message: str, mode: str, notes: list[str]) -> None:
    """`check` raises, `warn` records."""
    if message and mode == "check":
        raise InputError(message)
    if message:
        notes.append("WARNING " + message)
