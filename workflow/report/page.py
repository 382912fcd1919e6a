"""report.html: one page that answers, from top to bottom, whether to trust a result, what it is and how to go on from it.

The page asks for nothing outside of itself: style and script are in it, and its content policy allows these two by their hashes
alone. Without JavaScript it is a readable page; pictures that slide over each other then stand side by side.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iif_core.evaluation.catalogue import METRICS, PROTOCOLS
from workflow.report import pictures as pic
from workflow.report.downloads import Command, Download
from workflow.report.sources import SCRIPT, STYLE, TABLES, TEMPLATE
from workflow.report.verdict import Verdict
from workflow.report.wording import prose

if TYPE_CHECKING:
    import jinja2


VARIANT_NAMES = {
    "prior_k0": "raw prediction (first)",
    "prior_mean_k": "raw predictions (mean score)",
    "object_mean": "mean per object",
    "texel_mean": "mean per surface cell",
    "base": "base texture (fused)",
    "result": "result",
}

HERO_LEAST, HERO_ENLARGED = 480, 2.5
"""The first picture is as wide as there is room, but not enlarged by more than this factor beyond so many CSS pixels: a small
photograph would only be blurred."""

METRIC_WORDS = {
    "l2": "mean squared error, of linear values for maps and of sensor values for photographs; 0 is exact",
    "psnr": "peak signal-to-noise ratio, 10 log10(1 / L2) in dB: 20 dB is an error of 0.1, 30 dB one of 0.03; larger is better",
    "ssim": "structural similarity of 11 x 11 pixels (Gaussian of 1.5 pixels); 1 is equal",
    "flip": "difference that an eye sees when two pictures alternate; 0 is none",
    "lpips": "distance in the features of AlexNet; 0 is equal",
    "lpips_vgg": "distance in the features of VGG16; 0 is equal",
    "log_l2": "mean squared error of log(1 + E), which bright lamps do not drown; 0 is exact",
    "iou": "pixels that emit in both, over pixels that emit in either; 1 is equal",
    "shading_left": "correlation, inside objects, of log albedo with the log of the light that was found; 0 is none left",
    "shading_slope": "slope, inside objects, of log albedo over the log of the light; 0 is none left",
    "view_spread": "spread over photographs of the log albedo of the same surface; 0 is none",
    "light_spread": "spread over objects of the logarithm of the light's error; 0.1 is 10 %",
}
"""Metric -> what it measures, for people who meet it here first (docs/method/evaluation.md)."""


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        title: what it shows; note: more words.
        source: `data:` address.
        kind: how a colour becomes a number again: `sensor` (value / 255), `srgb` (decoded, over `high`, the exposure), `grey`
            (value / 255), `error` and `value` (place in the colour map between `low` and `high`), empty: it does not.
        low, high, unit: of the numbers.
    """

    title: str
    source: str
    note: str = ""
    kind: str = ""
    low: float = 0.0
    high: float = 1.0
    unit: str = ""


@dataclass(frozen=True)
class Strip:
    """A row of pictures of one view; None leaves a gap, so that columns line up."""

    title: str
    pictures: Sequence[Picture | None]


@dataclass(frozen=True)
class ViewRows:
    """The pictures of one view; `file` is the address of its maps, empty where it has none."""

    name: str
    caption: str
    strips: Sequence[Strip]
    file: str = ""


@dataclass(frozen=True)
class Pair:
    """Photograph and re-rendering of one view, under a slider; `score` in dB, None = not scored."""

    view: str
    photograph: Picture
    rerendering: Picture
    width: int
    height: int
    score: float | None = None
    held_out: bool = False


@dataclass(frozen=True)
class Table:
    """Title, column groups (title, span), column heads, and rows of text; `best` marks cells (row, column), `explained` holds the
    key of the explanation of each column."""

    title: str
    groups: Sequence[tuple[str, int]]
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    best: frozenset[tuple[int, int]] = frozenset()
    note: str = ""
    explained: Sequence[str] = ()


@dataclass(frozen=True)
class Number:
    """A number at the head of a section: label, value with unit, the key of its explanation, and what would be good."""

    label: str
    value: str
    explained: str
    good: str = ""


@dataclass(frozen=True)
class Page:
    """Content of the page."""

    scene: str
    credit: str
    verdict: Verdict
    hero: Pair
    hero_note: str
    headline: str
    numbers: Sequence[Number]
    explanations: Sequence[tuple[str, str, str]]
    facts: Sequence[tuple[str, str]]
    notes: Sequence[str]
    warnings: Sequence[str]
    plan: Sequence[dict[str, Any]]
    tables: Sequence[Table]
    pairs: Sequence[Pair]
    pairs_note: str
    views: Sequence[ViewRows]
    objects: Sequence[Mapping[str, str]]
    emitters: Sequence[dict[str, Any]]
    emitter_note: str
    response_svg: str
    response_note: str
    timings: Sequence[dict[str, Any]]
    versions: Sequence[tuple[str, str]]
    downloads: Sequence[Download]
    commands: Sequence[Command]
    scene_file: str = ""


def render_page(page: Page) -> str:
    """Render the page as HTML; all text is escaped."""
    bars = "".join(f".bar-{scheme}{{background:{pic.gradient(scheme)}}}" for scheme in ("error", "value"))
    hero = page.hero.width / max(page.hero.height, 1)  # a style of one element would not be allowed by the policy
    wide = max(HERO_LEAST, HERO_ENLARGED * page.hero.width)
    style = f"{STYLE.read_text()}{bars}:root{{--hero:min({wide:.0f}px,80vh*{hero:.4f})}}\n"
    script = TABLES.read_text() + SCRIPT.read_text()
    return template(TEMPLATE).render(
        page=page,
        style=style,
        script=script,
        style_hash=content_hash(style),
        script_hash=content_hash(script),
        palettes={scheme: pic.palette(scheme) for scheme in ("error", "value")},
    )


def content_hash(text: str) -> str:
    """Return the hash by which a content policy allows an inline style or script."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def explanation_key(quantity: str, protocol: str, metric: str) -> str:
    """Return the key of the explanation of a score."""
    return f"{quantity}-{protocol}-{metric}".replace("_", "-")


def explain(quantity: str, protocol: str, metric: str) -> tuple[str, str, str]:
    """Return key, term and words of a score: what is compared, how, and by which protocol."""
    what = {"rgb": "re-rendering of the photographs", "rgb_held_out": "re-rendering of held-out photographs"}.get(
        quantity, quantity
    )
    against = "the photograph, in sensor values" if quantity.startswith("rgb") else "ground truth, pixel by pixel, linear"
    own = metric in ("shading_left", "shading_slope", "view_spread")
    measure = METRIC_WORDS.get(metric, METRICS[metric].label)
    words = (
        f"{measure}." if own else f"{measure}. Compared with {against}, {PROTOCOLS[protocol].explanation}; mean over the views."
    )
    return explanation_key(quantity, protocol, metric), f"{METRICS[metric].short} of {what}", words[0].upper() + words[1:]


def template(path: Path) -> jinja2.Template:
    """Load a template that escapes all text and refuses unknown names."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "prose": prose}
    return environment.get_template(path.name)


def number(value: Any, digits: int = 3) -> str:
    """Format a value: three significant digits, yes or no, a dash for nothing."""
    if value is None or value == "":
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    if isinstance(value, float):
        return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.2e}"
    return str(value)


def score_table(title: str, means: dict[str, Any], columns: Sequence[tuple[str, str, str]], note: str = "") -> Table | None:
    """Tabulate variants x (quantity, protocol, metric); the best number of each column is marked where two variants have one.

    Args:
        title: title of the table.
        means: `means` of summary.json.
        columns: (quantity, protocol, metric) of every column; columns without any number are left out.
        note: text below the table.

    Returns:
        The table; None if no variant has any of the numbers.
    """
    variants = [v for v in VARIANT_NAMES if any(_mean(means, v, *column) is not None for column in columns)]
    columns = [c for c in columns if any(_mean(means, v, *c) is not None for v in variants)]
    if not variants:
        return None
    groups: list[tuple[str, int]] = []
    for quantity, protocol, _ in columns:
        text = quantity if protocol == "raw" else f"{quantity}, {protocol.replace('_', ' ')}"
        if groups and groups[-1][0] == text:
            groups[-1] = (text, groups[-1][1] + 1)
        else:
            groups.append((text, 1))
    best = set()
    for j, column in enumerate(columns):
        numbers = [(_mean(means, v, *column), i) for i, v in enumerate(variants)]
        present = [pair for pair in numbers if pair[0] is not None]
        if len(present) > 1:
            target = max(present)[0] if METRICS[column[2]].higher_is_better else min(present)[0]
            best |= {(i, j) for value, i in present if value == target}
    rows = [[VARIANT_NAMES[v], *(_text(_mean(means, v, *c), c[2]) for c in columns)] for v in variants]
    heads = [f"{METRICS[metric].short} {'↑' if METRICS[metric].higher_is_better else '↓'}" for _, _, metric in columns]
    explained = [explanation_key(*column) for column in columns]
    return Table(title, groups, heads, rows, frozenset(best), note, explained)


def _mean(means: dict[str, Any], variant: str, quantity: str, protocol: str, metric: str) -> float | None:
    entry = means.get(variant, {}).get(quantity, {}).get(protocol, {}).get(metric)
    return None if entry is None else float(entry["mean"])


def _text(value: float | None, metric: str) -> str:
    if value is None:
        return "–"
    return f"{value:.{METRICS[metric].decimals}f}" if value < 1000 else f"{value:.3g}"
