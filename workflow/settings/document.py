"""The settings as a JSON schema and as a page."""

from __future__ import annotations

import json
from typing import Any, get_origin

from workflow.settings.explain import BOUNDS
from workflow.settings.relight import RelightPlan
from workflow.settings.scene import UNIONS, SceneSettings, section_in
from workflow.settings.section import Section


def schema_json() -> str:
    """Return the JSON schema of a scene file, for editors (`config/scene.schema.json`)."""
    return _schema(SceneSettings)


def plan_schema_json() -> str:
    """Return the JSON schema of a plan of relightings, for editors (`config/relight.schema.json`)."""
    return _schema(RelightPlan)


def _schema(model: type[Section]) -> str:
    schema = model.model_json_schema()
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=1) + "\n"


_BOUNDS = {**BOUNDS, "min_length": "at least"}


def _bound(rule: Any) -> str:
    """Return `at least 1` for pydantic's `Ge(ge=1)`."""
    return ", ".join(f"{words} {getattr(rule, name)}" for name, words in _BOUNDS.items() if hasattr(rule, name))


def _of_many(annotation: Any) -> str:
    """Return what stands after a key whose value is a list of sections, or maps names to them; nothing after any other."""
    return {list: "[]", dict: ".<name>"}.get(get_origin(annotation), "")


def reference_markdown() -> str:
    """Return the settings as a page: key, default, allowed values, meaning (docs/reference/settings.md)."""
    lines = ["# Settings", "", "Made from `workflow/settings/` by `python -m workflow.settings`; do not edit.", ""]

    def rows(model: type[Section], prefix: str) -> None:
        lines.extend(["| key | default | meaning |", "|---|---|---|"])
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
            text = " ".join((field.description or "").split())
            bounds = ", ".join(filter(None, map(_bound, field.metadata)))
            literal = getattr(field.annotation, "__args__", ())
            if literal and all(isinstance(v, str) for v in literal):
                text += f" One of {', '.join(f'`{v}`' for v in literal)}."
            lines.append(f"| `{prefix}{name}` | {default} | {text}{f' ({bounds})' if bounds else ''} |")
        lines.append("")
        for inner, section in nested_rows:
            rows(section, inner)

    for name, field in SceneSettings.model_fields.items():
        if name in UNIONS:
            for kind, model in UNIONS[name].items():
                lines.extend([f"## `{name}: {{kind: {kind}}}`", "", " ".join((model.__doc__ or "").split()), ""])
                rows(model, f"{name}.")
        elif isinstance(section := section_in(field.annotation), type) and issubclass(section, Section):
            many = _of_many(field.annotation)
            what = {"[]": " (a list)", ".<name>": " (by name)"}.get(many, "")
            lines.extend([f"## `{name}`{what}", "", " ".join((section.__doc__ or "").split()), ""])
            rows(section, f"{name}{many}.")
        else:
            lines.extend([f"## `{name}`", "", f"Default `{field.get_default()}`. {field.description or ''}", ""])
    return "\n".join(lines)
