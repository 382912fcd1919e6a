"""Prior `simulated`: ground truth with the errors of a single-view model (lab/docs/simulated.md#simulated, Eq. P.3 to P.9, P.30).

Every random number is a hash of (seed, name, object, view, sample) (Eq. P.2), so it does not depend on the order of evaluation,
on the size of the image, or on which other objects are in view. Where errors are not tied to objects, a Gaussian field in space
takes the place of each number of an object. `strength` multiplies every error; 0 returns the truth exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from lab.simulated.fields import Field, pixel_normal, standard_normal, tag, unit_interval


@dataclass(frozen=True)
class SimulatedErrors:
    """Sizes of the errors at strength 1. Logarithms are natural; colours linear.

    Attributes:
        gain_mean: mean log gain of the albedo. gain_object, gain_view, gain_sample: its standard deviation over objects, over
            the views of an object, over samples.
        tint_object, tint_sample: the same for each colour channel.
        offset_object, offset_sample: standard deviation of an added value per channel.
        desaturation: largest share by which colours move to their grey (uniform from 0, per object).
        good_share: share of samples that are good.
        good_residue: size of pattern, leak and blur in a good sample, relative to the others.
        pattern: log amplitude of hallucinated patterns in albedo; pattern_shared: share common to the samples of a view.
        leak: largest exponent of true shading in albedo (uniform from 0).
        blur: largest share of the blurred truth (uniform from 0); blur_sigma: width of the blur over the image width.
        noise: standard deviation of independent noise in every channel.
        roughness_target, metallic_target: range of the wrong value of an object; roughness_pull, metallic_pull: how far the
            prediction moves towards it, 1 = all the way.
        material_view, material_sample: standard deviation of offsets of roughness and metallic.
        material_pattern: amplitude of the pattern in roughness and metallic.
    """

    gain_mean: float = -0.27
    gain_object: float = 0.06
    gain_view: float = 0.10
    gain_sample: float = 0.12
    tint_object: float = 0.06
    tint_sample: float = 0.03
    offset_object: float = 0.02
    offset_sample: float = 0.01
    desaturation: float = 0.3
    good_share: float = 0.4
    good_residue: float = 0.12
    pattern: float = 0.5
    pattern_shared: float = 0.6
    leak: float = 0.3
    blur: float = 0.9
    blur_sigma: float = 0.04
    noise: float = 0.01
    roughness_target: tuple[float, float] = (0.385, 0.485)
    roughness_pull: float = 0.91
    metallic_target: tuple[float, float] = (0.49, 0.61)
    metallic_pull: float = 0.97
    material_view: float = 0.06
    material_sample: float = 0.08
    material_pattern: float = 0.10

    def with_shared(self, factor: float) -> SimulatedErrors:
        """Return the errors with those of the albedo that all views of an object share multiplied by `factor`."""
        shared = ("gain_object", "tint_object", "offset_object")
        return replace(self, **{name: factor * getattr(self, name) for name in shared})


RGBX = SimulatedErrors()
"""Errors of the size that the paper reports for RGB-X."""
LENGTH = 0.5
"""Correlation length of fields in metres: between that of a chair and that of a wall."""


def simulate_predictions(
    albedo: NDArray,
    roughness: NDArray,
    metallic: NDArray,
    object_id: NDArray | None,
    samples: int,
    view: int,
    seed: int,
    strength: float = 1.0,
    shading: NDArray | None = None,
    errors: SimulatedErrors = RGBX,
    points: NDArray | None = None,
    length: float = LENGTH,
) -> NDArray:
    """Simulate K predictions of a view.

    Args:
        albedo: (H, W, 3) linear truth; roughness, metallic: (H, W).
        object_id: (H, W) int, the units that errors belong to; -1 = none, which is one unit. Not read where there are `points`.
        samples: K >= 1.
        view, seed: any integers; equal ones give equal errors.
        strength: 0 = truth, 1 = the sizes in `errors`, at most 4.
        shading: (H, W) true shading > 0 up to scale (see `shading_proxy`); None = nothing leaks.
        errors: sizes at strength 1.
        points: (H, W, 3) surface in metres, NaN = none: the errors are fields in space and not tied to objects. None = they are.
        length: correlation length of the fields in metres.

    Returns:
        (K, H, W, 5) float32: linear albedo, perceptual roughness, metallic, in [0, 1].

    Raises:
        InputError: shapes that do not match, samples < 1, strength outside [0, 4], truth that is not finite.
    """
    if samples < 1 or not 0 <= strength <= 4:
        raise InputError(f"simulated prior: samples {samples} (at least 1), strength {strength} (between 0 and 4)")
    shape = np.shape(object_id if points is None else points)[:2]
    truth = _truth(albedo, roughness, metallic, shading, shape)
    if strength == 0 or truth.size == 0:
        return np.repeat(np.clip(truth, 0, 1)[None], samples, 0)

    e, s = errors, strength
    draw: _Draws
    if points is None:
        objects, unit = np.unique(object_id, return_inverse=True)
        draw = _Draws(seed, view, samples, objects.astype(np.int64))
    else:  # every pixel is a unit of its own
        unit = np.arange(truth[..., 0].size)
        draw = _FieldDraws(seed, view, samples, np.reshape(points, (-1, 3)), length)
    unit = unit.reshape(shape)
    patterns = _patterns(shape, draw, e)
    blurred = _blurred(truth[..., :3], e)
    log_shading = _log_shading(shading, shape)

    good = draw.uniform("good", "sample")[0] < e.good_share  # (n, K)
    residue = np.where(good, e.good_residue, 1.0) * s
    blur = np.clip(residue * e.blur * draw.uniform("blur", "sample")[0], 0, 1)
    leak = residue * e.leak * draw.uniform("leak", "sample")[0]
    amplitude = residue * e.pattern
    gain = np.exp(
        s
        * (
            e.gain_mean
            + e.gain_object * draw.normal("gain", "object")
            + e.gain_view * draw.normal("gain", "view")
            + e.gain_sample * draw.normal("gain", "sample")
            + e.tint_object * draw.normal("tint", "object", 3)
            + e.tint_sample * draw.normal("tint", "sample", 3)
        )
    )  # (3, n, K)
    offset = s * (e.offset_object * draw.normal("offset", "object", 3) + e.offset_sample * draw.normal("offset", "sample", 3))
    grey = np.clip(s * e.desaturation * draw.uniform("desaturation", "object"), 0, 1)[0, :, 0]  # (n,)
    pull = np.clip(s * np.array([e.roughness_pull, e.metallic_pull]), 0, 1)
    low, high = np.array([e.roughness_target, e.metallic_target]).T
    wrong = low[:, None, None] + (high - low)[:, None, None] * draw.uniform("target", "object", 2)
    shift = s * (e.material_view * draw.normal("material", "view", 2) + e.material_sample * draw.normal("material", "sample", 2))
    rippled = residue * e.material_pattern

    out = np.empty((samples, *shape, 5), np.float32)
    for k in range(samples):
        b = blur[unit, k][..., None]
        colour = truth[..., :3] * (1 - b) + blurred * b
        colour = colour + grey[unit][..., None] * (colour.mean(-1, keepdims=True) - colour)
        log_error = amplitude[unit, k][..., None] * patterns[k] + (leak[unit, k] * log_shading)[..., None]
        colour = colour * np.moveaxis(gain[:, unit, k], 0, -1) * np.exp(log_error) + np.moveaxis(offset[:, unit, k], 0, -1)
        out[k, ..., :3] = colour
        for p in range(2):
            value = truth[..., 3 + p] * (1 - pull[p]) + pull[p] * wrong[p, unit, 0]
            out[k, ..., 3 + p] = value + shift[p, unit, k] + rippled[unit, k] * patterns[k][..., p]
        out[k] += np.float32(s * e.noise) * draw.pixel_normal(k, shape)
    return np.clip(out, 0, 1)


def _truth(albedo: NDArray, roughness: NDArray, metallic: NDArray, shading: NDArray | None, shape: tuple[int, ...]) -> NDArray:
    """Stack the truth to (H, W, 5) float32 after checking shapes and values."""
    found = [np.shape(a) for a in (albedo, roughness, metallic)] + ([] if shading is None else [np.shape(shading)])
    if len(shape) != 2 or found[0] != (*shape, 3) or any(f != shape for f in found[1:]):
        raise InputError(
            f"simulated prior: albedo, roughness, metallic (and shading) {found} and object ids {shape} do not "
            "share height and width"
        )
    truth = np.concatenate([albedo, np.asarray(roughness)[..., None], np.asarray(metallic)[..., None]], -1, dtype=np.float32)
    if not np.isfinite(truth).all():
        raise InputError(f"simulated prior: {np.sum(~np.isfinite(truth))} values of the truth are not finite; fix the capture")
    return truth


def shading_proxy(radiance: NDArray, albedo: NDArray, object_id: NDArray, sigma: float = 0.02) -> NDArray:
    """Estimate smooth shading: mean radiance over mean albedo of the channels, blurred in the logarithm (Eq. P.8).

    Highlights are part of it, as they are part of what RGB-X leaks.

    Args:
        radiance, albedo: (H, W, 3) linear.
        object_id: (H, W) int, -1 = none.
        sigma: standard deviation of the blur over the longer side of the image.

    Returns:
        (H, W) float32 > 0 up to scale; pixels with albedo below 0.02 or without light take the value of their neighbourhood.
    """
    from scipy.ndimage import gaussian_filter

    light, reflectance = np.asarray(radiance, np.float64).mean(-1), np.asarray(albedo, np.float64).mean(-1)
    known = (reflectance > 0.02) & (light > 0) & np.isfinite(light) & (object_id >= 0)
    if not known.any():
        return np.ones(known.shape, np.float32)
    value = np.zeros(known.shape)
    value[known] = np.log(light[known] / reflectance[known])
    low, high = np.quantile(value[known], [0.02, 0.98])  # limits the influence of lamps and black corners
    value = np.where(known, np.clip(value, low, high), 0)
    width = sigma * max(known.shape)
    cover = gaussian_filter(known.astype(np.float64), width)
    blurred = gaussian_filter(value, width) / np.maximum(cover, 1e-6)
    return np.exp(np.where(cover > 1e-3, blurred, np.median(value[known]))).astype(np.float32)


def _log_shading(shading: NDArray | None, shape: tuple[int, ...]) -> NDArray:
    """Log shading relative to its median, clamped to [-2, 2]."""
    if shading is None:
        return np.zeros(shape)
    log = np.log(np.maximum(np.asarray(shading, np.float64), 1e-6))
    return np.clip(log - np.median(log), -2, 2)


def _blurred(albedo: NDArray, e: SimulatedErrors) -> NDArray:
    from scipy.ndimage import gaussian_filter

    sigma = e.blur_sigma * albedo.shape[1]
    return gaussian_filter(albedo, (sigma, sigma, 0), mode="nearest")


def _patterns(shape: tuple[int, ...], draw: _Draws, e: SimulatedErrors, waves: int = 6) -> list[NDArray]:
    """Smooth zero-mean colour fields of unit variance (H, W, 3), one per sample, partly common to the view (Eq. P.7)."""
    y, x = (np.arange(n) + 0.5 for n in shape)
    size = max(shape)

    def field(k: int) -> NDArray:
        out = np.zeros((*shape, 3))
        frequency = 2 * np.pi * 4 * draw.picture_normal("frequency", k, 2 * waves).reshape(waves, 2) / size
        phase = 2 * np.pi * draw.picture_uniform("phase", k, waves)
        colour = (
            0.15 * draw.picture_normal("colour", k, 3 * waves).reshape(waves, 3)
            + draw.picture_normal("height", k, waves)[:, None]
        )
        for (fx, fy), shift, rgb in zip(frequency, phase, colour, strict=True):
            out += np.sin(fx * x[None, :] + fy * y[:, None] + shift)[..., None] * rgb
        return out / np.sqrt(0.5 * np.maximum((colour**2).sum(0), 1e-6))

    common = field(-1)
    own = np.sqrt(1 - e.pattern_shared)
    return [np.sqrt(e.pattern_shared) * common + own * field(k) for k in range(draw.samples)]


class _Draws:
    """Random numbers of objects and pictures (Eq. P.2)."""

    def __init__(self, seed: int, view: int, samples: int, objects: NDArray):
        self.seed, self.view, self.samples, self.objects = seed, view, samples, objects
        k = np.arange(samples)
        self.keys: dict[str, tuple] = {"object": (), "view": (view,), "sample": (view, k)}

    def uniform(self, what: str, level: str, channels: int = 1) -> NDArray:
        """Uniforms in (0, 1): (channels, n, K), or (channels, n, 1) for levels above the sample."""
        channel, unit = np.arange(channels)[:, None, None], self.objects[None, :, None]
        return unit_interval(self.seed, tag(f"{what}/{level}"), channel, unit, *self.keys[level])

    def normal(self, what: str, level: str, channels: int = 1) -> NDArray:
        from scipy.special import ndtri

        return ndtri(self.uniform(what, level, channels))

    def picture_uniform(self, what: str, k: int, n: int) -> NDArray:
        return unit_interval(self.seed, tag(f"{what}/picture"), np.arange(n), self.view, k)

    def picture_normal(self, what: str, k: int, n: int) -> NDArray:
        return standard_normal(self.seed, tag(f"{what}/picture"), np.arange(n), self.view, k)

    def pixel_normal(self, k: int, shape: tuple[int, ...]) -> NDArray:
        return pixel_normal((*shape, 5), self.seed, tag("noise/pixel"), self.view, k)


class _FieldDraws(_Draws):
    """The same with a field in space for every number that an object has (Eq. P.30)."""

    def __init__(self, seed: int, view: int, samples: int, points: NDArray, length: float):
        super().__init__(seed, view, samples, np.zeros(0))
        self.fields = {level: Field(points, length, seed, tag(f"waves/{level}")) for level in self.keys}

    def normal(self, what: str, level: str, channels: int = 1) -> NDArray:
        drawn = self.fields[level](self.seed, tag(f"{what}/{level}/field"), np.arange(channels)[:, None], *self.keys[level])
        return np.moveaxis(drawn, 0, 1)

    def uniform(self, what: str, level: str, channels: int = 1) -> NDArray:
        from scipy.special import ndtr

        return ndtr(self.normal(what, level, channels))
