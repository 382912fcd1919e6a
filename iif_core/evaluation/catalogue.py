"""The catalogue of metrics, protocols and scored quantities (docs/method/evaluation.md): names, labels, units, directions."""

from __future__ import annotations

from typing import Literal, NamedTuple

ProtocolName = Literal["raw", "gain", "scaled", "oracle_affine"]


class Protocol(NamedTuple):
    """How a prediction is adjusted before it is compared with the truth: three texts, from short to long."""

    short: str
    words: str
    explanation: str


PROTOCOLS: dict[ProtocolName, Protocol] = {
    "raw": Protocol("raw", "as it is", "as it is"),
    "gain": Protocol("gain", "one gain per image", "after one gain per image, the same for its channels"),
    "scaled": Protocol(
        "scaled", "one gain per image and channel", "after one gain per image and channel, which 8-bit photographs leave open"
    ),
    "oracle_affine": Protocol(
        "oracle",
        "best affine per object (oracle)",
        "each object mapped by its best affine to the truth first, an upper bound and not a result",
    ),
}
PROTOCOLS_OF: dict[str, tuple[ProtocolName, ...]] = {
    "albedo": ("raw", "scaled", "oracle_affine"),
    "roughness": ("raw", "oracle_affine"),
    "metallic": ("raw", "oracle_affine"),
    "emission": ("raw", "scaled"),
    "rgb": ("raw",),
}
"""Quantity -> protocols. Photographs determine the level of roughness and metallic, but they may leave the level of emission and
albedo open."""


class Metric(NamedTuple):
    """A metric."""

    label: str
    """Name in headings."""
    short: str
    """Name in narrow columns."""
    higher_is_better: bool | None = None
    quantities: tuple[str, ...] = ()
    """Quantities whose images it scores; none for scores of a whole scene."""
    decimals: int = 3
    unit: str = ""
    wide_range: bool = False
    """Values span orders of magnitude: tables give significant digits, and pictures may have a logarithmic axis."""
    network: str = ""
    """Network of LPIPS. The paper reports VGG16; AlexNet is the recommendation of the authors of LPIPS, and much faster."""
    axis: str = ""
    """Name on the axis of a picture, where it is not the label."""


_COLOURS, _MAPS = ("albedo", "rgb"), ("albedo", "roughness", "metallic", "rgb")
METRICS = {
    "l2": Metric("L2", "L2", False, (*_MAPS, "emission"), 4, wide_range=True),
    "psnr": Metric("PSNR", "PSNR", True, _MAPS, 2, "dB"),
    "ssim": Metric("SSIM", "SSIM", True, _MAPS),
    "flip": Metric("FLIP", "FLIP", False, _COLOURS),
    "lpips": Metric("LPIPS (AlexNet)", "LPIPS", False, _MAPS, network="alex"),
    "lpips_vgg": Metric("LPIPS (VGG)", "LPIPS (VGG)", False, _MAPS, network="vgg"),
    **{
        f"coverage_{n}": Metric(f"share within the claimed {n} % interval", f"{n} %", axis=f"share within {n} % interval")
        for n in (50, 80, 95)
    },
    "log_l2": Metric("L2 of log(1 + E)", "log L2", False, ("emission",), 4, wide_range=True),
    "iou": Metric("IoU", "IoU", True, ("emission",)),
    "relative": Metric("relative error of radiance", "relative", False, axis="sum |p - t| / sum t"),
    "shading_left": Metric("shading left (correlation with light inside objects)", "shading left", axis="shading_left"),
    "shading_slope": Metric("shading left (slope over light inside objects)", "its slope", axis="shading_slope"),
    "view_spread": Metric("spread of log albedo over views", "spread over views", False, axis="view_spread"),
    "light_spread": Metric("spread over objects of the error of the light", "light's error", False, axis="light_spread"),
    "psnr_3d": Metric("PSNR over cells, one affine an object", "3D PSNR", True, unit="dB"),
}
"""Metrics in the order of tables."""

METRICS_OF = {q: tuple(name for name, metric in METRICS.items() if q in metric.quantities) for q in PROTOCOLS_OF}
"""Quantity -> metrics of one image."""
LPIPS_NETWORKS = {name: metric.network for name, metric in METRICS.items() if metric.network}
PERCEPTUAL = ("flip", *LPIPS_NETWORKS)
"""Metrics that take most of the time."""
