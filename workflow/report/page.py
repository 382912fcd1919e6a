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

from workflow.report import pictures as pic
from workflow.report.downloads import Command, Download
from workflow.report.sources import SCRIPT, STYLE, TABLES, TEMPLATE
from workflow.report.verdict import Verdict
from workflow.report.wording import number, prose

if TYPE_CHECKING:
    import jinja2

HERO_LEAST, HERO_ENLARGED = 480, 2.5
"""The first picture is as wide as there is room, but not enlarged by more than this factor beyond so many CSS pixels: a small
photograph would only be blurred."""


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
    overview: str
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
    objects_note: str
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
