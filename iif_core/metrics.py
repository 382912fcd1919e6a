"""Scores of one image: L2, PSNR, SSIM, FLIP, LPIPS for maps; log-L2 and IoU for emission; three protocols (METHOD 2.11).

Protocols say what the prediction may be forgiven before it is compared:

| protocol | the prediction is |
|---|---|
| `raw` | taken as it is |
| `scaled` | multiplied by one gain per image and channel, sum truth / sum prediction (albedo, emission, radiance) |
| `oracle_affine` | mapped by each object's best affine to the truth: 3x4 for albedo, 1x2 for roughness, metallic |

Which pixels count is METHOD 2.11 (B), masks from the *truth*: emitters count for no material, mirrors (roughness below
0.05) not for albedo, nor pixels without a hit or without meaningful truth. A prediction cannot change its own mask.

All images are linear float (H, W) or (H, W, 3); `mask` is (H, W) bool. A score that cannot be computed is a `Score`
with `value=None` and the reason, never a NaN. Not quantised to 8 bits (the reference is; that moves L2 by 1e-6).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from .errors import InputError
from .lpips import Weights, lpips

Array = np.ndarray

PSNR_CAP = 100.0
"""PSNR of identical images, as in the reference; it would be infinite."""

MIRROR_ROUGHNESS = 0.05
"""Below this true roughness the albedo of a surface is not visible and not scored."""

SSIM_WINDOW = 11
PROTOCOLS = ("raw", "scaled", "oracle_affine")
PROTOCOLS_OF = {
    "albedo": PROTOCOLS,
    "roughness": ("raw", "oracle_affine"),
    "metallic": ("raw", "oracle_affine"),
    "emission": ("raw", "scaled"),
    "rgb": ("raw",),
}
"""Roughness and metallic have no gain that the photographs leave open; emission x albedo has one (LDR)."""

METRICS_OF = {
    "albedo": ("l2", "psnr", "ssim", "flip", "lpips", "lpips_vgg"),
    "roughness": ("l2", "psnr", "ssim", "lpips", "lpips_vgg"),
    "metallic": ("l2", "psnr", "ssim", "lpips", "lpips_vgg"),
    "emission": ("l2", "log_l2", "iou"),
    "rgb": ("l2", "psnr", "ssim", "flip", "lpips", "lpips_vgg"),
}
LPIPS_NETWORKS = {"lpips": "alex", "lpips_vgg": "vgg"}
"""The paper reports LPIPS with VGG16; AlexNet is what its authors recommend, and a twentieth of the work."""

_MIN_MEAN = 1e-4  # H36: a darker prediction is not scaled
_SCORED_MIN = 1e-6  # emission below this is no emission


@dataclass(frozen=True)
class Score:
    """One number, or the reason why there is none."""

    metric: str
    protocol: str
    value: float | None
    reason: str = ""


# --------------------------------------------------------------------------------------------------------------- masks


def material_masks(valid: Array, hit: Array, emission: Array, roughness: Array) -> dict[str, Array]:
    """Pixels that count for each quantity, METHOD 2.11 (B).

    Args:
        valid: (H, W) bool, the truth means something here.
        hit: (H, W) bool, the pixel sees the mesh.
        emission: (H, W, 3) true radiance; more than 0 in any channel = emitter.
        roughness: (H, W) true perceptual roughness.

    Returns:
        `albedo`, `roughness`, `metallic`, `emission`: (H, W) bool.
    """
    seen = np.asarray(valid, bool) & np.asarray(hit, bool)
    material = seen & ~(emission > 0).any(-1)
    return {
        "albedo": material & (roughness >= MIRROR_ROUGHNESS),
        "roughness": material,
        "metallic": material,
        "emission": seen,
    }


# ------------------------------------------------------------------------------------------------------------- metrics


def l2(prediction: Array, truth: Array, mask: Array) -> float:
    """Mean squared error over the masked pixels and the channels (not a root). The mask must not be empty."""
    difference = prediction[mask].astype(np.float64) - truth[mask]
    return float(np.mean(difference * difference))


def psnr(prediction: Array, truth: Array, mask: Array) -> float:
    """10 log10(1 / MSE) in dB, data range 1, at most 100. Example: every pixel 0.1 off -> 20."""
    error = l2(prediction, truth, mask)
    return PSNR_CAP if error <= 10 ** (-PSNR_CAP / 10) else float(-10 * np.log10(error))


def ssim(prediction: Array, truth: Array, mask: Array) -> float:
    """Structural similarity: Gaussian window of 11 pixels, sigma 1.5, K1 0.01, K2 0.03, range 1 (Wang et al. 2004).

    Pixels that do not count get the truth on both sides, and the map of local similarities is averaged over pixels
    that count: a window that reaches over the border of the mask sees agreement there, so such pixels score slightly
    too well. As in the common implementations, the 5 pixels next to the image border are windows only, unless nothing
    else counts.

    Raises:
        InputError: an image smaller than the window.
    """
    from skimage.metrics import structural_similarity

    if min(mask.shape) < SSIM_WINDOW:
        raise InputError(f"SSIM of a {mask.shape[1]}x{mask.shape[0]} image: at least {SSIM_WINDOW} pixels are needed each way")
    inside = mask if mask.ndim == truth.ndim else mask[..., None]
    truth = np.where(np.isfinite(truth), truth, 0).astype(np.float32)
    filled = np.where(inside, prediction, truth).astype(np.float32)
    _, similarity = structural_similarity(
        truth,
        filled,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2 if truth.ndim == 3 else None,
        full=True,
    )
    border = SSIM_WINDOW // 2
    interior = np.zeros(mask.shape, bool)
    interior[border:-border, border:-border] = True
    counted = mask & interior if (mask & interior).any() else mask
    return float(similarity[counted].mean(dtype=np.float64))


def has_flip() -> bool:
    """Whether the optional package `flip-evaluator` is installed."""
    from importlib.util import find_spec

    return find_spec("flip_evaluator") is not None


def flip(prediction: Array, truth: Array, mask: Array, encoded: bool = False) -> float:
    """LDR-FLIP (Andersson et al. 2020), mean over the masked pixels, 0 = same; needs `flip-evaluator`.

    Pixels that do not count get the truth on both sides. `encoded`: the images are sRGB-encoded, else linear.
    """
    from flip_evaluator import evaluate

    truth = np.where(np.isfinite(truth), truth, 0).astype(np.float32)
    filled = np.where(mask[..., None], np.clip(prediction, 0, 1), truth).astype(np.float32)
    error, _, _ = evaluate(np.clip(truth, 0, 1), filled, "LDR", inputsRGB=encoded, applyMagma=False, computeMeanError=False)
    return float(np.asarray(error)[..., 0][mask].mean(dtype=np.float64))


def log_l2(prediction: Array, truth: Array, mask: Array) -> float:
    """Mean squared error of log(1 + x), for radiance (negative values count as 0)."""
    difference = np.log1p(np.maximum(prediction[mask].astype(np.float64), 0)) - np.log1p(np.maximum(truth[mask], 0))
    return float(np.mean(difference * difference))


def iou(prediction: Array, truth: Array, mask: Array) -> float:
    """Intersection over union of the emitting pixels (any channel above 1e-6); 1 when neither image emits."""
    p, t = ((image[mask] > _SCORED_MIN).any(-1) for image in (prediction, truth))
    union = np.count_nonzero(p | t)
    return np.count_nonzero(p & t) / union if union else 1.0


# ----------------------------------------------------------------------------------------------------------- protocols


def scaled(prediction: Array, truth: Array, mask: Array, limit: float | None = 1.0) -> Array:
    """Prediction times one gain per channel, sum truth / sum prediction over the mask; clamped to [0, limit].

    A channel whose mean prediction is below 1e-4 keeps gain 1 (METHOD H36), and so does one whose truth is black: a gain of
    0 would erase what was wrongly found there. `limit=None`: not clamped above.
    """
    prediction = np.asarray(prediction, np.float64)
    mean_prediction = prediction[mask].mean(0)
    mean_truth = np.asarray(truth, np.float64)[mask].mean(0)
    known = (mean_prediction >= _MIN_MEAN) & (mean_truth > 0)
    gain = np.where(known, mean_truth / np.maximum(mean_prediction, _MIN_MEAN), 1.0)
    return np.clip(prediction * gain, 0, limit)


def oracle_affine(prediction: Array, truth: Array, mask: Array, object_id: Array, ridge: float = 1e-6) -> Array:
    """Prediction mapped by the affine of each object that is nearest to the truth: an upper bound, not a result.

    Least squares per image and object, y = A (x - mean x) + mean y with A = S_yx (S_xx + ridge I)^-1 from the object's
    pixels in `mask`; 3x4 for three channels, 1x2 for one; clamped to [0, 1]. Where the prediction is constant, A tends
    to 0 and the object gets its mean. Pixels outside the mask are left as they are.

    Args:
        object_id: (H, W) int; -1 forms one object.
        ridge: added variance; 1e-6 = differences of 0.001 are not stretched.
    """
    x = np.asarray(prediction, np.float64).reshape(*mask.shape, -1)
    y = np.asarray(truth, np.float64).reshape(*mask.shape, -1)
    out = x.copy()
    if mask.any():
        objects, o = np.unique(object_id[mask], return_inverse=True)
        xs, ys, n = x[mask], y[mask], len(objects)
        count = np.bincount(o, minlength=n)
        mean_x, mean_y = (_sums(o, v, n) / count[:, None] for v in (xs, ys))
        dx, dy = xs - mean_x[o], ys - mean_y[o]
        s_xx = _sums(o, (dx[:, :, None] * dx[:, None, :]).reshape(len(o), -1), n).reshape(n, x.shape[-1], -1)
        s_xy = _sums(o, (dx[:, :, None] * dy[:, None, :]).reshape(len(o), -1), n).reshape(n, x.shape[-1], -1)
        s_xx += ridge * count[:, None, None] * np.eye(x.shape[-1])
        slope = np.linalg.solve(s_xx, s_xy)  # (objects, channels of x, channels of y)
        out[mask] = np.clip(np.einsum("ni,nij->nj", dx, slope[o]) + mean_y[o], 0, 1)
    return out.reshape(np.shape(prediction))


def _sums(group: Array, values: Array, n: int) -> Array:
    """(n, k) sums of (m, k) values by group."""
    return np.stack([np.bincount(group, values[:, i], n) for i in range(values.shape[1])], -1)


# ----------------------------------------------------------------------------------------------------------- one image


def score_map(
    quantity: str,
    prediction: Array,
    truth: Array,
    mask: Array,
    object_id: Array | None = None,
    metrics: Iterable[str] | None = None,
    encoded: bool = False,
    networks: Mapping[str, Weights] | None = None,
) -> list[Score]:
    """Every score of one map under every protocol that applies to its quantity.

    Args:
        quantity: `albedo`, `roughness`, `metallic`, `emission` or `rgb`.
        prediction, truth: (H, W, 3), or (H, W) for roughness and metallic.
        mask: (H, W) bool, pixels that count.
        object_id: (H, W) int, for `oracle_affine`; without it that protocol is left out.
        metrics: default: all of the quantity; FLIP only where its package is installed, LPIPS where its network is given.
        encoded: images are sensor values, not linear (matters to FLIP only; LPIPS takes every image as it is).
        networks: `alex` and `vgg` -> weights of LPIPS (`iif_core.lpips`).

    Raises:
        InputError: unknown quantity, or shapes that do not match.
    """
    if quantity not in PROTOCOLS_OF:
        raise InputError(f"score of {quantity!r}: unknown quantity; allowed: {', '.join(PROTOCOLS_OF)}")
    if np.shape(prediction) != np.shape(truth) or np.shape(truth)[:2] != np.shape(mask):
        raise InputError(
            f"score of {quantity}: prediction {np.shape(prediction)}, truth {np.shape(truth)}, mask {np.shape(mask)};"
            " they must share height, width and channels"
        )
    wanted = tuple(METRICS_OF[quantity] if metrics is None else metrics)
    wanted = tuple(m for m in wanted if m != "flip" or has_flip())
    networks = networks or {}
    wanted = tuple(m for m in wanted if m not in LPIPS_NETWORKS or LPIPS_NETWORKS[m] in networks)
    protocols = [p for p in PROTOCOLS_OF[quantity] if p != "oracle_affine" or object_id is not None]
    problem = _problem(prediction, truth, mask)
    if problem:
        return [Score(m, protocol, None, problem) for protocol in protocols for m in wanted if m != "iou" or protocol == "raw"]
    images = {}
    for protocol in protocols:
        images[protocol] = np.asarray(prediction, np.float64)
        if protocol == "scaled":
            images[protocol] = scaled(prediction, truth, mask, None if quantity == "emission" else 1.0)
        elif protocol == "oracle_affine":
            assert object_id is not None
            images[protocol] = oracle_affine(prediction, truth, mask, object_id)
    learned = {m: _lpips(m, images, truth, mask, networks) for m in wanted if m in LPIPS_NETWORKS}
    out = []
    for protocol, image in images.items():
        for metric in wanted:
            if metric in learned:
                out.append(learned[metric][protocol])
            elif metric != "iou" or protocol == "raw":  # a mask has no scale
                out.append(_score(metric, protocol, image, truth, mask, encoded))
    return out


def _lpips(metric: str, images: dict[str, Array], truth: Array, mask: Array, networks: Mapping[str, Weights]) -> dict[str, Score]:
    """One score a protocol; the truth goes through the network once."""
    network = LPIPS_NETWORKS[metric]
    try:
        values = lpips(np.stack(list(images.values())), truth, networks[network], mask, network)
    except InputError as error:
        return {protocol: Score(metric, protocol, None, str(error)) for protocol in images}
    return {protocol: Score(metric, protocol, float(value)) for protocol, value in zip(images, values, strict=True)}


def _problem(prediction: Array, truth: Array, mask: Array) -> str:
    if not mask.any():
        return "no pixel counts"
    for name, image in (("prediction", prediction), ("truth", truth)):
        bad = np.count_nonzero(~np.isfinite(image[mask]))
        if bad:
            return f"{name} is not finite in {bad} values"
    return ""


_FUNCTIONS = {"l2": l2, "psnr": psnr, "ssim": ssim, "log_l2": log_l2, "iou": iou}


def _score(metric: str, protocol: str, image: Array, truth: Array, mask: Array, encoded: bool) -> Score:
    try:
        value = flip(image, truth, mask, encoded) if metric == "flip" else _FUNCTIONS[metric](image, truth, mask)
    except InputError as error:
        return Score(metric, protocol, None, str(error))
    return Score(metric, protocol, float(value))
