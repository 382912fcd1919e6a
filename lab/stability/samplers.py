"""Chi-squared tests of everything that is drawn against the density with which it is said to be drawn.

Draws are sorted into cells whose probabilities follow from the density, in closed form or by fine quadrature, and cells in which
fewer than `FEWEST` draws are expected count as one. Under the density the statistic of Pearson is chi-squared; the smallest
probability of all tests is compared with 1 - (1 - 0.05)^(1 / tests) (Sidak), as Mitsuba's own tests do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.light.environment import direction_in, solid_angles, texel_of
from iif_core.numerics.xp import DRJIT, NUMPY
from iif_core.reflectance import brdf
from workflow.runtime import device

LEVEL = 0.05
FEWEST = 5.0
"""Expected draws below which a cell is merged with others."""
DRAWS = 1 << 20
ROWS, COLUMNS, FINE = 24, 32, 40
"""Cells of directions by cosine and azimuth, and points of the quadrature along each edge of a cell."""

Z = (0.0, 0.0, 1.0)
VIEWS = ((0.1, 0.9), (0.25, 0.8), (0.5, 0.3), (1.0, 0.05))
"""Roughness, and cosine of the viewer."""


class Drawn(NamedTuple):
    """One test.

    Attributes:
        sampler, form, case: what was drawn, in which library, with which parameters.
        draws, cells: their numbers, after pooling.
        statistic: of Pearson over its degrees of freedom, 1 in the mean; probability: of one at least as large.
    """

    sampler: str
    form: str
    case: str
    draws: int
    cells: int
    statistic: float
    probability: float


def chi_squared(counts: NDArray, shares: NDArray) -> tuple[int, float, float]:
    """Test counts (n,) against probabilities (n,) that add up to 1.

    Returns:
        Cells after pooling, Pearson's statistic over its degrees of freedom, and its probability; 0 if a cell without
        probability has a count.
    """
    from scipy import stats

    expected = counts.sum() * np.asarray(shares, np.float64)
    own = expected >= FEWEST
    seen, wanted = counts[own].astype(np.float64), expected[own]
    if (counts[expected == 0] > 0).any():
        return int(own.sum()), np.inf, 0.0
    if (~own).any() and expected[~own].sum() > 0:
        seen, wanted = np.append(seen, counts[~own].sum()), np.append(wanted, expected[~own].sum())
    freedom = len(seen) - 1
    statistic = float(((seen - wanted) ** 2 / wanted).sum())
    return len(seen), statistic / max(freedom, 1), float(stats.chi2.sf(statistic, freedom))


def threshold(tests: int) -> float:
    """Return the smallest probability that `tests` tests may show."""
    return float(1 - (1 - LEVEL) ** (1 / max(tests, 1)))


def _grid(first: NDArray, second: NDArray, rows: int, columns: int) -> NDArray:
    """Counts (rows x columns,) of points in the unit square."""
    i, j = (np.clip((x * n).astype(np.int64), 0, n - 1) for x, n in ((first, rows), (second, columns)))
    return np.bincount(i * columns + j, minlength=rows * columns)


def _turn(x: NDArray, y: NDArray) -> NDArray:
    return np.arctan2(y, x) / (2 * np.pi) % 1


Pair = tuple[NDArray, NDArray]
Draw = Callable[[Callable[..., Any], int], tuple[NDArray, ...]]


def _forms(seed: int) -> Iterator[tuple[str, Any, Callable[[int], Any]]]:
    """Name of a library with its number format, its namespace, and a source of `n` uniform numbers."""
    import mitsuba as mi

    rng = np.random.default_rng(seed)
    yield "numpy float64", NUMPY, lambda n: rng.random(n)
    yield "drjit float32", DRJIT, lambda n: mi.Float(np.minimum(rng.random(n), 1 - 2**-24).astype(np.float32))


def _cosine(draws: int) -> Iterator[Drawn]:
    for form, xp, uniform in _forms(1):
        x, y, z = (np.asarray(axis, np.float64) for axis in brdf.sample_cosine(xp, uniform(draws), uniform(draws)))
        counts = _grid(z * z, _turn(x, y), ROWS, COLUMNS)  # z^2 is uniform
        yield Drawn("cosine lobe", form, "", draws, *chi_squared(counts, np.full(len(counts), 1 / len(counts))))


def _half_vectors(draws: int) -> Iterator[Drawn]:
    for roughness in (brdf.R_MIN, 0.1, 0.5, 1.0):
        for form, xp, uniform in _forms(2):
            x, y, z = (np.asarray(a, np.float64) for a in brdf.sample_ggx_half(xp, uniform(draws), uniform(draws), roughness))
            tan2, alpha2 = (x * x + y * y) / (z * z), roughness**4
            counts = _grid(tan2 / (alpha2 + tan2), _turn(x, y), ROWS, COLUMNS)  # the distribution function of GGX
            shares = np.full(len(counts), 1 / len(counts))
            yield Drawn("GGX half vector", form, f"r = {roughness:g}", draws, *chi_squared(counts, shares))


def _mixture(draws: int) -> Iterator[Drawn]:
    for roughness, cosine in VIEWS:
        wo = (np.sqrt(1 - cosine**2), 0.0, cosine)
        shares = _integrated(wo, roughness)
        for form, xp, uniform in _forms(3):
            u1, u2 = uniform(draws), uniform(draws)
            specular = brdf.reflect(wo, brdf.sample_ggx_half(xp, u1, u2, roughness))
            matte, choose = brdf.sample_cosine(xp, u1, u2), uniform(draws)
            x, y, z = (np.asarray(xp.where(choose < 0.5, s, c), np.float64) for s, c in zip(specular, matte, strict=True))
            above = z > 0
            counts = np.append(_grid(z[above], _turn(x[above], y[above]), ROWS, COLUMNS), (~above).sum())
            case = f"r = {roughness:g}, cosine {cosine:g}"
            yield Drawn("mixture of both lobes", form, case, draws, *chi_squared(counts, shares))


def _integrated(wo: tuple[float, float, float], roughness: float) -> NDArray:
    """Probabilities of the cells of directions by `mixture_pdf`, and of directions below the surface."""
    z = (np.arange(ROWS * FINE) + 0.5) / (ROWS * FINE)
    phi = 2 * np.pi * (np.arange(COLUMNS * FINE) + 0.5) / (COLUMNS * FINE)
    z, phi = np.meshgrid(z, phi, indexing="ij")
    sine = np.sqrt(1 - z * z)
    NoL, _, NoH, VoH, sin2 = brdf.half_angles(NUMPY, Z, (sine * np.cos(phi), sine * np.sin(phi), z), wo)
    density = brdf.mixture_pdf(NUMPY, NoL, NoH, VoH, sin2, roughness)
    shares = density.reshape(ROWS, FINE, COLUMNS, FINE).mean((1, 3)).ravel() * 2 * np.pi / (ROWS * COLUMNS)
    return np.append(shares, max(1 - shares.sum(), 0.0))


def _streams(draws: int) -> Iterator[Drawn]:
    """First two numbers of neighbouring lanes, by lane and by the number of a point."""
    from iif_core.light.transport.arrays import Batch
    from iif_core.light.transport.kernels import uniform

    number = (np.arange(draws, dtype=np.uint64) * 0x9E3779B1 & 0xFFFFFFFF).astype(np.uint32)
    for case, of in (("by lane", None), ("by number", number)):
        for seed in (0, 1, 2**40 + 5):
            random = Batch(slice(0, draws), 1, 0).streams(seed, of)
            first, second = (np.array(uniform(random), np.float64) for _ in range(2))
            shares = np.full(32 * 32, 1 / 1024)
            counts = _grid(first, second, 32, 32)
            yield Drawn("random numbers of a lane", "drjit float32", f"{case}, seed {seed}", draws, *chi_squared(counts, shares))
            counts = _grid(first[:-1], first[1:], 32, 32)  # of one lane and the next
            case_of_two = f"{case}, seed {seed}, with the next lane"
            yield Drawn("random numbers of a lane", "drjit float32", case_of_two, draws - 1, *chi_squared(counts, shares))


def _faces(draws: int) -> Iterator[Drawn]:
    """Emitting faces of weights over eight decades, and points on them."""
    import mitsuba as mi

    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry

    rng = np.random.default_rng(4)
    count = 200
    corners = rng.normal(size=(count, 3, 3)) * np.geomspace(0.01, 3, count)[:, None, None]
    geometry = build_geometry(
        corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count).reshape(-1, 3), np.zeros(count, np.int32)
    )
    for case, weight in (("by power", None), ("weights 1e-8 to 1", np.geomspace(1e-8, 1, count))):
        emitters = Emitters(geometry, np.ones((count, 3)), sampling_weight=weight)
        u0, u1, u2 = (np.minimum(rng.random(draws), 1 - 2**-24).astype(np.float32) for _ in range(3))
        face, _, _ = emitters.sample(mi.Float(u0), True)
        root = np.sqrt(u1)
        point = geometry.point_on_face(face, mi.Float(1 - root), mi.Float(root * u2), True)
        face = np.array(face)
        shares = emitters.pdf_area.astype(np.float64) * geometry.areas
        counts = np.bincount(face, minlength=count)
        yield Drawn("emitting face", "drjit float32", case, draws, *chi_squared(counts, shares / shares.sum()))
        b1, b2 = _barycentric(np.array(point).T.astype(np.float64), corners[face])
        # The part of the triangle that is nearer to v1 than a line through the point, and the place along that line.
        counts = _grid((1 - b1) ** 2, b2 / np.maximum(1 - b1, 1e-9), 16, 16)
        yield Drawn("point on a face", "drjit float32", case, draws, *chi_squared(counts, np.full(256, 1 / 256)))


def _barycentric(point: NDArray, corners: NDArray) -> Pair:
    e1, e2, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], point - corners[:, 0]
    a, b, c = ((u * v).sum(1) for u, v in ((e1, e1), (e1, e2), (e2, e2)))
    d, e = (e1 * p).sum(1), (e2 * p).sum(1)
    below = a * c - b * b
    return np.clip((c * d - b * e) / below, 0, 1), np.clip((a * e - b * d) / below, 0, 1)


def _environment(draws: int) -> Iterator[Drawn]:
    """Texels of a map whose radiance spans ten decades, with the sun in one of them, and directions in them."""
    import mitsuba as mi

    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry

    height, width = 16, 32
    rng = np.random.default_rng(6)
    radiance = np.exp(rng.uniform(-5, 5, (height, width, 1))) * np.ones(3)
    radiance[3, 7] = 1e6
    triangle = build_geometry(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), np.zeros(1, np.int32))
    for case, sky in (("a sun", radiance), ("even", np.ones((height, width, 3)))):
        emitters = Emitters(triangle, np.zeros((1, 3)), environment=sky)
        u0, u1, u2 = (np.minimum(rng.random(draws), 1 - 2**-24).astype(np.float32) for _ in range(3))
        _, _, texel = emitters.sample(mi.Float(u0), True)
        way = emitters.direction_to(texel, mi.Float(u1), mi.Float(u2))
        d = tuple(np.array(axis, np.float64) for axis in way)
        row, column = (np.asarray(a).astype(np.int64) for a in texel_of(NUMPY, d, height, width))
        shares = (emitters.pdf_sky * solid_angles(height, width)).ravel().astype(np.float64)
        counts = np.bincount(row * width + column, minlength=height * width)
        yield Drawn("texel of the environment", "drjit float32", case, draws, *chi_squared(counts, shares / shares.sum()))
        fine_row, fine_column = (np.asarray(a).astype(np.int64) for a in texel_of(NUMPY, d, 8 * height, 8 * width))
        part = (fine_row % 8) * 8 + fine_column % 8
        inner = solid_angles(8 * height, 8 * width).reshape(height, 8, width, 8) / solid_angles(height, width)[:, None, :, None]
        drawn = np.bincount(row * width + column, minlength=height * width).reshape(height, 1, width, 1)
        within = (inner * drawn).sum((0, 2)).ravel() / draws
        counts = np.bincount(part, minlength=64)
        yield Drawn("direction in a texel", "drjit float32", case, draws, *chi_squared(counts, within / within.sum()))
    row, column = np.zeros(draws), rng.integers(0, 1024, draws)
    d = direction_in(NUMPY, row, column, rng.random(draws), rng.random(draws), 512, 1024)
    # At the pole: 1 - z is uniform in a texel.
    counts = _grid((1 - np.asarray(d[2])) / (1 - np.cos(np.pi / 512)), _turn(d[0], d[1]), 16, 16)
    yield Drawn(
        "direction in a texel", "numpy float64", "at the pole, 512 x 1024", draws, *chi_squared(counts, np.full(256, 1 / 256))
    )


def measure(draws: int = DRAWS) -> Iterator[Drawn]:
    """Run all tests, with `draws` draws each."""
    device.mitsuba()
    for sampler in (_streams, _cosine, _half_vectors, _mixture, _faces, _environment):
        yield from sampler(draws)
