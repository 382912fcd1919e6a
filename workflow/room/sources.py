"""The files of which the page is made; their content is part of the fingerprint of stage room, as code is of other stages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
TEMPLATE, STYLE, VIEWER, LIBRARY = (HERE / name for name in ("page.html.j2", "room.css", "viewer.js", "vendor/three.min.js"))
VENDORED = HERE / "vendor/README.md"


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the files, which are the same for all settings."""
    return [TEMPLATE, STYLE, VIEWER, LIBRARY, VENDORED]
