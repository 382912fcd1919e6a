"""Writes what is made from the settings, their page and the JSON schemas for editors: `python docs/site/settings_page.py`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, get_origin

from pydantic.fields import FieldInfo

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY))

from workflow import plugins  # noqa: E402
from workflow.settings.relight import RelightPlan  # noqa: E402
from workflow.settings.scene import UNIONS, SceneSettings, section_in  # noqa: E402
from workflow.settings.section import Section  # noqa: E402


def schema_of(model: type[Section]) -> str:
    """Return the JSON schema of a file of settings: of a scene, or of a plan of relightings."""
    schema = model.model_json_schema()
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=1) + "\n"


_SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<", "min_length": "≥"}


def _range(rules: list[Any]) -> str:
    """Return `1 to 64`, `≥ 1` or the like for pydantic's bounds of a value; nothing where there are none."""
    bounds = {name: getattr(rule, name) for rule in rules for name in _SIGNS if hasattr(rule, name)}
    if bounds.keys() == {"ge", "le"}:
        return f"{bounds['ge']} to {bounds['le']}"
    return ", ".join(f"{sign} {bounds[name]}" for name, sign in _SIGNS.items() if name in bounds)


def _row(key: str, field: FieldInfo, default: str) -> str:
    """Return the line of a key: choices are named where its description does not name them, then the range."""
    text = " ".join((field.description or "").split())
    choices = getattr(field.annotation, "__args__", ())
    if choices and all(isinstance(v, str) for v in choices) and not all(f"`{v}`" in text for v in choices):
        text += f" One of {', '.join(f'`{v}`' for v in choices)}."
    limits = _range(field.metadata)
    return f"| `{key}` | {default} | {text}{f' ({limits})' if limits else ''} |"


def _of_many(annotation: Any) -> str:
    """Return what stands after a key whose value is a list of sections, or maps names to them; nothing after any other."""
    return {list: "[]", dict: ".<name>"}.get(get_origin(annotation), "")


FIRST = "What you set"
PARTS = {
    "Relighting": (
        "Other light, edits and cameras; usually in a separate plan (docs/guide/relighting.md).",
        ("relight_title", "relight"),
    ),
    "Advanced": (
        "Numbers that a quality chooses (docs/guide/quality.md), parts that the plan decides about, and sizes of what comes out.",
        ("base", "emission", "shading", "components", "render", "metrics", "export", "room", "seed", "device"),
    ),
}
"""Parts of the page after the first: title -> what it holds, and its sections."""


def reference_markdown() -> str:
    """Return the settings as a page: key, default, allowed values, meaning (docs/reference/settings.md)."""
    lines = ["# Settings", "", "Made from `workflow/settings/` by `python docs/site/settings_page.py`; do not edit.", ""]

    def rows(model: type[Section], prefix: str, kind: str = "", known: dict[str, str] | None = None) -> None:
        """Add the table of a section; a line that an earlier kind has (`known`: line -> kind) is named and not repeated."""
        table: list[str] = []
        repeated: dict[str, list[str]] = {}
        nested_rows: list[tuple[str, type[Section]]] = []
        for name, field in model.model_fields.items():
            if name == "kind":
                continue
            section = section_in(field.annotation)
            nested = isinstance(section, type) and issubclass(section, Section)
            if nested:
                nested_rows.append((f"{prefix}{name}{_of_many(field.annotation)}.", section))
                default = "none" if field.get_default() is None else "see below"
            else:
                default = "required" if field.is_required() else f"`{field.get_default(call_default_factory=True)}`"
            line = _row(f"{prefix}{name}", field, default)
            if known is not None and line in known:
                repeated.setdefault(known[line], []).append(f"`{name}`")
            else:
                table.append(line)
                if known is not None:
                    known[line] = kind
        if table:
            lines.extend(["| key | default | meaning |", "|---|---|---|", *table, ""])
        if repeated:
            where = "; ".join(f"of `{first}`: {', '.join(names)}" for first, names in repeated.items())
            lines.extend([f"{'Also' if table else 'Keys'} {where}.", ""])
        for inner, section in nested_rows:
            rows(section, inner)

    def section_lines(name: str, field: FieldInfo) -> None:
        if name in UNIONS:
            known: dict[str, str] = {}
            for kind, model in UNIONS[name].items():
                lines.extend([f"### `{name}: {{kind: {kind}}}`", "", " ".join((model.__doc__ or "").split()), ""])
                rows(model, f"{name}.", kind, known)
        elif isinstance(section := section_in(field.annotation), type) and issubclass(section, Section):
            many = _of_many(field.annotation)
            what = {"[]": " (a list)", ".<name>": " (by name)"}.get(many, "")
            lines.extend([f"### `{name}`{what}", "", " ".join((section.__doc__ or "").split()), ""])
            rows(section, f"{name}{many}.")
        else:
            default = field.get_default(call_default_factory=True)
            lines.extend([f"### `{name}`", "", f"Default `{default}`. {field.description or ''}", ""])

    advanced = {name: title for title, (_, names) in PARTS.items() for name in names}
    for title, (about, _) in {FIRST: ("What only you know, or choose.", ()), **PARTS}.items():
        lines.extend([f"## {title}", "", about, ""])
        for name, field in SceneSettings.model_fields.items():
            if advanced.get(name, FIRST) == title:
                section_lines(name, field)
    return "\n".join(lines)


def written() -> dict[str, str]:
    """Return file, relative to the repository -> its text."""
    return {
        "config/scene.schema.json": schema_of(SceneSettings),
        "config/relight.schema.json": schema_of(RelightPlan),
        "docs/reference/settings.md": reference_markdown(),
    }


if __name__ == "__main__":
    if plugins.modules():
        sys.exit(f"{plugins.VARIABLE}: these files describe the product without plug-ins; unset the variable and run this again")
    for name, text in written().items():
        (REPOSITORY / name).write_text(text)
