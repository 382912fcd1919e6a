"""Errors of the direct solvers on matrices of the kinds that LAPACK's tests use, with planted answers.

For a computed answer x of H x = b, the normwise backward error is |H x - b| / (|H| |x| + |b|), the smallest relative change of H
and b that makes x exact. Non-negative solutions are judged by the optimality conditions on the same scale. The forward error is
the error of x against the planted or exact answer. Divided by condition x eps it is the growth, of order 1 for a stable method.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import mpmath as mp
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from iif_core.camera.alignment import Photo

EPS = float(np.finfo(np.float64).eps)
SINGLE = float(np.finfo(np.float32).eps)
BACKWARD_LIMIT = 100.0
"""Largest backward error of a solver that is in order, in units of eps."""
DIGITS = 60
TINY_SCALE, HUGE_SCALE = 1e-36, 1e36
"""Factors on whole systems. Their rows are in single precision, so that squares lie between 1e-76 and 1e76."""


class Solved(NamedTuple):
    """How one solver did on one kind of matrix.

    Attributes:
        solver, kind: names; size: of the system.
        condition: of the matrix that is solved; infinite where it is singular.
        backward: backward error, or violation of the optimality conditions, in units of eps.
        forward: largest error of the answer relative to its largest entry; NaN where the answer is not unique.
        lost: entries of the answer that are not finite.
        says: what is returned where the matrix does not decide.
        eps: spacing of the numbers in which the solver forms its system.
    """

    solver: str
    kind: str
    size: int
    condition: float
    backward: float
    forward: float
    lost: int
    says: str = ""
    eps: float = EPS

    @property
    def growth(self) -> float:
        """Forward error in units of condition x eps."""
        return self.forward / (max(self.condition, 1.0) * self.eps) if self.condition == self.condition else math.nan

    @property
    def in_order(self) -> bool:
        return not self.lost and not self.backward > BACKWARD_LIMIT


KINDS = (
    "diagonal",
    "condition 2",
    "condition 1e4",
    "condition 0.1 / eps",
    "zero columns",
    "duplicate columns",
    "close to underflow",
    "close to overflow",
)


def gram(kind: str, size: int, rng: np.random.Generator) -> NDArray:
    """Make a symmetric positive semidefinite matrix of one of `KINDS`, (size, size) float64."""
    condition = {"condition 2": 2.0, "condition 0.1 / eps": 0.1 / EPS}.get(kind, 1e4)
    spectrum = np.geomspace(1.0, 1.0 / condition, size)
    if kind == "diagonal":
        return np.diag(rng.permutation(spectrum))
    turn = np.linalg.qr(rng.normal(size=(size, size)))[0]
    root = turn * np.sqrt(spectrum)
    if kind == "zero columns":
        root[[0, size // 2, -1]] = 0.0
    elif kind == "duplicate columns":
        root[-1] = root[0]
        root[size // 2] = root[0]
    scale = {"close to underflow": TINY_SCALE, "close to overflow": HUGE_SCALE}.get(kind, 1.0)
    out = root @ root.T * scale**2
    return 0.5 * (out + out.T)


def condition_of(matrix: NDArray) -> float:
    """Return largest over smallest eigenvalue of a symmetric matrix; infinite where it is singular to working precision."""
    spectrum = np.abs(np.linalg.eigvalsh(matrix))
    return float(spectrum.max() / spectrum.min()) if spectrum.min() > EPS * spectrum.max() else math.inf


def backward_error(matrix: NDArray, x: NDArray, right: NDArray) -> float:
    """Compute |H x - b| / (|H| |x| + |b|) in the maximum norm, in units of eps; the residual in extended precision."""
    h, x, b = (np.asarray(a, np.longdouble) for a in (matrix, x, right))
    below = np.abs(h).sum(-1).max() * np.abs(x).max() + np.abs(b).max()
    return float(np.abs(h @ x - b).max() / below / EPS) if below > 0 else 0.0


def exact_solution(matrix: NDArray, right: NDArray) -> NDArray:
    """Solve in 60 digits what float64 numbers say; for small systems."""
    with mp.workdps(DIGITS):
        found = mp.lu_solve(mp.matrix(matrix.tolist()), mp.matrix(right.tolist()))
    return np.array([float(value) for value in found])


def relative_error(x: NDArray, wanted: NDArray) -> float:
    """Return the largest error relative to the largest entry."""
    largest = np.abs(wanted).max(initial=0.0)
    return float(np.abs(x - wanted).max(initial=0.0) / largest) if largest > 0 else 0.0


def _lost(*arrays: NDArray) -> int:
    return sum(int((~np.isfinite(array)).sum()) for array in arrays)


# ------------------------------------------------------------------------------------------------------------- fusion


def affine_maps() -> Iterator[Solved]:
    """The ridge regression of stage `base` that fits the map of a segment's prediction to the texture (Eq. F.25)."""
    for kind, (values, weight) in _predictions().items():
        yield _affine_map(kind, values, weight)


def _predictions(pixels: int = 300) -> dict[str, tuple[NDArray, float]]:
    """Kind -> predictions (pixels, 5) float32 of one segment, and the weight of every pixel."""
    rng = np.random.default_rng(0)
    free = rng.random((pixels, 5)).astype(np.float32)
    grey = np.repeat(free[:, :1], 5, 1)
    out = {
        "condition 2": (free, 1.0),
        "grey (duplicate columns)": (grey, 1.0),
        "nearly grey": (np.clip(grey + 1e-5 * free, 0, 1), 1.0),
        "constant": (np.full_like(free, 0.3), 1.0),
        "black (zero columns)": (np.zeros_like(free), 1.0),
        "dark, 1e-30": (free * np.float32(1e-30), 1.0),
        "one pixel": (free[:1], 1.0),
        "weight 1e-30": (free, 1e-30),
        "weight 1e30": (free, 1e30),
    }
    return {kind: (values.astype(np.float32), weight) for kind, (values, weight) in out.items()}


def _affine_map(kind: str, values: NDArray, weight: float) -> Solved:
    from iif_core.fusion import kernels
    from iif_core.fusion.blocks import Block
    from iif_core.fusion.options import FusionOptions
    from iif_core.fusion.sums import NO_MASK, SegmentSums
    from iif_core.reflectance.material import IDENTITY

    n, rng = len(values), np.random.default_rng(1)
    target = rng.random((5, n)).astype(np.float32)
    planes = kernels.as_words(values[None])  # (1, n, 5)
    planes, _ = kernels.gather(planes, np.arange(n), np.ones(1, bool))
    weights = np.full(n, weight, np.float32)
    stated = np.zeros((3, 0), np.float32)
    one = np.zeros(1, np.int32)
    block = Block(planes, np.zeros(n, np.int32), weights, one, np.array([0, n]), np.ones(1, bool), NO_MASK, stated)
    sums = SegmentSums(1, 1, np.ones(1, np.float32))
    sums.add(block, FusionOptions())
    cross = kernels.cross(planes, target, weights, block.start, NO_MASK)
    found = sums.corrections(np.zeros(1, np.int64), cross, cross)[0, 0]
    ridge, worst, errors, conditions = float(sums.ridge[0]), 0.0, [], []
    identity = np.float64(IDENTITY)
    for part, columns in ((slice(0, 12), (0, 1, 2)), (slice(12, 14), (3,)), (slice(14, 16), (4,))):
        design = np.concatenate([values[:, columns], np.ones((n, 1))], 1).astype(np.float64)
        each = float(weights[0])  # as it was rounded
        matrix = each * (design.T @ design) + ridge * np.eye(len(columns) + 1)
        # From the pixels themselves: the sums of the kernels are in single precision within pieces.
        right = np.stack([each * (design.T @ target[c].astype(np.float64)) for c in columns])
        right = right + ridge * identity[part].reshape(len(columns), -1)
        own = found[part].reshape(len(columns), -1)
        for x, b in zip(own, right, strict=True):
            worst = max(worst, backward_error(matrix, x, b) * EPS / SINGLE)
            errors.append(relative_error(x, exact_solution(matrix, b)))
        conditions.append(condition_of(matrix))
    return Solved("affine maps of the fusion", kind, 4, max(conditions), worst, max(errors), _lost(found), eps=SINGLE)


def gains_of_one_channel() -> Iterator[Solved]:
    """Gain and offset under the paper's regulariser (Eq. F.34)."""
    from lab.published.fusion.matching import penalised_gain

    for kind, strength in itertools.product(KINDS, (1e-12, 100.0)):
        matrix = gram(kind, 2, np.random.default_rng(2)) if kind != "zero columns" else np.diag([0.0, 1.0])
        scale = float(np.trace(matrix))
        right = np.array([0.3, -0.2]) * scale
        x = penalised_gain(matrix[None], right[None], np.array([strength * scale]))[0]
        whole = matrix + 2 * strength * scale * np.eye(2)
        b = right + 2 * strength * scale * np.array([1.0, 0.0])
        forward = relative_error(x, exact_solution(whole, b))
        name = f"{kind}, regulariser {strength:g}"
        yield Solved("gain and offset of the paper's loss", name, 2, condition_of(whole), backward_error(whole, x, b), forward,
                     _lost(x))  # fmt: skip


def seams() -> Iterator[Solved]:
    """Levels of the parts of an object from the jumps at their seams (Eq. F.43)."""
    from iif_core.fusion.gauge import SEAM_RIDGE_PAIRS, Parts, seam_shifts

    rng = np.random.default_rng(3)
    graphs = {
        "two parts": [(0, 1)],
        "chain of 30": [(i, i + 1) for i in range(29)],
        "chain of 1000": [(i, i + 1) for i in range(999)],
        "star of 500": [(0, i) for i in range(1, 500)],
        "two components": [(0, 1), (2, 3)],
    }
    cases = [(name, edges, 1.0) for name, edges in graphs.items()]
    cases += [(f"chain of 30, weights {w:g}", graphs["chain of 30"], w) for w in (1e-30, 1e30)]
    for name, edges, scale in cases:
        count = max(max(edge) for edge in edges) + 1
        level = rng.uniform(0.2, 0.6, count)
        weight = np.exp(rng.normal(0, 3, count)) * scale
        parts = Parts(np.arange(count, dtype=np.int32), np.arange(count, dtype=np.int32), count)
        texture = np.repeat(level[:, None], 5, 1)
        pairs = np.array(edges, np.int32)
        shift, _ = seam_shifts(parts, texture, weight, pairs, np.full((count, 5), 10.0))
        matrix, right = np.zeros((count, count)), np.zeros(count)
        group = _components(count, edges)
        for a, b in edges:
            matrix[[a, b], [a, b]] += 1.0
            matrix[[a, b], [b, a]] -= 1.0
            jump = level[b] - level[a]
            right[a] += jump
            right[b] -= jump
        share = weight / np.array([weight[group == group[i]].sum() for i in range(count)])
        matrix[np.diag_indices(count)] += SEAM_RIDGE_PAIRS * share + 1e-9
        forward = relative_error(shift[:, 0], exact_solution(matrix, right)) if count <= 30 else math.nan
        yield Solved("levels at seams", name, count, condition_of(matrix), backward_error(matrix, shift[:, 0], right), forward,
                     _lost(shift))  # fmt: skip


def _components(count: int, edges: list[tuple[int, int]]) -> NDArray:
    from iif_core.numerics.graph import component_labels

    a, b = np.array(edges).T
    return component_labels(count, a, b)


# -------------------------------------------------------------------------------------------------------------- light


def emission(size: int = 12) -> Iterator[Solved]:
    """Non-negative least squares of stage `emission` on lifted normal equations (Eq. L.20, L.24), half of the answer at 0.

    The planted answer is the initial value too, so that it stays the answer in directions that the rows do not decide.
    """
    from iif_core.light.emission.direct import RIDGE
    from iif_core.light.emission.normal import NormalSums, normal_system

    rng = np.random.default_rng(4)
    for kind in KINDS:
        matrix = gram(kind, size, rng)
        unit = math.sqrt(float(np.diag(matrix).max()))
        planted = np.where(rng.random(size) < 0.5, 0.0, np.exp(rng.normal(0, 3, size))) / unit
        held = np.where(planted > 0, 0.0, rng.random(size)) * unit
        right = matrix @ planted - np.where(np.diag(matrix) > 0, held, 0.0)
        zero = np.zeros((size, size))
        system = normal_system(NormalSums(matrix, zero, matrix, right), np.full(size, np.inf), np.zeros(size), RIDGE)
        assert system is not None
        x = system.solve(planted)
        scaled = x[system.known] * system.scale
        b = system.right + system.lifted @ (planted[system.known] * system.scale)
        gradient = np.asarray(system.matrix, np.longdouble) @ scaled - b
        violated = np.where(scaled > 0, np.abs(gradient), np.maximum(-gradient, 0.0))
        below = np.abs(system.matrix).sum(1).max() * np.abs(scaled).max() + np.abs(b).max()
        says = f"{int((~system.known).sum())} groups at their initial value" if not system.known.all() else ""
        backward = float(violated.max() / below / EPS)
        yield Solved("radiance of emitters", kind, size, condition_of(system.matrix), backward, relative_error(x, planted),
                     _lost(x), says)  # fmt: skip


# ---------------------------------------------------------------------------------------------------------- materials


def arrowhead(objects: int = 5, params: int = 3) -> Iterator[Solved]:
    """One undamped Gauss-Newton step of all objects and the response (Eq. M.17), against the planted step."""
    from iif_core.fitting.descent import DescentState, GaussianPrior, ResponsePrior, decompose_objects, eliminate_objects
    from iif_core.fitting.pixels import Terms
    from iif_core.reflectance.material import NUMBERS

    rng, own = np.random.default_rng(5), NUMBERS + params
    for kind in KINDS:
        h = np.stack([gram(kind, own, rng) for _ in range(objects)])
        size = objects * NUMBERS + params
        whole, x = np.zeros((size, size)), rng.normal(size=size)
        for o in range(objects):
            at = np.r_[NUMBERS * o + np.arange(NUMBERS), objects * NUMBERS + np.arange(params)]
            whole[np.ix_(at, at)] += h[o]
        # Gradients that the planted step removes, dealt to the objects that cause them.
        g = np.stack([-h[o] @ x[np.r_[NUMBERS * o + np.arange(NUMBERS), objects * NUMBERS + np.arange(params)]]
                      for o in range(objects)])  # fmt: skip
        free = np.ones((objects, NUMBERS), bool)
        none = np.zeros(objects)
        state = DescentState(np.zeros((objects, NUMBERS)), free, np.zeros(params), none)
        prior = GaussianPrior(np.zeros((objects, NUMBERS)), np.zeros((objects, NUMBERS, NUMBERS)))
        curve = ResponsePrior(np.zeros(params), np.zeros((params, params)), np.zeros((params, params)))
        terms = Terms(none, none, none, h, g, np.zeros((0, own)))
        system = eliminate_objects(terms, state, prior, curve, True, decompose_objects(h, free, prior), damped=False)
        shift = system.schur @ (-system.g_w + np.einsum("oip,oi->p", system.by_response, system.g))
        step = -np.einsum("oij,oj->oi", system.inverse, system.g) - system.by_response @ shift
        found = np.r_[step.ravel(), shift]
        right = np.r_[-g[:, :NUMBERS].ravel(), -g[:, NUMBERS:].sum(0)]
        condition = condition_of(_unit_diagonal(whole))
        says = "eigenvalues below 1e-10 of a unit diagonal count as 1e-10" if condition > 1e10 else ""
        forward = relative_error(found, x) if condition < 1e10 else math.nan
        yield Solved("step of materials and response", kind, size, condition, backward_error(whole, found, right), forward,
                     _lost(found), says)  # fmt: skip


def _unit_diagonal(matrix: NDArray) -> NDArray:
    scale = np.sqrt(np.diag(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    return matrix / scale / scale[:, None]


# ------------------------------------------------------------------------------------------------------------- camera


def camera_gains() -> Iterator[Solved]:
    """Exposure and white balance of the photographs from surface that they share (Eq. C.25), with exact values."""
    from iif_core.camera.gains import GainRows, estimate

    for name, edges, spread in _photographs():
        views = max(max(edge) for edge in edges) + 1
        patch, view, planted, y = _shared(edges, views, spread)
        found = estimate(GainRows(patch, view, y, np.zeros(len(view)), patch), views, white_balance=True, vignetting=False)
        yield _gains("gains of photographs", name, edges, planted, np.log(found.gain), _lost(found.gain))


def exposures() -> Iterator[Solved]:
    """Exposure of the photographs, one factor each, with its standard error."""
    from iif_core.camera.exposure import estimate_gains

    for name, edges, spread in _photographs():
        views = max(max(edge) for edge in edges) + 1
        patch, view, planted, y = _shared(edges, views, spread)
        found = estimate_gains(patch, view, y / np.exp(planted - planted.mean(1, keepdims=True))[view], views)
        planted = np.repeat(planted.mean(1, keepdims=True), 3, 1)
        yield _gains("exposures of photographs", name, edges, planted, np.repeat(np.log(found.gain)[:, None], 3, 1),
                     _lost(found.gain, found.error))  # fmt: skip


def _photographs() -> list[tuple[str, list[tuple[int, int]], float]]:
    """Which photographs share surface, and the spread of their log gains."""
    chain = [(i, i + 1) for i in range(9)]
    return [
        ("two photographs", [(0, 1)], 1.0),
        ("chain of 10", chain, 1.0),
        ("chain of 100", [(i, i + 1) for i in range(99)], 1.0),
        ("chain of 349", [(i, i + 1) for i in range(348)], 1.0),
        ("every pair of 20", list(itertools.combinations(range(20), 2)), 1.0),
        ("two components", [(0, 1), (2, 3)], 1.0),
        ("chain of 10, gains 1e-30 to 1e30", chain, 30.0),
    ]


def _shared(edges: list[tuple[int, int]], views: int, spread: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Patch, view, planted log gains (V, 3) with mean 0 over connected views, and values (n, 3): 20 patches for each pair."""
    rng = np.random.default_rng(6)
    planted = rng.uniform(-spread, spread, (views, 3)) * math.log(10.0)
    group = _components(views, edges)
    for g in np.unique(group):
        planted[group == g] -= planted[group == g].mean(0)
    patch = np.repeat(np.arange(20 * len(edges)), 2)
    view = np.repeat(np.array(edges), 20, 0).ravel()
    level = rng.uniform(-1, 1, (20 * len(edges), 3))
    return patch, view, planted, np.exp(planted[view] + level[patch])


def _gains(solver: str, name: str, edges: list[tuple[int, int]], planted: NDArray, found: NDArray, lost: int) -> Solved:
    """Judge log gains (V, 3) by the normal equations of exact values, in which every pair of photographs counts alike."""
    views = len(planted)
    laplacian = np.zeros((views, views))
    for a, b in edges:
        laplacian[[a, b], [a, b]] += 1.0
        laplacian[[a, b], [b, a]] -= 1.0
    spectrum = np.linalg.eigvalsh(laplacian)
    condition = float(spectrum[-1] / spectrum[spectrum > 1e-10][0])  # on the complement of the gauge
    right = np.asarray(laplacian, np.longdouble) @ planted
    backward = max(backward_error(laplacian, found[:, c], right[:, c]) for c in range(3))
    return Solved(solver, name, views, condition, backward, relative_error(found, planted), lost)


def calibration() -> Iterator[Solved]:
    """The response from exact values on shared surface under known exposures: the largest error of the curve on [0, 1]."""
    from iif_core.camera.calibration.choice import calibrate_response
    from iif_core.camera.overlap import PatchRows
    from iif_core.camera.response import response

    exposure = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 0.25, 1.0, 4.0])
    cases = {
        "gamma 1.9": ("gamma", [1.9], 1.0, 0.0),
        "gamma 0.7": ("gamma", [0.7], 1.0, 0.0),
        "gamma 5": ("gamma", [5.0], 1.0, 0.0),
        "ggcm": ("ggcm", [-0.7, 0.3, -0.1], 1.0, 0.0),
        "gamma 1.9, exposures times 1e-6": ("gamma", [1.9], 1e-6, 0.0),
        "gamma 1.9, exposures times 1e6": ("gamma", [1.9], 1e6, 0.0),
        "gamma 1.9, 8 bits": ("gamma", [1.9], 1.0, 255.0),
        "gamma 1.9, 3 levels": ("gamma", [1.9], 1.0, 3.0),
    }
    grid = np.repeat(np.linspace(0, 1, 101)[:, None], 3, 1)
    for name, (family, params, scale, levels) in cases.items():
        truth, rng = response(family, np.array(params)), np.random.default_rng(8)
        surface = np.exp(rng.normal(-1.3, 1.0, (300, 3)))
        patch, view = (part.ravel() for part in np.meshgrid(np.arange(300), np.arange(len(exposure)), indexing="ij"))
        value = truth(np.clip(exposure[view, None] * surface[patch], 0, 1))
        value = np.round(value * levels) / levels if levels else value
        none = np.zeros(len(patch), np.int8)
        rows = PatchRows(patch.astype(np.uint64), none, patch % 20, view, value, value >= 0.99, none + 9)
        found = calibrate_response(rows, exposure * scale, (family,))
        curve = found.response(grid)
        error = float(np.abs(curve - truth(grid)).max())
        yield Solved("camera response", name, len(params), math.nan, math.nan, error, _lost(curve, found.covariance))


def registration() -> Iterator[Solved]:
    """The first step of the registration: six cameras above a painted floor, whose paint decides what is known of them."""
    from iif_core.camera.registration import register

    def waves(x: NDArray, y: NDArray) -> NDArray:
        return np.exp(0.5 * np.sin(9 * x + 1) * np.sin(7 * y) + 0.3 * np.sin(23 * x - 17 * y))

    cases: dict[str, tuple[Callable[[NDArray, NDArray], NDArray], int, float, float]] = {
        "painted": (waves, 6, 1.0, 1.0),
        "stripes along one axis": (lambda x, y: np.exp(0.5 * np.sin(20 * x) + 0 * y), 6, 1.0, 1.0),
        "one colour": (lambda x, y: 1 + 0 * x, 6, 1.0, 1.0),
        "black": (lambda x, y: 0 * x, 6, 1.0, 1.0),
        "one photograph": (waves, 1, 1.0, 1.0),
        "20 photographs": (waves, 20, 1.0, 1.0),
        "radiance times 1e-30": (waves, 6, 1e-30, 1.0),
        "radiance times 1e30": (waves, 6, 1e30, 1.0),
        "10 times as large": (waves, 6, 1.0, 10.0),
        "10 times as small": (waves, 6, 1.0, 0.1),
    }
    for name, (paint, views, light, metres) in cases.items():
        photos = [_floor_photo(paint, turn, light, metres) for turn in np.linspace(0, 2 * np.pi, views, endpoint=False)]
        normal, right, step = _first_step(photos, 4000)
        forward = relative_error(step, exact_solution(normal, right)) if len(right) < 50 else math.nan
        found = register(photos, 1000) if views == 6 and metres == light == 1.0 else None
        lost = _lost(step) + (_lost(found.pose, found.principal) if found else 0)
        says = "nothing to align: the cameras stay where they are" if not np.abs(step).any() else ""
        yield Solved(
            "registration", name, len(step), condition_of(normal), backward_error(normal, step, right), forward, lost, says
        )


def _first_step(photos: list[Photo], points: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return the normal equations of the first step of `register`, (6 V + 3, 6 V + 3) and (6 V + 3,), and its solution."""
    from iif_core.camera import alignment as of

    features = [of.feature_image(p.image, p.usable) for p in photos]
    maps, start = [of.Maps.of(f, of.BLURS[0]) for f in features], of.Cameras.of(photos)
    edges = [of.edge_points(p) for p in photos]
    each = of.free(len(photos), intrinsics=True)
    normal, right = of.normal_equations(photos, maps, start, of.overlap(photos, features, points), edges, each)
    return normal, right, np.linalg.solve(normal, right)


def _floor_photo(paint: Callable[[NDArray, NDArray], NDArray], turn: float, light: float, metres: float) -> Photo:
    """A camera 1.5 m above the floor that looks down at an angle; `metres`: of a unit."""
    from iif_core.camera.alignment import Photo
    from iif_core.camera.pinhole import look_at, pixel_directions

    width, height, focal = 96, 72, 80.0
    eye = np.array([np.cos(turn), np.sin(turn), 1.5])
    pose = look_at(eye, (0.1, -0.1, 0), (0, 0, 1))
    ray = pixel_directions(focal, focal, width / 2, height / 2, width, height, pose)
    depth = -eye[2] / ray[..., 2]
    point = eye + depth[..., None] * ray
    image = light * np.repeat(0.3 * paint(point[..., 0], point[..., 1])[..., None], 3, -1)
    normal = np.broadcast_to([0.0, 0.0, 1.0], point.shape).copy()
    scaled = pose.copy()
    scaled[:3, 3] *= metres
    seen = np.ones(depth.shape, bool)
    return Photo(image, seen, depth * metres, normal, (focal, focal), (width / 2, height / 2), scaled)


SOLVERS: tuple[Callable[[], Iterator[Solved]], ...] = (
    affine_maps,
    gains_of_one_channel,
    seams,
    emission,
    arrowhead,
    camera_gains,
    exposures,
    calibration,
    registration,
)
"""All of them, in the order of the table."""


def table() -> list[Solved]:
    """Measure every solver on its kinds of matrices."""
    return list(itertools.chain.from_iterable(solver() for solver in SOLVERS))
