"""The files of which the report is made; their content is part of the fingerprint of stage report, as code is of other stages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from workflow.report import calibration

HERE = Path(__file__).resolve().parent
TEMPLATE, STYLE, TABLES, SCRIPT = (HERE / name for name in ("page.html.j2", "page.css", "tables.js", "page.js"))


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the files, which are the same for all settings."""
    return [TEMPLATE, STYLE, TABLES, SCRIPT, calibration.FILE]
