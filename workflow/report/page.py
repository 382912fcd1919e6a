"""report.html: one page without scripts and without any address outside of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jinja2

TEMPLATE = Path(__file__).with_name("page.html.j2")

VARIANT_NAMES = {
    "prior_k0": "raw prediction (first)",
    "prior_mean_k": "raw predictions (mean score)",
    "object_mean": "mean per object",
    "texel_mean": "mean per surface cell",
    "base": "base texture (fused)",
    "result": "result",
}
_DECIMALS = {"psnr": 2, "ssim": 3, "iou": 3, "flip": 3, "shading_left": 3, "shading_slope": 3, "view_spread": 3}
_BETTER_HIGH = {"psnr", "ssim", "iou"}
_LABELS = {"l2": "L2", "psnr": "PSNR", "ssim": "SSIM", "log_l2": "log L2", "iou": "IoU", "flip": "FLIP"}
_LABELS |= {"shading_left": "shading left", "shading_slope": "its slope", "view_spread": "spread over views"}


@dataclass(frozen=True)
class Picture:
    """One tile: its title, `data:` address and an explanation."""

    title: str
    source: str
    note: str = ""


@dataclass(frozen=True)
class Strip:
    """A row of tiles of one view; None leaves a gap so that columns line up."""

    title: str
    pictures: Sequence[Picture | None]


@dataclass(frozen=True)
class ViewRows:
    """What is shown of one view."""

    name: str
    caption: str
    strips: Sequence[Strip]


@dataclass(frozen=True)
class Table:
    """Title, column groups (title, span), column heads, and rows of text; `best` marks cells (row, column)."""

    title: str
    groups: Sequence[tuple[str, int]]
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    best: frozenset[tuple[int, int]] = frozenset()
    note: str = ""


@dataclass(frozen=True)
class Page:
    """Everything on the page."""

    scene: str
    credit: str
    headline: str
    facts: Sequence[tuple[str, str]]
    notes: Sequence[str]
    plan: Sequence[dict[str, Any]]
    tables: Sequence[Table]
    views: Sequence[ViewRows]
    emitters: Sequence[dict[str, Any]]
    emitter_note: str
    response_svg: str
    response_note: str
    timings: Sequence[dict[str, Any]]
    versions: Sequence[tuple[str, str]] = field(default_factory=tuple)


def render_page(page: Page) -> str:
    """The page as HTML text; every text is escaped."""
    return template(TEMPLATE).render(page=page)


def template(path: Path) -> jinja2.Template:
    """The template in a file; it escapes every text, and a name that it lacks is an error."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    return environment.get_template(path.name)


def number(value: Any, digits: int = 3) -> str:
    """Short text of a value: three significant digits, yes or no, a dash for nothing."""
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
    """Variants x (quantity, protocol, metric) from summary.json's `means`; None when no variant has any of them.

    The best number of each column is marked where two variants have one.
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
            target = max(present)[0] if column[2] in _BETTER_HIGH else min(present)[0]
            best |= {(i, j) for value, i in present if value == target}
    rows = [[VARIANT_NAMES[v], *(_text(_mean(means, v, *c), c[2]) for c in columns)] for v in variants]
    heads = [f"{_LABELS[metric]} {'↑' if metric in _BETTER_HIGH else '↓'}" for _, _, metric in columns]
    return Table(title, groups, heads, rows, frozenset(best), note)


def _mean(means: dict[str, Any], variant: str, quantity: str, protocol: str, metric: str) -> float | None:
    entry = means.get(variant, {}).get(quantity, {}).get(protocol, {}).get(metric)
    return None if entry is None else float(entry["mean"])


def _text(value: float | None, metric: str) -> str:
    if value is None:
        return "–"
    return f"{value:.{_DECIMALS[metric]}f}" if metric in _DECIMALS else f"{value:.4f}" if value < 1000 else f"{value:.3g}"
