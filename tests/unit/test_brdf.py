"""Reflectance: published furnace table, float64, sampling statistics, equality across array libraries."""

from __future__ import annotations

import numpy as np
import pytest

from iif_core.numerics.xp import NUMPY
from iif_core.reflectance import brdf

RNG = np.random.default_rng(7)
Z = (0.0, 0.0, 1.0)
# Published to three digits from sampling, so good to about 1.5e-3.
FURNACE = {  # roughness: (S0, S1) at NoV = 1, 0.7, 0.4, 0.2, 0.1 for incident radiance 1
    0.02: [(1.000, 0.000), (0.895, 0.002), (0.646, 0.054), (0.291, 0.142), (0.087, 0.125)],
    0.216: [(0.993, 0.000), (0.849, 0.002), (0.564, 0.045), (0.249, 0.096), (0.104, 0.080)],
    0.412: [(0.927, 0.000), (0.758, 0.003), (0.509, 0.028), (0.319, 0.052), (0.241, 0.055)],
    0.608: [(0.748, 0.000), (0.628, 0.003), (0.501, 0.015), (0.426, 0.028), (0.396, 0.035)],
    0.804: [(0.510, 0.000), (0.491, 0.002), (0.485, 0.007), (0.492, 0.016), (0.504, 0.022)],
    1.0: [(0.306, 0.000), (0.360, 0.001), (0.435, 0.004), (0.503, 0.009), (0.544, 0.014)],
}


def view(NoV):
    return (np.sqrt(1 - NoV * NoV), 0.0, NoV)


def uniform_grid(n):
    u = (np.arange(n) + 0.5) / n
    return (part.ravel() for part in np.meshgrid(u, u, indexing="ij"))


def unit_vectors(n, dtype=np.float64):
    v = RNG.normal(size=(3, n))
    v[2] = np.abs(v[2]) + 1e-3
    return tuple((v / np.linalg.norm(v, axis=0)).astype(dtype))


def sampled_albedo(r, NoV):
    """(S0, S1) for incident radiance 1 by drawing half vectors on a regular grid of uniforms."""
    wo = view(NoV)
    wi = brdf.reflect(wo, brdf.sample_ggx_half(NUMPY, *uniform_grid(700), r))
    _, _, NoH, VoH, sin2 = angles = brdf.half_angles(NUMPY, Z, wi, wo)
    _, spec, fc = brdf.lobes(NUMPY, *angles, r)
    pdf = brdf.specular_pdf(NUMPY, NoH, VoH, sin2, r)
    weight = np.divide(spec, pdf, out=np.zeros_like(spec), where=pdf > 0)
    return np.mean(weight * (1 - fc)), np.mean(weight * fc)


@pytest.mark.parametrize("r", FURNACE)
def test_furnace_table(r):
    for NoV, expected in zip((1, 0.7, 0.4, 0.2, 0.1), FURNACE[r], strict=True):
        assert sampled_albedo(r, NoV) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(("r", "NoV"), [(0.608, 0.1), (0.804, 0.2), (1.0, 1.0)])
def test_furnace_by_integrating_the_textbook_form(r, NoV):
    z, turn = uniform_grid(1200)
    sine = np.sqrt(1 - z * z)
    wi, wo = (
        np.array([sine * np.cos(2 * np.pi * turn), sine * np.sin(2 * np.pi * turn), z]),
        np.array(view(NoV)),
    )
    h = wi + wo[:, None]
    h /= np.linalg.norm(h, axis=0)
    spec, fc = textbook(z, NoV, 1 - h[2] ** 2, wo @ h, r)
    expected = 2 * np.pi * np.mean(spec * (1 - fc)), 2 * np.pi * np.mean(spec * fc)
    assert sampled_albedo(r, NoV) == pytest.approx(expected, abs=3e-4)


def test_diffuse_lobe_integrates_to_one():
    u1, u2 = uniform_grid(200)
    wi = brdf.sample_cosine(NUMPY, u1, u2)
    diffuse, _, _ = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, Z, wi, view(0.6)), 0.5)
    assert np.mean(diffuse * np.pi / wi[2]) == pytest.approx(1, abs=1e-9)


def textbook(NoL, NoV, sin2_h, VoH, r):
    """The formulae of the paper, in float64 and without any rearrangement."""
    NoH = np.sqrt(1 - sin2_h)
    alpha2 = r**4
    d = alpha2 / (np.pi * (NoH**2 * (alpha2 - 1) + 1) ** 2)
    k = (r + 1) ** 2 / 8
    geometric = NoL / (NoL * (1 - k) + k) * NoV / (NoV * (1 - k) + k)
    return d * geometric / (4 * NoL * NoV) * NoL, (1 - VoH) ** 5


@pytest.mark.parametrize("r", [0.02, 0.05, 0.3, 1.0])
def test_float32_keeps_its_digits_at_the_peak(r):
    tan2 = r**4 * np.geomspace(1e-4, 1e4, 200)
    sin2 = (tan2 / (1 + tan2)).astype(np.float32)
    NoH = np.sqrt(1 - sin2.astype(np.float64)).astype(np.float32)
    NoL, NoV, VoH = (np.full(200, x, np.float32) for x in (0.7, 0.45, 0.8))
    _, spec, fc = brdf.lobes(NUMPY, NoL, NoV, NoH, VoH, sin2, np.float32(r))
    oracle, schlick = textbook(*(x.astype(np.float64) for x in (NoL, NoV, sin2, VoH)), np.float64(np.float32(r)))
    assert spec.dtype == np.float32
    np.testing.assert_allclose(spec, oracle, rtol=3e-6)
    np.testing.assert_allclose(fc, schlick, rtol=1e-5)


def test_float32_from_vectors_at_the_sharpest_lobe():
    wo = unit_vectors(2000)
    u1, u2 = RNG.random(2000) * 0.99, RNG.random(2000)
    wi = brdf.reflect(wo, brdf.sample_ggx_half(NUMPY, u1, u2, 0.02))
    single = [tuple(x.astype(np.float32) for x in v) for v in (wi, wo)]
    double = [tuple(x.astype(np.float64) for x in v) for v in single]
    z = tuple(np.float32(x) for x in Z)
    _, spec, _ = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, z, *single), np.float32(0.02))
    _, oracle, _ = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, Z, *double), np.float64(np.float32(0.02)))
    assert np.max(np.abs(spec - oracle) / (oracle + 1e-3)) < 5e-3  # h itself is known to 6e-8 of 4e-4


def test_compose_is_the_fresnel_form():
    wo, wi = unit_vectors(50), unit_vectors(50)
    a, r, m = RNG.random((3, 50)), 0.02 + 0.98 * RNG.random(50), RNG.random(50)
    kd, ks = brdf.kd_ks(a, m)
    diffuse, spec, fc = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, Z, wi, wo), r)
    np.testing.assert_allclose(
        brdf.compose(kd, ks, diffuse, spec * (1 - fc), spec * fc),
        kd * wi[2] / np.pi + (ks + (1 - ks) * fc) * spec,
        rtol=1e-12,
    )
    np.testing.assert_allclose(kd + ks, 0.04 * (1 - m) + a, rtol=1e-12)


def test_reflectance_is_reciprocal():
    wo, wi = unit_vectors(200), unit_vectors(200)
    r = 0.02 + 0.98 * RNG.random(200)
    _, there, fc_there = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, Z, wi, wo), r)
    _, back, fc_back = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, Z, wo, wi), r)
    np.testing.assert_allclose(there / wi[2], back / wo[2], rtol=1e-6)
    np.testing.assert_allclose(fc_there, fc_back, rtol=1e-9)


def test_extremes_are_finite_and_one_sided():
    zero, one = np.float32(0), np.float32(1)
    edge = [zero, np.float32(1e-7), np.float32(1e-3), one]
    grid = [g.ravel() for g in np.meshgrid(edge, edge, edge, edge, edge, [zero, np.float32(0.02), one], indexing="ij")]
    for value in (*brdf.lobes(NUMPY, *grid), brdf.specular_pdf(NUMPY, *grid[2:])):
        assert np.isfinite(value).all() and (value >= 0).all()
    diffuse, spec, _ = brdf.lobes(NUMPY, *grid)
    dark = (grid[0] == 0) | (grid[1] == 0)
    assert not diffuse[dark].any() and not spec[dark].any()
    opposite = brdf.half_angles(NUMPY, Z, (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    assert np.isfinite(opposite).all()
    for u in (0.0, 1.0 - 2**-24):
        assert np.isfinite(brdf.sample_ggx_half(NUMPY, np.float32(u), np.float32(u), np.float32(0.0))).all()
        assert np.isfinite(brdf.sample_cosine(NUMPY, np.float32(u), np.float32(u))).all()


def test_three_libraries_agree(llvm):
    import torch

    Float = llvm.Float
    from iif_core.numerics.xp import DRJIT, TORCH

    wo, wi = unit_vectors(3000, np.float32), unit_vectors(3000, np.float32)
    r = (0.02 + 0.98 * RNG.random(3000)).astype(np.float32)
    u1, u2 = RNG.random((2, 3000)).astype(np.float32)

    def everything(xp, convert):
        a, b, rough, v1, v2 = (
            [convert(x) for x in wi],
            [convert(x) for x in wo],
            convert(r),
            convert(u1),
            convert(u2),
        )
        normal = [convert(np.full(3000, x, np.float32)) for x in Z]
        NoL, NoV, NoH, VoH, sin2 = brdf.half_angles(xp, normal, a, b)
        return [
            *brdf.lobes(xp, NoL, NoV, NoH, VoH, sin2, rough),
            brdf.mixture_pdf(xp, NoL, NoH, VoH, sin2, rough),
            *brdf.sample_ggx_half(xp, v1, v2, rough),
            *brdf.sample_cosine(xp, v1, v2),
        ]

    reference = everything(NUMPY, lambda x: x)
    assert all(value.dtype == np.float32 for value in reference)
    for result in (everything(DRJIT, Float), everything(TORCH, torch.from_numpy)):
        for value, expected in zip(result, reference, strict=True):
            np.testing.assert_allclose(value.numpy(), expected, rtol=2e-4, atol=2e-6)


def test_torch_gradients_are_finite_at_the_edges():
    torch = pytest.importorskip("torch")
    from iif_core.numerics.xp import TORCH

    r = torch.tensor([0.02, 0.02, 1.0, 1.0], requires_grad=True)
    NoL = torch.tensor([0.0, 1.0, 0.0, 1.0])
    one = torch.ones(4)
    diffuse, spec, fc = brdf.lobes(TORCH, NoL, one, one, one, torch.zeros(4), r)
    (diffuse + spec + fc).sum().backward()
    assert torch.isfinite(r.grad).all()


def test_lobes_are_drawn_by_what_they_reflect():
    chance = brdf.specular_chance(
        NUMPY, np.array([0.8, 0.0, 0.8, 0.0]), np.array([0.04, 0.9, 0.04, 0.0]), np.array([1.0, 1.0, 1e-3, 1.0])
    )
    assert chance[0] == 0.05 and chance[1] == 0.95 and 0.4 < chance[2] < 0.6 and chance[3] == 0.05
    steep = brdf.specular_chance(NUMPY, 0.5, 0.04, np.linspace(0, 1, 101))
    assert (np.diff(steep) <= 0).all() and np.isfinite(steep).all()
    angles = 0.7, 0.9, 0.5, 0.2
    both = [brdf.mixture_pdf(NUMPY, *angles, 0.3, c) for c in (0.0, 0.25, 1.0)]
    assert both[0] == pytest.approx(0.7 / np.pi) and both[1] == pytest.approx(0.75 * both[0] + 0.25 * both[2])
