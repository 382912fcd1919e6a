"""Scores of one image (docs/method/evaluation.md): L2, PSNR, SSIM, FLIP and LPIPS of maps; log-L2 and IoU of emission.

Protocols (`catalogue.PROTOCOLS`) say what a prediction is forgiven before it is compared. The masks of the pixels that count come
from the truth (Eq. E.1). Images are linear float (H, W) or (H, W, 3), not quantised to 8 bits; `mask` is (H, W) bool. A score
that cannot be computed is a `Score` with `value=None` and the reason, never NaN.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from iif_core.errors import InputError
from iif_core.evaluation.catalogue import LPIPS_NETWORKS, METRICS_OF, PERCEPTUAL, PROTOCOLS, PROTOCOLS_OF
from iif_core.evaluation.flip import Seen, difference
from iif_core.evaluation.lpips import Lpips, Weights
from iif_core.numerics.filters import correlate

Array = np.ndarray

PSNR_CAP = 100.0
"""PSNR of identical images, which would be infinite (docs/method/numerics.md#psnr-of-identical-images)."""

MIRROR_ROUGHNESS = 0.05
"""True roughness below which the albedo of a surface is not visible and not scored."""

SSIM_WINDOW = 11
_MIN_MEAN = 1e-4  # darker predictions are not scaled (docs/method/numerics.md#scaling-a-black-image)
_MIN_EMISSION = 1e-6  # smaller radiance does not count as emission


@dataclass(frozen=True)
class Score:
    """One number, or the reason why there is none."""

    metric: str
    protocol: str
    value: float | None
    reason: str = ""


def material_masks(valid: Array, hit: Array, emission: Array, roughness: Array) -> dict[str, Array]:
    """Find the pixels that count for each quantity (Eq. E.1).

    Args:
        valid: (H, W) bool, whether the truth is meaningful.
        hit: (H, W) bool, whether the pixel sees the mesh.
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


def _decibel(error: float) -> float:
    return PSNR_CAP if error <= 10 ** (-PSNR_CAP / 10) else float(-10 * np.log10(error))


class _Structure:
    """A truth and the moments of its windows."""

    def __init__(self, truth: Array, mask: Array):
        if min(mask.shape) < SSIM_WINDOW:
            raise InputError(
                f"SSIM of a {mask.shape[1]}x{mask.shape[0]} image: at least {SSIM_WINDOW} pixels are needed each way"
            )
        x = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
        self.window = np.exp(-x * x / (2 * 1.5**2))
        self.window /= self.window.sum()
        self.truth = _planes(truth)
        self.moments = [(self._mean(t), self._mean(t * t)) for t in self.truth]
        border = SSIM_WINDOW // 2
        interior = np.zeros(mask.shape, bool)
        interior[border:-border, border:-border] = True
        self.counted = mask & interior if (mask & interior).any() else mask

    def _mean(self, plane: Array) -> Array:
        return correlate(plane, self.window, self.window, "symmetric")

    def similarity(self, filled: Array) -> float:
        """SSIM of `filled`, the prediction with the truth where the mask does not count."""
        total = 0.0
        for p, t, (mean_t, square_t) in zip(_planes(filled), self.truth, self.moments, strict=True):
            mean_p, square_p, product = self._mean(p), self._mean(p * p), self._mean(p * t)
            means, product_of_means = mean_p * mean_p + mean_t * mean_t, mean_p * mean_t
            local = (2 * product_of_means + 0.01**2) * (2 * (product - product_of_means) + 0.03**2)
            local /= (means + 0.01**2) * (square_p + square_t - means + 0.03**2)
            total += local[self.counted].mean()
        return float(total / len(self.truth))


def _planes(image: Array) -> Array:
    """(channels, H, W) float64 of (H, W) or (H, W, channels)."""
    image = np.asarray(image, np.float64)
    return image[None] if image.ndim == 2 else np.ascontiguousarray(np.moveaxis(image, -1, 0))


def log_l2(prediction: Array, truth: Array, mask: Array) -> float:
    """Compute the mean squared error of log(1 + x) of radiance; negative values count as 0 (Eq. E.8)."""
    difference = np.log1p(np.maximum(prediction[mask].astype(np.float64), 0)) - np.log1p(np.maximum(truth[mask], 0))
    return float(np.mean(difference * difference))


def iou(prediction: Array, truth: Array, mask: Array) -> float:
    """Compute intersection over union of the emitting pixels (any channel above 1e-6); 1 if neither image emits (Eq. E.8)."""
    p, t = ((image[mask] > _MIN_EMISSION).any(-1) for image in (prediction, truth))
    union = np.count_nonzero(p | t)
    return np.count_nonzero(p & t) / union if union else 1.0


def _gained(values: Array, mean_prediction: Array, mean_truth: Array, limit: float | None) -> Array:
    known = (mean_prediction >= _MIN_MEAN) & (mean_truth > 0)
    gain = np.where(known, mean_truth / np.maximum(mean_prediction, _MIN_MEAN), 1.0)
    return np.clip(values * gain, 0, limit)


class _Groups:
    """Pixels by object: `group` (n,) int, `truth` (n, channels) float64."""

    def __init__(self, group: Array, truth: Array):
        self.order = np.argsort(group, kind="stable")
        ordered = group[self.order]
        self.starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
        self.count = np.diff(np.r_[self.starts, len(group)])
        self.mean_y, self.dy = self._centred(truth)

    def _centred(self, values: Array) -> tuple[Array, Array]:
        """Means (groups, channels), and the deviations from them, (channels, n) in the order of the groups."""
        ordered = np.ascontiguousarray(values[self.order].T)
        mean = np.add.reduceat(ordered, self.starts, 1) / self.count
        return mean.T, ordered - np.repeat(mean, self.count, 1)

    def nearest(self, values: Array, ridge: float = 1e-6) -> Array:
        """Map `values` (n, channels) by the affine of their group that is nearest to the truth, clamped to [0, 1]."""
        _, dx = self._centred(values)
        n, m = len(dx), len(self.dy)
        s_xx, s_xy = np.empty((len(self.count), n, n)), np.empty((len(self.count), n, m))
        for i in range(n):
            for j in range(i + 1):
                s_xx[:, i, j] = s_xx[:, j, i] = np.add.reduceat(dx[i] * dx[j], self.starts)
            for j in range(m):
                s_xy[:, i, j] = np.add.reduceat(dx[i] * self.dy[j], self.starts)
        s_xx += ridge * self.count[:, None, None] * np.eye(n)
        slope = np.linalg.solve(s_xx, s_xy)  # (groups, channels of x, channels of y)
        mapped = np.repeat(self.mean_y.T, self.count, 1)
        for i in range(n):
            mapped += np.repeat(slope[:, i].T, self.count, 1) * dx[i]
        out = np.empty((len(values), m))
        out[self.order] = np.clip(mapped, 0, 1).T
        return out


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
    """Compute every score of one map under every protocol of its quantity.

    Args:
        quantity, truth, mask, object_id, encoded, networks: as of `Target`.
        prediction, metrics: as of `Target.scores`.

    Returns:
        Scores in the order of the protocols.
    """
    return Target(quantity, truth, mask, object_id, encoded, networks).scores(prediction, metrics)


class Target:
    """A true map and the pixels that count, prepared for scoring any number of predictions.

    Args:
        quantity: `albedo`, `roughness`, `metallic`, `emission` or `rgb`.
        truth: (H, W, 3), or (H, W) for roughness and metallic.
        mask: (H, W) bool, pixels that count.
        object_id: (H, W) int for `oracle_affine`; without it that protocol is left out.
        encoded: whether the images are sensor values instead of linear; used by FLIP only.
        networks: `alex` and `vgg` -> weights of LPIPS (`iif_core.evaluation.lpips`).

    Raises:
        InputError: unknown quantity, or shapes that do not match.
    """

    def __init__(
        self,
        quantity: str,
        truth: Array,
        mask: Array,
        object_id: Array | None = None,
        encoded: bool = False,
        networks: Mapping[str, Weights] | None = None,
    ):
        if quantity not in PROTOCOLS_OF:
            raise InputError(f"score of {quantity!r}: unknown quantity; allowed: {', '.join(PROTOCOLS_OF)}")
        self.quantity, self.truth, self.mask, self.encoded = quantity, np.asarray(truth), np.asarray(mask, bool), encoded
        if self.truth.shape[:2] != self.mask.shape:
            raise InputError(
                f"score of {quantity}: truth {self.truth.shape}, mask {self.mask.shape}; they must share height, width"
            )
        self.networks = networks or {}
        self._object_id = None if object_id is None else np.asarray(object_id)

    def scores(
        self, prediction: Array, metrics: Iterable[str] | None = None, perceptual: Container[str] = PROTOCOLS
    ) -> list[Score]:
        """Score one prediction, of the shape of the truth, under every protocol of the quantity.

        `metrics` are all of the quantity if None, LPIPS only where its network is given; `perceptual` are the protocols under
        which FLIP and LPIPS are computed, which take most of the time.

        Raises:
            InputError: shapes that do not match.
        """
        prediction = np.asarray(prediction)
        if prediction.shape != self.truth.shape:
            raise InputError(
                f"score of {self.quantity}: prediction {prediction.shape}, truth {self.truth.shape}, mask {self.mask.shape};"
                " they must share height, width and channels"
            )
        wanted = tuple(METRICS_OF[self.quantity] if metrics is None else metrics)
        wanted = tuple(m for m in wanted if m not in LPIPS_NETWORKS or LPIPS_NETWORKS[m] in self.networks)
        plan = [
            (protocol, metric)
            for protocol in PROTOCOLS_OF[self.quantity]
            if protocol != "oracle_affine" or self._object_id is not None
            for metric in wanted
            if (metric != "iou" or protocol == "raw")  # IoU does not depend on the scale
            and (metric not in PERCEPTUAL or protocol in perceptual)
        ]
        values = self._at(prediction)
        problem = self._problem(values)
        if problem:
            return [Score(metric, protocol, None, problem) for protocol, metric in plan]
        out, image, at = [], None, ""
        for protocol, metric in plan:
            if protocol != at:
                image, at = _Candidate(self, self._under(protocol, values)), protocol
            out.append(self._score(metric, protocol, image))
        return out

    @cached_property
    def _counted(self) -> Array:
        """(n, channels) float64 truth of the pixels that count."""
        return self._at(self.truth)

    def _at(self, image: Array) -> Array:
        return image[self.mask].astype(np.float64).reshape(-1, image.shape[2] if image.ndim == 3 else 1)

    def _problem(self, values: Array) -> str:
        if not len(values):
            return "no pixel counts"
        for name, image in (("prediction", values), ("truth", self._counted)):
            bad = image.size - np.count_nonzero(np.isfinite(image))
            if bad:
                return f"{name} is not finite in {bad} values"
        return ""

    def _under(self, protocol: str, values: Array) -> Array:
        if protocol == "scaled":
            return _gained(values, values.mean(0), self._counted.mean(0), None if self.quantity == "emission" else 1.0)
        return self._groups.nearest(values) if protocol == "oracle_affine" else values

    @cached_property
    def _groups(self) -> _Groups:
        assert self._object_id is not None
        return _Groups(self._object_id[self.mask], self._counted)

    @cached_property
    def _everywhere(self) -> Array:
        """The truth, 0 where it is not finite; such pixels do not count."""
        return np.where(np.isfinite(self.truth), self.truth, 0).astype(np.float64)

    @cached_property
    def _structure(self) -> _Structure:
        return _Structure(self._everywhere, self.mask)

    @cached_property
    def _seen(self) -> Seen:
        return Seen(np.clip(self._everywhere, 0, 1), self.encoded)

    @cached_property
    def _learned(self) -> dict[str, Lpips]:
        return {}

    def _distance(self, network: str) -> Lpips:
        if network not in self._learned:
            self._learned[network] = Lpips(self.truth, self.networks[network], self.mask, network)
        return self._learned[network]

    def _score(self, metric: str, protocol: str, image: _Candidate) -> Score:
        try:
            if metric == "ssim":
                value = self._structure.similarity(image.filled)
            elif metric == "flip":
                seen = Seen(np.clip(image.filled, 0, 1), self.encoded)
                value = difference(seen, self._seen)[self.mask].mean(dtype=np.float64)
            elif metric in LPIPS_NETWORKS:
                value = self._distance(LPIPS_NETWORKS[metric])(image.filled)
            elif metric in ("l2", "psnr"):
                value = image.l2 if metric == "l2" else _decibel(image.l2)
            else:
                everything = np.ones(len(image.values), bool)
                value = {"log_l2": log_l2, "iou": iou}[metric](image.values, self._counted, everything)
        except InputError as error:
            return Score(metric, protocol, None, str(error))
        return Score(metric, protocol, float(value))


class _Candidate:
    """A prediction under one protocol: `values` (n, channels) of the pixels that count."""

    def __init__(self, target: Target, values: Array):
        self.target, self.values = target, values

    @cached_property
    def l2(self) -> float:
        difference = self.values - self.target._counted
        return float(np.mean(difference * difference))

    @cached_property
    def filled(self) -> Array:
        """The whole image, with the truth where a pixel does not count."""
        image = self.target._everywhere.copy()
        image[self.target.mask] = self.values if image.ndim == 3 else self.values[:, 0]
        return image
