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
    """YAML in which a key that occurs twice in one mapping is an error, and whose size is checked before it is built."""

    def get_single_node(self) -> Any:
        node = super().get_single_node()  # type: ignore[misc]
        if node is not None:
            _check_nodes(node)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=deep)  # type: ignore[attr-defined]
            if not isinstance(key, str | int | float | bool | None):
                raise yaml.constructor.ConstructorError(None, None, "a key is no text", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key `{key}` stands twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)  # type: ignore[misc]


class _StrictLoader(_Strict, yaml.SafeLoader):
    pass


class _FastLoader(_Strict, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """The same by libyaml where PyYAML has it, which is much faster; its messages say less."""


def _check_depth(text: str) -> None:
    """Refuse a document that is nested too deeply before libyaml composes it, which a few thousand levels crash."""
    depth = 0
    try:
        for event in yaml.parse(text, _FastLoader):
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            if depth > limits.SETTINGS_DEPTH:
                problem = f"nested more than {limits.SETTINGS_DEPTH} levels deep"
                raise yaml.constructor.ConstructorError(None, None, problem, event.start_mark)
    except yaml.constructor.ConstructorError:
        raise
    except yaml.YAMLError:
        return  # the loader tells it, with the better message


def _check_nodes(root: yaml.Node) -> None:
    """Refuse a document that is too deep or too large once its anchors are written out, and numbers that mean nothing.

    Raises:
        yaml.YAMLError: with the place.
    """
    sizes: dict[int, int] = {}  # node -> keys and values below it; 0 while they are counted

    def problem(node: yaml.Node, text: str) -> yaml.YAMLError:
        return yaml.constructor.ConstructorError(None, None, text, node.start_mark)

    def size(node: yaml.Node, depth: int) -> int:
        if depth > limits.SETTINGS_DEPTH:  # by anchors
            raise problem(node, f"nested more than {limits.SETTINGS_DEPTH} levels deep with what its anchors stand for")
        if id(node) in sizes:
            if not sizes[id(node)]:
                raise problem(node, "an anchor that holds itself")
            return sizes[id(node)]
        sizes[id(node)] = 0
        if isinstance(node, yaml.MappingNode):
            below = [part for pair in node.value for part in pair]
        else:
            below = node.value if isinstance(node, yaml.SequenceNode) else []
            if isinstance(node, yaml.ScalarNode):
                _check_scalar(node)
        count = 1 + sum(size(part, depth + 1) for part in below)
        if count > limits.SETTINGS_NODES:
            raise problem(node, f"more than {limits.SETTINGS_NODES} keys and values, with what its anchors stand for")
        sizes[id(node)] = count
        return count

    size(root, 1)


def _check_scalar(node: yaml.ScalarNode) -> None:
    text = node.value
    number = node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
    longest = 40 if number else limits.TEXT
    fault = ""
    if not node.style and _POWER.fullmatch(text) and not abs(float(text)) <= limits.NUMBER:  # YAML 1.1 takes 1e308 for text
        fault = f"the number {text:.40}; allowed are numbers up to {limits.NUMBER:g}"
    elif len(text) > longest:
        fault = f"{'a number' if number else 'a text'} of {len(text)} characters; allowed are {longest}"
    elif "\0" in text:
        fault = "a text with a zero byte"
    if fault:
        raise yaml.constructor.ConstructorError(None, None, fault, node.start_mark)


def _check_numbers(value: Any) -> None:
    """Refuse numbers that are not finite or larger than any length, count or factor."""
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_numbers(key)
            _check_numbers(entry)
    elif isinstance(value, list):
        for entry in value:
            _check_numbers(entry)
    elif isinstance(value, int | float) and not abs(value) <= limits.NUMBER:
        raise yaml.YAMLError(f"the number {value:g}; allowed are numbers up to {limits.NUMBER:g}")


def parse_yaml(text: str) -> Any:
    """Return the content of YAML text.

    Raises:
        yaml.YAMLError: not valid, too large, too deep, a key twice, or a number that means nothing.
    """
    try:
        _check_depth(text)
        try:
            document = yaml.load(text, _FastLoader)
        except yaml.YAMLError:
            document = yaml.load(text, _StrictLoader)
        _check_numbers(document)
    except yaml.YAMLError:
        raise
    except RecursionError:
        raise yaml.YAMLError("nested too deeply") from None
    except (ValueError, TypeError, OverflowError, KeyError, AttributeError, IndexError) as error:
        raise yaml.YAMLError(f"a value of the wrong form: {shorter(error)}") from None  # such as `!!int x`, or 2026-02-30
    return document


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
        said = getattr(error, "problem", None) or error
        raise InputError(f"{path}{where}: not valid YAML ({shorter(said)})") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path}: found {type(document).__name__}, expected `key: value` lines; see config/scenes/kitchen.yaml")
    return document
