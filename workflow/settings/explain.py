"""Messages for errors in a scene file."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from pydantic import ValidationError

from workflow.intake.names import shown
from workflow.settings.names import LONG, did_you_mean
from workflow.settings.scene import POOLED, UNIONS, SceneSettings, section_in
from workflow.settings.section import Section

NOT_READ = {
    "affines.ridge": " It was removed, because it had no effect; delete it.",
    "segmentation.colour": " It is the same for all rooms now; delete it, and set `scale` for other pieces.",
    "segmentation.sam2.confidence": " It is the same for all rooms now; delete it.",
    "report.views": " The report shows 6 of them with all maps; delete it.",
    "source.drop_bad": " Photographs that the release marks as bad are left out; delete it.",
    "source.ids": " The first of `IndexMA` and `segmentation` that is there has the ids; move the other folder away to read it.",
    **dict.fromkeys(("source.lists", "source.validation"), " Photographs for testing are held out, never used; delete it."),
}
"""Keys of earlier versions: what to do about them."""
SHOWN = 10
"""Problems in one message."""
NEEDED = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "Needed: a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "Needed: a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "Needed: true or false"),
    "finite_number": "Needed: a finite number",
    "list_type": "Needed: a list",
}
"""What a value of the wrong type should have been, by the type of pydantic's error."""
BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
"""Words for the limits of a number, by their names in pydantic's errors."""
IN_METRES = ("source.room_height", "source.camera_height")
"""Lengths that people give in other units."""
_UNITS = {
    **{f"{by}{name}": f"{by[:1]}m" for by in ("", "centi", "milli", "kilo") for name in ("meter", "metre", "meters", "metres")},
    **dict.fromkeys(("foot", "feet"), "ft"),
    **dict.fromkeys(("inch", "inches"), "in"),
}
MEANT = {"capture.exposure": {"automatic": "auto"}, "source.unit": _UNITS}
"""Words that people try -> what they mean."""
EXAMPLES = {"relight": "config/relight/kitchen.yaml"}
"""Files that show all of a section that config/scenes/kitchen.yaml does not have."""
RENAMED = {
    "point": "quality",
    "override": "components",
    "overrides": "materials",
    "emission.environment": "components.environment",
    "shading.indirect": "components.radiance_cache",
    "render.denoise": "components.denoiser",
    "room.denoise": "components.denoiser",
}
"""Keys of earlier versions -> their names now."""


def _section_of(where: tuple[str | int, ...]) -> type[Section] | None:
    model: Any = SceneSettings
    parts = [str(p) for p in where]
    for part in parts[:-1]:
        if part in UNIONS and model is SceneSettings:
            model = UNIONS[part]
        elif isinstance(model, dict):
            model = model.get(part, model)
        elif model is UNIONS["prior"]["pooled"] and part == "of":
            model = POOLED
        else:
            field = getattr(model, "model_fields", {}).get(part)
            model = section_in(field.annotation) if field else model
    return model if isinstance(model, type) else None


def _dotted(where: tuple[str | int, ...]) -> str:
    """Return the keys as they stand in the file (`prior.samples`), without pydantic's names of alternatives."""
    tags = {tag for union in UNIONS.values() for tag in union}
    parts = [str(part) for part in where]
    tagged = [i == 1 or parts[i - 1].isdigit() for i in range(len(parts))]
    return ".".join(p for i, p in enumerate(parts) if not (tagged[i] and p in tags) and not _is_alternative(parts, i))


def _is_alternative(parts: list[str], i: int) -> bool:
    """Return whether part `i` is no key but names one of several types of a value (`literal['found','prior']`, `WhitePatch`)."""
    return i > 0 and ("[" in parts[i] or parts[i] == "float" or parts[i] in _names_of_sections())


@cache
def _names_of_sections() -> set[str]:
    found, new = set(), [Section]
    while new:
        new = [child for parent in new for child in parent.__subclasses__()]
        found |= {child.__name__ for child in new}
    return found


def _one_of_each_choice(problems: Sequence[Any]) -> list[Any]:
    """Reduce the errors of a value that fits none of its alternatives, which pydantic reports once for each alternative.

    Errors inside the alternative that was meant are kept; without such, all are joined into one sentence.
    """
    groups: dict[Any, list[Any]] = {}
    for number, problem in enumerate(problems):
        parts = [str(part) for part in problem["loc"]]
        cut = next((i for i in range(len(parts)) if _is_alternative(parts, i)), None)
        groups.setdefault(number if cut is None else tuple(parts[:cut]), []).append((problem, cut))
    kept = []
    for group in groups.values():
        inside = [p for p, cut in group if cut is None or len(p["loc"]) > cut + 1 or p["type"] == "value_error"]
        if not inside:
            said = dict.fromkeys(
                "it may also be `key: value` pairs" if p["type"] == "model_type" else needed(p) for p, _ in group
            )
            first, *others = said
            others = [other if other.startswith("it may") else f"or {other.removeprefix('Needed: ')}" for other in others]
            inside = [{**group[0][0], "type": "any_of", "ctx": {}, "msg": "; ".join([first, *others])}]
        kept.extend(inside)
    return kept


def _of_another_kind(where: tuple[str | int, ...]) -> str:
    """Say to which other `kind` of a section a key belongs."""
    kinds = [kind for kind, section in UNIONS.get(str(where[0]), {}).items() if where[-1] in section.model_fields]
    if kinds:
        return f" It belongs to `kind: {kinds[0]}`."
    of_source = len(where) == 1 and any(where[0] in section.model_fields for section in UNIONS["source"].values())
    return f" Put it under `source`, as in `source: {{{where[0]}: ...}}`." if of_source else ""


def _example_of(where: tuple[str | int, ...]) -> str:
    """Return what a section is like whose value is none: with its kind, or with what it must have."""
    if str(where[-1]) in UNIONS:
        return f"`{where[-1]}: {{kind: ...}}`"
    section = _section_of((*where, ""))
    keys = [name for name, field in section.model_fields.items() if field.is_required()] if section else []
    name = str(where[-2] if len(where) > 1 and _is_alternative([str(part) for part in where], len(where) - 1) else where[-1])
    return f"`{name}: {{{', '.join(f'{key}: ...' for key in keys) or 'key: value'}}}`"


def _in_metres(found: Any) -> str:
    """Return what a length in another unit probably is in metres, as a question; empty where it is none that a room has."""
    likely = [found / by for by in (10, 100, 1000) if isinstance(found, int | float) and 1.5 <= found / by <= 10]
    return f" Did you mean {likely[0]:g}?" if likely else ""


def _is_section(found: Any) -> bool:
    """Return whether a value is a mapping or a list of mappings, too long to be shown."""
    return isinstance(found, dict) or (isinstance(found, list) and any(isinstance(entry, dict) for entry in found))


def _number(value: float) -> str:
    """Return 1 for 1.0, as a person would write it."""
    return str(int(value) if float(value).is_integer() else value)


def needed(problem: Any) -> str:
    """Return what a value should have been. Our text replaces pydantic's where its error is about a type, a limit or a choice."""
    limits = problem.get("ctx", {})
    bound = next((f"{words} {_number(limits[name])}" for name, words in BOUNDS.items() if name in limits), None)
    if problem["type"] in NEEDED:
        return NEEDED[problem["type"]]
    if bound is not None:
        return f"Needed: {bound}"
    if problem["type"] == "too_short":
        return f"Needed: at least {limits['min_length']} entries"
    if problem["type"] == "literal_error":
        return f"Allowed: {limits['expected']}"
    return problem["msg"].removeprefix("Value error, ")


def explain(error: ValidationError, origin: Callable[[str], str]) -> str:
    """Return one line per problem; `origin` maps a dotted key to its file."""
    lines = []
    problems = _one_of_each_choice(error.errors())
    for problem in problems[:SHOWN]:
        where = problem["loc"]
        dotted = _dotted(where)
        found = problem.get("input")
        kind = problem["type"]
        path = origin(f"{dotted}.kind" if kind.startswith("union_tag") else dotted)
        if kind == "extra_forbidden":
            section = _section_of(where)
            allowed = sorted(section.model_fields) if section else []
            hint = NOT_READ.get(dotted) or did_you_mean(where[-1], allowed, "`{}`")
            hint = f" It is `{RENAMED[dotted]}` now." if dotted in RENAMED else hint or _of_another_kind(where)
            lines.append(f"{path}: `{dotted}`: unknown key.{hint} Allowed here: {', '.join(allowed)}.")
        elif kind in ("model_type", "model_attributes_type", "dict_type"):
            joined = re.fullmatch(r"(\w+):(\S+)", found) if isinstance(found, str) else None
            hint = f" A space is missing after its colon: `{joined[1]}: {joined[2]}`." if joined else ""
            lines.append(f"{path}: `{dotted}`: found {shown(found)}, needed `key: value` pairs, e.g. {_example_of(where)}.{hint}")
        elif kind == "missing":
            example = EXAMPLES.get(str(where[0]), "config/scenes/kitchen.yaml")
            lines.append(f"{path}: `{dotted}`: missing. Add it; {example} is a complete example.")
        elif kind in ("union_tag_invalid", "union_tag_not_found"):
            union = POOLED if "of" in where else UNIONS.get(str(where[0]), {})
            got = found.get("kind") if isinstance(found, dict) else found
            said = "missing. Add it;" if got is None else f"found {shown(got)},"
            hint = "" if got is None else did_you_mean(got, union) or " Plug-ins bring other kinds (IIF_PLUGINS)."
            lines.append(f"{path}: `{dotted}.kind`: {said} allowed: {', '.join(union)}.{hint}")
        elif kind == "value_error" and _is_section(found):  # keys that do not go together: the message says which
            lines.append(f"{path}: `{dotted}`: {problem['ctx']['error']}.")
        else:
            said = shown(found, 200) if not isinstance(found, dict) else "'a mapping'"
            what = needed(problem)
            if kind == "string_type" and isinstance(found, bool):
                what = "Needed: text; YAML reads `on`, `off`, `yes` and `no` as true or false, so write it in quotes"
            elif kind == "string_type" and isinstance(found, int | float):
                what = f'Needed: text; YAML reads it as a number, so write it in quotes, such as "{found:03}"'
            elif kind == "string_pattern_mismatch" and where[-1] == "name":
                what = "Needed: letters, digits, _ and -, beginning with a letter or a digit"
            elif kind == "float_parsing" and (number := re.fullmatch(r"(-?\d+)(?:[.,](\d+))?\s*[a-zA-Z]*", str(found).strip())):
                what += f" with a point, without a unit: {number[1]}.{number[2] or 0}"
            elif dotted in IN_METRES:
                what += " (metres)"
            words = MEANT.get(dotted, {})
            near = difflib.get_close_matches(found.lower(), words, 1) if isinstance(found, str) and len(found) < LONG else []
            other = words[near[0]] if near else None
            hint = did_you_mean(found, re.findall(r"'([^']*)'", what)) if isinstance(found, str) else ""
            hint = f" Did you mean '{other}'?" if other else hint or (_in_metres(found) if dotted in IN_METRES else "")
            lines.append(f"{path}: `{dotted}`: found {said}. {what}.{hint}")
    if len(problems) > SHOWN:
        lines.append(f"... and {len(problems) - SHOWN} more")
    return "\n".join(lines)
