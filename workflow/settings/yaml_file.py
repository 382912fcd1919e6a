"""Strict reading of YAML files, with errors that name file and line."""

from __future__ import annotations

import copy
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import read_text, shorter

_POWER = re.compile(r"[-+]?\d{1,40}\.?\d{0,40}[eE][-+]?\d{1,40}")


class _Strict:
    """YAML in which a key that stands twice in one mapping, or that merges another mapping (`<<`), is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        before = ""
        for key_node, value_node in node.value:
            # `{a: 2,6}` is `{a: 2, 6: null}`.
            if node.flow_style and before.isdigit() and key_node.value.isdigit() and not value_node.value:
                raise _fault(f"a comma in a number? Write {before}.{key_node.value} with a point", key_node.start_mark)
            # `{kind:folder}` is `{"kind:folder": null}`.
            joined = re.fullmatch(r"(\w+):(\S.*)", key_node.value) if isinstance(key_node, yaml.ScalarNode) else None
            if joined and not key_node.style and isinstance(value_node, yaml.ScalarNode) and not value_node.value:
                raise _fault(f"a space is missing after a colon: write {joined[1]}: {joined[2]}", key_node.start_mark)
            before = value_node.value if isinstance(value_node, yaml.ScalarNode) else ""
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise _fault("`<<` is not read; write the keys themselves", key_node.start_mark)
            key = self.construct_object(key_node, deep=deep)  # type: ignore[attr-defined]
            if not isinstance(key, str | int | float | bool | None):
                raise _fault("a key is no text", key_node.start_mark)
            if key in seen:
                raise _fault(f"key `{key}` stands twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)  # type: ignore[misc]


class _StrictLoader(_Strict, yaml.SafeLoader):
    pass


class _FastLoader(_Strict, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """The same by libyaml where PyYAML has it, which is much faster; its messages say less."""


def _fault(text: str, mark: yaml.Mark) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, text, mark)


def _check_text(text: str) -> None:
    """Refuse long texts, and what is nested too deeply before libyaml composes it: a few thousand levels crash it."""
    depth = 0
    try:
        for event in yaml.parse(text, _FastLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > limits.SETTINGS_DEPTH:
                raise _fault(f"nested more than {limits.SETTINGS_DEPTH} levels deep", event.start_mark)
            if isinstance(event, yaml.ScalarEvent):
                value = event.value
                if event.implicit[0] and _POWER.fullmatch(value) and not abs(float(value)) <= limits.NUMBER:
                    # YAML 1.1 takes 1e308 for text.
                    raise _fault(f"the number {value:.40}; allowed are numbers up to {limits.NUMBER:g}", event.start_mark)
                if len(value) > limits.TEXT:
                    raise _fault(f"a text of {len(value)} characters; allowed are {limits.TEXT}", event.start_mark)
                if "\0" in value:
                    raise _fault("a text with a zero byte", event.start_mark)
    except yaml.constructor.ConstructorError:
        raise
    except yaml.YAMLError:
        return  # the loader tells it, with the better message


def _check_values(value: Any, depth: int = 1, count: int = 0) -> int:
    """Refuse numbers that are not finite or larger than any length, count or factor, and anchors that stand for too much: what is
    too deep or too large once they are written out. Return `count` plus the keys and values of this one."""
    if depth > limits.SETTINGS_DEPTH:  # also an anchor that holds itself
        raise yaml.YAMLError(f"nested more than {limits.SETTINGS_DEPTH} levels deep with what its anchors stand for")
    if count > limits.SETTINGS_NODES:
        raise yaml.YAMLError(f"more than {limits.SETTINGS_NODES} keys and values, with what its anchors stand for")
    if isinstance(value, int | float) and not abs(value) <= limits.NUMBER:
        raise yaml.YAMLError(f"the number {str(value):.40}; allowed are numbers up to {limits.NUMBER:g}")
    for entry in value if isinstance(value, list | set | dict) else ():
        count = _check_values(entry, depth + 1, count)
        if isinstance(value, dict):
            count = _check_values(value[entry], depth + 1, count)
    return count + 1


def parse_yaml(text: str) -> Any:
    """Return the content of YAML text.

    Raises:
        yaml.YAMLError: not valid, too large, too deep, a key twice, or a number that means nothing.
    """
    try:
        _check_text(text)
        try:
            document = yaml.load(text, _FastLoader)
        except yaml.YAMLError:
            document = yaml.load(text, _StrictLoader)
        _check_values(document)
    except yaml.YAMLError:
        raise
    except RecursionError:
        raise yaml.YAMLError("nested too deeply") from None
    except (ValueError, TypeError, OverflowError, KeyError, AttributeError, IndexError) as error:
        raise yaml.YAMLError(f"a value of the wrong form: {shorter(error)}") from None  # such as `!!int x`, or 2026-02-30
    return document


MISTAKES = {
    "found character '\\t'": "; YAML takes spaces, no tabs: replace them",
    "could not find expected ':'": "; does a space follow each colon, on the line before as well?",
    "expected <block end>": "; is this line, or the one before, indented like its neighbours?",
    "mapping values are not allowed": "; is this line indented like its neighbours, and does a space follow each colon before it?"
    " A value with a colon needs quotes",
}
"""What the parser says -> what people did."""


@lru_cache(32)
def _parsed(text: str) -> Any:
    """Return `parse_yaml(text)`: every scene of a batch lies over the same few files."""
    return parse_yaml(text)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a file of `key: value` lines.

    Raises:
        InputError: the file cannot be read, is not UTF-8, not valid YAML, larger than `workflow.intake.limits` allow, or holds
            something else; names file and line.
    """
    text = read_text(path, limits.SETTINGS_BYTES, "a file of settings")
    try:
        document = copy.deepcopy(_parsed(text))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        said = shorter(getattr(error, "problem", None) or error)
        help_ = next((words for start, words in MISTAKES.items() if start in said), "")
        raise InputError(f"{path}{where}: not valid YAML ({said}){help_}") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path}: found {type(document).__name__}, expected `key: value` lines; see config/scenes/kitchen.yaml")
    return document
