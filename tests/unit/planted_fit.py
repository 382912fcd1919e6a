"""Problems of the material fit whose answer is known."""

import numpy as np

from iif_core.fitting.levels import interpolate_levels
from iif_core.fitting.problem import FitProblem
from iif_core.reflectance.material import IDENTITY, apply_affines

LEVELS = np.linspace(0.02, 1.0, 10)


def shading_of(rng, n, levels=LEVELS):
    """Light that looks like a room: diffuse, and lobes that go from a sharp reflection to a blurred one."""
    diffuse = np.exp(rng.normal(-0.8, 0.7, (n, 1))) * np.exp(rng.normal(0, 0.1, (n, 3)))
    sharp, middle = (np.exp(rng.normal(-1.0, s, (n, 1, 3))) for s in (1.2, 0.7))
    blur = levels[None, :, None] ** 0.5
    s0 = (1 - blur) ** 2 * sharp + 2 * blur * (1 - blur) * middle + blur**2 * 0.4 * diffuse[:, None]
    s1 = 0.05 * (1 - 0.8 * blur) * sharp + 0.01 * diffuse[:, None]
    return diffuse, s0, s1


def radiance_of(material, shading, levels=LEVELS):
    d, s0, s1 = shading
    a, m = material[:, :3], material[:, 4:5]
    f0 = 0.04 * (1 - m) + m * a
    parts = [interpolate_levels(s, levels, material[:, 3])[0] for s in (s0, s1)]
    return (1 - m) * a * d + f0 * parts[0] + parts[1]


def planted(rng, n_objects, strength=0.25, roughness=True):
    t = np.tile(IDENTITY, (n_objects, 1))
    t[:, :12] += rng.normal(0, 0.05, (n_objects, 12))
    t[:, [0, 5, 10]] += rng.uniform(-strength, strength, (n_objects, 3))
    if roughness:
        t[:, 12], t[:, 13] = rng.uniform(0.8, 1.0, n_objects), rng.uniform(0.02, 0.1, n_objects)
    return t


def problem_of(rng, n_objects=6, per_object=400, truth=None, value_of=None, noise=0.0, halves=1, base=None):
    obj = np.repeat(np.arange(n_objects), per_object)
    n = len(obj)
    if base is None:
        base = np.c_[rng.uniform(0.2, 0.6, (n, 3)), rng.uniform(0.3, 0.7, n), np.zeros(n)]
    shading = shading_of(rng, n)
    truth = planted(rng, n_objects) if truth is None else truth
    radiance = radiance_of(apply_affines(truth, obj, base), shading)
    value = radiance if value_of is None else value_of(radiance)
    cached = []
    for _ in range(halves):
        if noise:
            # all lobes share their paths: one factor a pixel and channel, of mean 1
            factor = np.exp(rng.normal(0, noise, (n, 3)) - 0.5 * noise**2)
            cached.append((shading[0] * factor, shading[1] * factor[:, None], shading[2] * factor[:, None]))
        else:
            cached.append(shading)
    d, s0, s1 = (tuple(np.asarray(c[i], np.float32 if noise else np.float64) for c in cached) for i in range(3))
    problem = FitProblem(
        object_id=obj,
        n_objects=n_objects,
        base=base,
        diffuse=d,
        s0=s0,
        s1=s1,
        levels=LEVELS,
        value=value,
        exposure=np.ones(n),
        saturated=np.zeros((n, 3), bool),
    )
    return problem, truth
