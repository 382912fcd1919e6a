"""Measures whether photographs, poses and mesh belong together, by measured depth or sparse points and by edges after shifts of a
few pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.camera.distortion import Pinhole, undistort
from iif_core.camera.pinhole import pixel_directions, project
from iif_core.errors import InputError
from iif_core.surface.axes import AS_IS, TURNS, name_of, turn_of
from workflow.settings.source import MESH_UP
from workflow.sources.folder_scene import images
from workflow.sources.folder_scene.camera import METRES, opencv_pose
from workflow.sources.folder_scene.frames import Frame
from workflow.sources.folder_scene.mesh import LEAST_SPREAD

TOLERANCE = 0.05  # largest accepted median relative difference of depth, where depth images or sparse points exist
DEPTH_SAMPLES = 20_000  # depth pixels compared per view
MIN_COMPARED = 0.2  # share of the measured depths that must meet the mesh
MIN_POINTS = 20  # sparse points that a photograph must see to be compared by them
TRIAL_POINTS, TRIAL_VIEWS, TRIAL_WIDTH = 300, 6, 96  # points per view, views and pixels across for trials of other conventions
EDGE_WIDTH = 160  # pixels; edges are compared at this width at most, so that shifts do not depend on the size of the capture
SHIFT = 4  # pixels of such a picture by which the photograph is shifted to either side
WEAK_CORRELATION, WEAK_BESIDE_DEPTH = 0.2, 0.05
"""Edge correlation below which a capture is doubted, and where measured depth agrees, which says more than edges
(docs/method/numerics.md#edges-of-photographs-and-mesh)."""
CLEARLY_OWN = 2.0
"""Standard errors by which photographs must fit the mesh better from their own pose than from those of others."""
COMPARED_VIEWS = 64  # at most so many photographs are compared with the mesh as the others see it
CLEAR_CORRELATION = 0.12
"""Another convention is proposed if its correlation reaches this and three times the correlation of the convention in use."""


Trial = tuple[Frame, Pinhole, np.ndarray, np.ndarray]
"""A photograph on which other conventions are tried: frame, pinhole camera, its pixels (h, w, 3) and valid (h, w)."""


@dataclass(frozen=True)
class Conventions:
    """How `transform_matrix` is interpreted.

    Attributes:
        axes: of the camera, `opengl` or `opencv`.
        metres: per unit.
        change: applied to the matrix before; None = identity.
        of_world: whether `change` concerns the world, and thus also the depth images' own poses and the sparse points.
        mesh_axes: axes of the poses, as axes of the mesh file, by which the mesh was turned when it was read.
    """

    axes: str
    metres: float
    change: Callable[[np.ndarray], np.ndarray] | None = None
    of_world: bool = False
    mesh_axes: str = AS_IS

    def pose(self, frame: Frame) -> np.ndarray:
        """Return `world_from_camera` of the photograph."""
        matrix = self.change(frame.matrix) if self.change else frame.matrix
        return opencv_pose(matrix, self.axes, self.metres)

    def depth_pose(self, frame: Frame) -> np.ndarray:
        """Return `world_from_camera` of the depth image, which may have its own pose."""
        if frame.depth_matrix is None:
            return self.pose(frame)
        matrix = self.change(frame.depth_matrix) if self.change and self.of_world else frame.depth_matrix
        return opencv_pose(matrix, "opencv", self.metres)

    def points(self, frame: Frame) -> np.ndarray:
        """Return the sparse points (n, 3) of the photograph in metres."""
        if not (self.change and self.of_world):
            return frame.seen * self.metres
        at = np.tile(np.eye(4), (len(frame.seen), 1, 1))
        at[:, :3, 3] = frame.seen
        return np.array([self.change(m)[:3, 3] for m in at]) * self.metres


def depth_ratio(frame: Frame, conventions: Conventions, view: Pinhole, mesh_depth: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Compare the depth of the mesh with a depth image.

    The depth image is converted to points, which are looked up in `mesh_depth`. A depth camera next to the colour camera is thus
    compared correctly, except at surface that only one of the two sees.

    Args:
        frame: the photograph and its depth camera.
        conventions: of its poses.
        view: pinhole camera of the photograph.
        mesh_depth: (h, w) z-depth of the mesh in `view`, metres, 0 = miss.
        depth: (H, W) z-depth of the depth image, metres, 0 = unknown.

    Returns:
        (n,) float64 mesh depth / measured depth, one entry per measured pixel; NaN where there is no mesh.
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
    """Compare the depth of the mesh with the depth of the sparse points that the photograph sees.

    Args:
        frame: the photograph and its points.
        conventions: of its poses.
        view: pinhole camera of the photograph.
        mesh_depth: (h, w) z-depth of the mesh in `view`, metres, 0 = miss.

    Returns:
        (n,) float64 mesh depth / depth of the points; NaN where there is no mesh.
    """
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
    """Return the median of |mesh depth / measured depth - 1| where both exist; inf if these are less than MIN_COMPARED of all.

    The limit is needed because a camera with a wrong pose may agree in the few pixels that meet the mesh by chance.
    """
    both = ratio[np.isfinite(ratio)]
    return float(np.median(np.abs(both - 1))) if len(both) and len(both) >= MIN_COMPARED * len(ratio) else float("inf")


def _turned(rotation: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda matrix: np.concatenate([rotation @ matrix[:3], matrix[3:]])


def _moved(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda matrix: np.concatenate([matrix[:, :3], matrix[:, 3:] * [[factor], [factor], [factor], [1]]], 1)


def _word(axes: str) -> str:
    """Return what `source.mesh_up` calls a turn."""
    return next((word for word, named in MESH_UP.items() if named == axes), axes)


def candidates(now: Conventions, known: bool) -> list[tuple[str, Conventions]]:
    """Return other conventions than `now`, each with the advice that applies it; `known`: the format of the file determines the
    axes."""
    axes, metres = now.axes, now.metres
    other = "opencv" if axes == "opengl" else "opengl"
    inverse = "the matrices are world-to-camera: write their inverses into transforms.json"
    of_camera = [
        (f"`source.axes: {other}` fits", Conventions(other, metres)),
        (f"{inverse} (axes {axes}) fits", Conventions(axes, metres, np.linalg.inv)),
        (f"{inverse} with `source.axes: {other}` fits", Conventions(other, metres, np.linalg.inv)),
    ]
    out = [] if known else of_camera
    read = turn_of(now.mesh_axes)
    for name in TURNS:
        further = turn_of(name)  # of the mesh as it was read; turning the poses back is the same
        if name != AS_IS:
            advice = f"`source.mesh_up: {_word(name_of(further @ read))}`, which turns the mesh, fits"
            out.append((advice, Conventions(axes, metres, _turned(further.T), of_world=True)))
    for factor in (1000.0, 100.0, 0.01, 0.001):
        text = f"camera positions times {factor:g} fits (mesh and poses are in different units)"
        out.append((text, Conventions(axes, metres, _moved(factor), of_world=True)))
    return out


def explain(
    frames: list[tuple[Frame, Pinhole]],
    trace: Callable[[np.ndarray, np.ndarray], np.ndarray],
    conventions: Conventions,
    known: bool,
    depth_unit: float | None,
    tolerance: float,
    size: float,
) -> str:
    """Find a convention that fits the depth images (or sparse points) better.

    Args:
        frames: photographs with either, and their pinhole cameras.
        trace: (origin, directions (h, w, 3)) -> z-depth (h, w), 0 = miss.
        conventions: those in use.
        known: whether the format of the file determines the axes.
        depth_unit: metres per value of the depth images; None = by their format.
        tolerance: largest acceptable disagreement.
        size: of the mesh, metres.

    Returns:
        Advice as text; empty if no convention fits.
    """
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, TRIAL_VIEWS).astype(int))]
    depths = [
        images.load_depth(frame.depth, depth_unit, (frame.camera.width, frame.camera.height)) if frame.depth else None
        for frame, _ in chosen
    ]
    some = [replace(f, seen=f.seen[:: max(1, len(f.seen) // TRIAL_POINTS)]) if f.seen is not None else f for f, _ in chosen]
    chosen = [(frame, view) for frame, (_, view) in zip(some, chosen, strict=True)]

    def ratios(tried: Conventions) -> np.ndarray:
        parts = []
        for (frame, view), depth in zip(chosen, depths, strict=True):
            small = shrunk(view, TRIAL_WIDTH)
            pose = tried.pose(frame)
            mesh_depth = trace(pose[:3, 3], directions(small, pose))
            parts.append(
                point_ratio(frame, tried, small, mesh_depth)
                if depth is None
                else depth_ratio(frame, tried, small, mesh_depth, depth)
            )
        return np.concatenate(parts)

    as_is = ratios(conventions)
    some = [frame for frame, _ in chosen]
    others = [(text, c) for text, c in candidates(conventions, known) if not _drawn_together(some, conventions, c, size)]
    scores = [(disagreement(ratios(c)), text) for text, c in others]
    if np.isfinite(as_is).any() and any(depth is not None for depth in depths):  # sparse points have no scale of their own
        factor = float(np.nanmedian(as_is))
        scores.append((disagreement(as_is / factor), _unit_advice(conventions.metres, factor)))
    best, text = min(scores)
    return f"{text} (disagreement {best:.1%})" if best <= min(tolerance, 0.5 * disagreement(as_is)) else ""


def explain_edges(
    trials: list[Trial],
    trace: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    conventions: Conventions,
    known: bool,
    now: float,
    size: float,
) -> str:
    """Find a convention that aligns the mesh's edges with those of the photographs.

    Args:
        trials: photographs.
        trace: (origin, directions (h, w, 3)) -> z-depth (h, w) with 0 = miss, and unit normals (h, w, 3).
        conventions: those in use.
        known: whether the format of the file determines the axes.
        now: correlation with the convention in use.
        size: of the mesh, metres.

    Returns:
        Advice as text; empty if no convention is clearly better.
    """

    def correlation(tried: Conventions) -> float:
        found = []
        for frame, camera, photo, valid in trials:
            pose = tried.pose(frame)
            depth, normal = trace(pose[:3, 3], directions(camera, pose))
            edges = edge_pictures(photo, valid, depth, normal)
            found.append(edge_correlation(*edges)[SHIFT, SHIFT] if (depth > 0).any() else 0.0)
        return float(np.mean(found)) if found else 0.0

    frames = [frame for frame, *_ in trials]
    others = [(text, c) for text, c in candidates(conventions, known) if not _drawn_together(frames, conventions, c, size)]
    best, text = max((correlation(c), text) for text, c in others)
    return f"{text} (edges correlate {best:.2f}, as read {now:.2f})" if best >= max(CLEAR_CORRELATION, 3 * now) else ""


def _drawn_together(frames: Sequence[Frame], now: Conventions, tried: Conventions, size: float) -> bool:
    """A convention moves cameras together, to what is a point in a mesh of a size (m): what fits then fits by chance."""

    def span(conventions: Conventions) -> float:
        return float(np.linalg.norm(np.ptp([conventions.pose(frame)[:3, 3] for frame in frames], axis=0)))

    return len(frames) > 1 and span(tried) < min(LEAST_SPREAD * size, 0.5 * span(now))


def _unit_advice(metres: float, factor: float) -> str:
    right = metres / factor
    named = [name for name, value in METRES.items() if abs(value / right - 1) < 0.03]
    unit = named[0] if named else f"{right:.4g}"
    return f"the mesh is {factor:.4g} times as deep as the depth images say: `source.unit: {unit}` fits"


def shrunk(camera: Pinhole, width: int) -> Pinhole:
    """Return the same camera with at most `width` pixels across."""
    return scaled(camera, *images.fitted_size(camera.width, camera.height, width, np.inf))


def scaled(camera: Pinhole, width: int, height: int) -> Pinhole:
    """Return the same camera with width x height pixels; (u + 0.5) coordinates scale about the corner of the picture."""
    a, b = width / camera.width, height / camera.height
    return Pinhole(camera.fx * a, camera.fy * b, camera.cx * a, camera.cy * b, width, height)


def directions(camera: Pinhole, pose: np.ndarray) -> np.ndarray:
    """Return (h, w, 3) float32 world directions with camera z = 1, so that distances along them are z-depths."""
    return pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose)


def edge_pictures(photo: np.ndarray, valid: np.ndarray, depth: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how much of an edge every pixel of a photograph and of the mesh is, both reduced to EDGE_WIDTH.

    Args:
        photo: (H, W, 3).
        valid: (H, W) bool.
        depth: (H, W) z-depth of the mesh, 0 = miss.
        normal: (H, W, 3) unit normals of the mesh.

    Returns:
        (h, w) float64 of the photograph and of the mesh.
    """
    from scipy.ndimage import gaussian_filter

    width, height = images.fitted_size(depth.shape[1], depth.shape[0], EDGE_WIDTH, EDGE_WIDTH)
    photo, valid = images.reduce_area(photo, valid, width, height)
    depth, normal = images.reduce_nearest(depth, width, height), images.reduce_nearest(normal, width, height)
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
    return gaussian_filter(np.minimum(seen, 1.0), 1.0), gaussian_filter(mesh, 1.0)


def edge_correlation(seen: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Correlate the edges of a photograph with those of the mesh, both (h, w) as `edge_pictures` returns them, for shifts of the
    photograph.

    Returns:
        (2 SHIFT + 1, 2 SHIFT + 1) float64; entry [SHIFT + dy, SHIFT + dx] compares mesh pixel (u, v) with photograph pixel
        (u + dx, v + dy). Zeros if the picture is too small or has no edges.
    """
    out = np.zeros((2 * SHIFT + 1, 2 * SHIFT + 1))
    height, width = mesh.shape
    if min(height, width) < 8 * SHIFT:
        return out
    inner = mesh[SHIFT:-SHIFT, SHIFT:-SHIFT]
    inner = inner - inner.mean()
    for dy in range(-SHIFT, SHIFT + 1):
        for dx in range(-SHIFT, SHIFT + 1):
            other = seen[SHIFT + dy : height - SHIFT + dy, SHIFT + dx : width - SHIFT + dx]
            other = other - other.mean()
            norm = np.sqrt((inner**2).sum() * (other**2).sum())
            out[SHIFT + dy, SHIFT + dx] = (inner * other).sum() / norm if norm > 1e-9 else 0.0
    return out


def own_and_others(pictures: list[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float, float]:
    """Compare photographs with the mesh as their own pose shows it, and as the poses of the other photographs do.

    Args:
        pictures: of at least two views of one size, as `edge_pictures` returns them.

    Returns:
        Mean correlation with the own pose, with those of others, and their difference in standard errors of its mean over views.
    """
    seen, mesh = (_standardised(np.stack(part)) for part in zip(*pictures, strict=True))
    table = seen @ mesh.T
    count = len(table)
    own = table.diagonal()
    others = (table.sum(1) - own) / (count - 1)
    error = float((own - others).std(ddof=1)) / np.sqrt(count)
    return float(own.mean()), float(others.mean()), float((own - others).mean()) / max(error, 1e-9)


def _standardised(pictures: np.ndarray) -> np.ndarray:
    rows = pictures.reshape(len(pictures), -1)
    rows = rows - rows.mean(1, keepdims=True)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)


@dataclass
class Alignment:
    """Collects the comparisons of all views: `report` for capture.json, `notes` and `edge_warning` as text, `refuse`.

    Attributes:
        ratios: of depth; edges: correlations (2 SHIFT + 1, 2 SHIFT + 1), both by view.
        pictures: edges of photograph and mesh, (h, w) float32 each, of some views of one size.
        what: the depth is from.
    """

    ratios: dict[str, np.ndarray]
    edges: dict[str, np.ndarray]
    pictures: list[tuple[np.ndarray, np.ndarray]]
    what: str = "depth images"

    @classmethod
    def empty(cls) -> Alignment:
        return cls({}, {}, [])

    def add_edges(self, name: str, seen: np.ndarray, mesh: np.ndarray, compared: bool) -> None:
        """Add a view by the edges of its photograph and of the mesh (`edge_pictures`); `compared`: with the other views, too."""
        self.edges[name] = edge_correlation(seen, mesh)
        if compared and (not self.pictures or seen.shape == self.pictures[0][0].shape):
            self.pictures.append((seen.astype(np.float32), mesh.astype(np.float32)))

    def add_depth(
        self, frame: Frame, conventions: Conventions, view: Pinhole, mesh_depth: np.ndarray, unit: float | None
    ) -> None:
        """Add a view by its depth image or, without one, by its sparse points, if it has enough.

        Args:
            frame: the photograph.
            conventions: of its poses.
            view: its pinhole camera.
            mesh_depth: (h, w) z-depth of the mesh in `view`, metres, 0 = miss.
            unit: metres per value of the depth image; None = by its format.
        """
        if frame.depth is not None:
            measured = images.load_depth(frame.depth, unit, (frame.camera.width, frame.camera.height))
            self.ratios[frame.name] = depth_ratio(frame, conventions, view, mesh_depth, measured)
        elif frame.seen is not None and len(frame.seen) >= MIN_POINTS:
            self.what = "sparse points"
            self.ratios[frame.name] = point_ratio(frame, conventions, view, mesh_depth)

    @property
    def depth_disagreement(self) -> float:
        """Median over all compared pixels of all views; inf without depth images or if too few pixels meet the mesh."""
        return disagreement(np.concatenate(list(self.ratios.values()))) if self.ratios else float("inf")

    def report(self) -> dict[str, Any]:
        """Return the measured numbers, for capture.json and the notes."""
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
        if len(self.pictures) > 2:
            own, others, apart = own_and_others(self.pictures)
            out["edge_correlation_other_poses"] = round(others, 6)
            out["edge_own_pose_standard_errors"] = round(apart, 3)
        return out

    def disagreeing_views(self, tolerance: float) -> list[str]:
        """Return the views whose own disagreement exceeds `tolerance`; one bad pose does not move the median of all views."""
        return [name for name, ratio in self.ratios.items() if disagreement(ratio) > tolerance]

    def notes(self, tolerance: float) -> list[str]:
        """Return the numbers as text."""
        r, out = self.report(), []
        wrong = self.disagreeing_views(tolerance) if "depth_median_disagreement" in r else []
        if wrong:
            out.append(f"WARNING alignment: mesh and depth disagree in view(s) {', '.join(wrong)}: is the pose right?")
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

    def edge_warning(self, tolerance: float) -> str:
        """Return a warning if edges do not lie on edges, else an empty text; `tolerance` of the measured depth."""
        r = self.report()
        if "edge_correlation" not in r:
            return ""
        now, best = r["edge_correlation"], r["edge_correlation_best"]
        shift = max(map(abs, r["edge_best_shift"]))
        # Depth that agrees speaks for the poses of the depth, not for those of the photographs.
        is_mixed_up = r.get("edge_own_pose_standard_errors", np.inf) < CLEARLY_OWN
        weak = WEAK_BESIDE_DEPTH if self.depth_disagreement <= tolerance and not is_mixed_up else WEAK_CORRELATION
        if now >= weak and not (shift >= SHIFT - 1 and best > 1.2 * now):
            return ""
        mixed_up = ""
        if is_mixed_up:
            mixed_up = (
                f"; from the poses of other photographs they correlate {r['edge_correlation_other_poses']:.3f}, which is as much:"
                " photographs may stand with each other's poses"
            )
        return (
            "photographs and mesh may not be aligned: their edges do not lie on each other (correlation"
            f" {now:.3f}, {best:.3f} when shifted by {shift / EDGE_WIDTH:.1%} of the picture){mixed_up}; look at the"
            " overlay in the report, check `source.axes`, `source.unit`, the focal length, that mesh and poses share a frame, and"
            " that every photograph stands with its own pose"
        )

    def refuse(self, path: Any, tolerance: float, advice: Callable[[], str]) -> str:
        """Return an error message if the measured depth contradicts the mesh, else an empty text."""
        if not self.ratios or self.depth_disagreement <= tolerance:
            return ""
        number = self.depth_disagreement
        found = f"{number:.1%}" if np.isfinite(number) else f"less than {MIN_COMPARED:.0%} of them meet it"
        better = advice()
        return (
            f"{path}: mesh and {self.what} disagree (median relative difference {found}, tolerance {tolerance:.0%})."
            f" {better or 'No usual convention fits: check that mesh, poses and depth belong together'}."
            " To continue anyway: `source.alignment: warn`"
        )


def raise_or_note(message: str, mode: str, notes: list[str]) -> None:
    """Raise a message that is not empty if `mode` is `check`, else append it to the notes."""
    if message and mode == "check":
        raise InputError(message)
    if message:
        notes.append("WARNING " + message)
