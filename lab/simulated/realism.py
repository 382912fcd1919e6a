"""What real captures do to photographs and cameras: automatic exposure, white balance, blur, noise, JPEG, wrong poses
(lab/docs/simulated.md#as-captured). Every function is pure; randomness comes from the generator that it is given."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from iif_core.camera.pinhole import project
from iif_core.camera.view import View
from lab.simulated.photographs import exposures

Array = np.ndarray

ELECTRONS = 7045.0
"""That saturate a pixel at ISO 800: Nikon D800, 0.43 electrons a step of 14 bits (photonstophotos.net, D800 Read Noise)."""
READ_ELECTRONS = 4.2
"""Standard deviation of its read noise at ISO 800, from the same table."""
WHITE_BALANCE = 0.06
"""Standard deviation of the log gain of red and of blue against green. The 24 photographs of Red Kitchen differ by up to 25 %
(lab/notebook/real-scenes.md); the larger of the two ranges of 24 normal numbers of this deviation is 0.26 on average."""
BLUR = 0.5
"""Standard deviation of the lens blur in pixels."""
JPEG_QUALITY = 92
POSE_ERROR = 0.3
"""Root mean square reprojection error of a pose, in pixels."""
FOCAL_ERROR = 0.001
"""Relative error of the focal length."""

_STREAMS = ("white_balance", "noise", "pose", "focal", "mesh")


def stream(seed: int, effect: str, number: int = 0) -> np.random.Generator:
    """Return the random numbers of an effect for a view, which depend on nothing else."""
    return np.random.default_rng([seed, 0x7265616C, _STREAMS.index(effect), number])


def automatic_exposures(radiance: Sequence[Array], metered: Sequence[Array]) -> Array:
    """Expose every view by itself, as a camera does: its median luminance becomes 0.18, or less where more than 3 % of its
    metered pixels would saturate.

    Args:
        radiance: linear, (..., 3) per view.
        metered: (...) bool per view: no lamps.

    Returns:
        (V,) float64.
    """
    return np.array([exposures([one], [mask])[0] for one, mask in zip(radiance, metered, strict=True)])


def white_balance(rng: np.random.Generator, spread: float = WHITE_BALANCE) -> Array:
    """Draw the gains (3,) of the channels of one photograph: log(R/G) and log(B/G) ~ N(0, spread^2), the least gain 1.

    No gain is below 1, so that a saturated pixel stays saturated.
    """
    red, blue = rng.normal(0, spread, 2)
    gains = np.exp([red, 0.0, blue])
    return gains / gains.min()


def lens_blur(image: Array, sigma: float = BLUR) -> Array:
    """Convolve (H, W, 3) linear values with a Gaussian of `sigma` pixels; the border is mirrored."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(image, (sigma, sigma, 0))


def sensor_noise(signal: Array, rng: np.random.Generator, electrons: float = ELECTRONS, read: float = READ_ELECTRONS) -> Array:
    """Add shot and read noise to linear sensor values >= 0, of which 1 saturates.

    With n ~ Poisson(electrons * signal) the value is (n + read * z) / electrons, z ~ N(0, 1): its mean is the signal, its
    variance gain * signal + (gain * read)^2 with gain = 1 / electrons (photon transfer).
    """
    counted = rng.poisson(electrons * signal) + read * rng.standard_normal(signal.shape)
    return counted / electrons


def jpeg(photo: Array, quality: int = JPEG_QUALITY) -> Array:
    """Compress and decompress an 8-bit photograph (H, W, 3), given and returned as float32 multiples of 1 / 255."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * photo).astype(np.uint8)).save(buffer, "JPEG", quality=quality)
    return (np.asarray(Image.open(buffer)) / 255).astype(np.float32)


def reprojection_error(points: Array, view: View, other: View) -> float:
    """Return the root mean square distance in pixels between the projections of points (n, 3) into two cameras."""
    (u, v, _), (s, t, _) = (project(points, c.fx, c.fy, c.cx, c.cy, c.world_from_camera) for c in (view, other))
    return float(np.sqrt(np.nanmean((u - s) ** 2 + (v - t) ** 2)))


def misplaced(view: View, points: Array, rng: np.random.Generator, pixels: float = POSE_ERROR) -> View:
    """Turn and shift a camera at random, such that the reprojection error of the surface that it sees is `pixels`.

    Rotation and translation have random directions, and each alone would cause the same error.

    Args:
        view: the true camera.
        points: (n, 3) what it sees, metres; without any the camera stays.
        rng: random numbers.
        pixels: root mean square reprojection error.
    """
    if not len(points):
        return view
    turn, shift = rng.normal(size=3), rng.normal(size=3)

    def moved(a: float, b: float) -> View:
        from scipy.spatial.transform import Rotation

        pose = np.array(view.world_from_camera, np.float64)
        pose[:3, 3] += pose[:3, :3] @ (b * shift)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(a * turn).as_matrix()
        return replace(view, world_from_camera=pose)

    tiny = 1e-4 / view.fx  # radians, and metres: so small that the error is linear
    a, b = (pixels * tiny / reprojection_error(points, view, moved(*pair)) for pair in ((tiny, 0), (0, tiny)))
    scale = 1.0
    for _ in range(5):  # nearly linear, so that every step gains digits
        scale *= pixels / reprojection_error(points, view, moved(scale * a, scale * b))
    return moved(scale * a, scale * b)


def focal_factor(rng: np.random.Generator, error: float = FOCAL_ERROR) -> float:
    """Draw the factor on the focal length that all photographs share: 1 + error or 1 - error."""
    return 1 + error * float(rng.choice([-1, 1]))
