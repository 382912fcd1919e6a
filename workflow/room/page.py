"""room.html: one file with everything in it, under a policy that lets its own two scripts run and forbids all connections."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from workflow.report.page import template
from workflow.room.pack import Blob
from workflow.room.sources import LIBRARY, STYLE, TEMPLATE, VENDORED, VIEWER

NOTES = {
    "lit": "The light of every lamp, path-traced with all reflections, on matte surface; gloss as if the light came evenly from"
    " everywhere, so that mirrors show no images.",
    "albedo": "Albedo (base colour), as fitted, without light.",
    "roughness": "0 (black) to 1 (white), as fitted.",
    "metallic": "0 (black) to 1 (white), as fitted.",
    "emission": "What shines, with its strength and colour; all else is black.",
    "uncertainty": "Standard deviation of the albedo that the fit claims; errors that all predictions share are not in it."
    " Grey: no photograph shows it.",
}
"""What the modes show, in the order of the buttons; MODES of viewer.js has the same names."""


@dataclass(frozen=True)
class Page:
    """Content of the page.

    Attributes:
        scene: name of the scene; credit: a line under it.
        about: paragraphs.
        document: what viewer.js reads as JSON.
        blobs: name -> data.
    """

    scene: str
    credit: str
    about: Sequence[str]
    document: Mapping[str, Any]
    blobs: Mapping[str, Blob]


def render_page(page: Page) -> str:
    """Render the page as HTML; text is escaped, and data cannot end the script that holds it."""
    from markupsafe import Markup

    style, viewer, library = (path.read_text(encoding="utf-8") for path in (STYLE, VIEWER, LIBRARY))
    document = json.dumps(page.document, separators=(",", ":"), allow_nan=False, ensure_ascii=True).replace("<", "\\u003c")
    return template(TEMPLATE).render(
        policy=Markup(policy(style, [library, viewer])),
        style=Markup(style),
        scene=page.scene,
        credit=page.credit,
        modes=list(NOTES),
        about=page.about,
        three=three_version(),
        document=Markup(document),
        blobs=list(page.blobs.items()),
        library=Markup(library),
        viewer=Markup(viewer),
    )


def policy(style: str, scripts: Sequence[str]) -> str:
    """Return a Content-Security-Policy under which these texts, and nothing else, are style and scripts of the page."""

    def hashed(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    rules = {
        "default-src": "'none'",
        "script-src": " ".join(hashed(script) for script in scripts),
        "style-src": hashed(style),
        "img-src": "blob:",
        "connect-src": "'none'",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def three_version() -> str:
    """Return the version of the vendored three.js, as its README says."""
    found = re.search(r"three\.js (\d+\.\d+\.\d+)", VENDORED.read_text(encoding="utf-8"))
    return found.group(1) if found else ""
