"""How numbers and the terms of the stages are written for people: in the report and in the room."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from markupsafe import Markup

FITTED = {
    "full": "colour by a matrix",
    "gain+bias": "colour by factors and offsets",
    "gain": "colour by factors",
    "metal": "taken as metal",
}
"""Text for parts of `model` of objects.parquet (`iif_core.fitting.selection`); other parts are text already."""


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


def percent(share: float, digits: int = 0) -> str:
    """Return a share of 1 as `51.7 %`, with the space that the SI asks for."""
    return f"{100 * share:.{digits}f} %"


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, zeros at its end included, so that the numbers of a column look alike."""
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:#.{digits}g}".rstrip(".") if value else "0"


def fit_words(model: str) -> str:
    """Describe what was fitted of an object, from `model` of objects.parquet, such as `full, roughness, metal`."""

    def words(part: str) -> str:
        found = re.fullmatch(r"(population|identity) \((\d+) pixels\)", part)
        if found is None:
            return FITTED.get(part, part)
        seen = f"{found[2]} usable {'pixel' if found[2] == '1' else 'pixels'}"
        return f"nothing ({seen}): {'as other objects' if found[1] == 'population' else 'as predicted'}"

    return ", ".join(words(part) for part in model.split(", "))


def reason_words(component: str, reason: str) -> str:
    """Return the reason of a decision as text. It says in the terms of `fit_words` what was fitted of how many objects."""
    if component != "affine_size":
        return reason
    words = FITTED | {"population": "nothing, as other objects", "identity": "nothing, as predicted"}
    counted = re.findall(r"(\d+) ([^,]+)", reason)
    told = (f"{count} {'object' if count == '1' else 'objects'}: {words.get(kind, kind)}" for count, kind in counted)
    return "; ".join(told) or reason


def prose(text: str) -> Markup:
    """Return a sentence of a stage as HTML: escaped, words in backticks as code, `±` for `+-`, and a space before `%`."""
    from markupsafe import Markup, escape

    shown = re.sub(r"(\d)%", "\\1\u00a0%", str(escape(text)).replace("+-", "±"))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", shown))
