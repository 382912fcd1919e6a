"""Options of functions, as far as a section of the settings names them."""

from __future__ import annotations

from dataclasses import fields
from types import SimpleNamespace
from typing import Any, TypeVar

Options = TypeVar("Options")


def options_of(options: type[Options], section: SimpleNamespace, **given: Any) -> Options:
    """Return options whose fields are `given`, else those of the same name in a section of the settings, else at their defaults.

    Most options are no settings of the product; plug-ins may add them to a section (workflow/plugins.py).

    Args:
        options: a dataclass.
        section: of `job.settings`.

    Example:
        >>> from iif_core.fusion.options import CellOptions
        >>> options_of(CellOptions, SimpleNamespace(cell_footprints=0.8, ridge=1), cell_edge=0.01)
        CellOptions(predictions=None, cell_edge=0.01, cell_footprints=0.8, border_weight=0.1, footprint_power=0.0)
    """
    named = {field.name: getattr(section, field.name) for field in fields(options) if hasattr(section, field.name)}  # type: ignore[arg-type]
    return options(**(named | given))
