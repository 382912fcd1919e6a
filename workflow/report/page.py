"""report.html: one page without scripts and without addresses outside of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iif_core.evaluation.catalogue import METRICS

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


@dataclass(frozen=True)
class Picture:
    """One tile: its title, `data:` address and an explanation."""

    title: str
    source: str
    note: str = ""


@dataclass(frozen=True)
class Strip:
    """A row of tiles of one view; None leaves a gap, so that columns line up."""

    title: str
    pictures: Sequence[Picture | None]


@dataclass(frozen=True)
class ViewRows:
    """The tiles of one view."""

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
    """Content of the page."""

    scene: str
    credit: str
    headline: str
    facts: Sequence[tuple[str, str]]
    notes: Sequence[str]
    warnings: Sequence[str]
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
    """Render the page as HTML; all text is escaped."""
    return template(TEMPLATE).render(page=page)


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
    environment.filters["number"] = number
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
    return Table(title, groups, heads, rows, frozenset(best), note)


def _mean(means: dict[str, Any], variant: str, quantity: str, protocol: str, metric: str) -> float | None:
    entry = means.get(variant, {}).get(quantity, {}).get(protocol, {}).get(metric)
    return None if entry is None else float(entry["mean"])


def _text(value: float | None, metric: str) -> str:
    if value is None:
        return "–"
    return f"{value:.{METRICS[metric].decimals}f}" if value < 1000 else f"{value:.3g}"
