"""Strict reading of YAML files, with errors that name file and line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from iif_core.errors import InputError


class _Strict:
    """YAML in which a key that occurs twice in one mapping is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        named = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        keys = [self.construct_object(key, deep=deep) for key in named]
        for key, key_node in zip(keys, named, strict=True):
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"key `{key}` stands twice", key_node.start_mark)
        return super().construct_mapping(node, deep)


class _StrictLoader(_Strict, yaml.SafeLoader):
    pass


class _FastLoader(_Strict, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """The same by libyaml where PyYAML has it, which is much faster; its messages say less."""


def _parsed(text: str) -> Any:
    try:
        return yaml.load(text, _FastLoader)
    except yaml.YAMLError:
        return yaml.load(text, _StrictLoader)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a file of `key: value` lines.

    Raises:
        InputError: the file is not UTF-8, not valid YAML, or holds something else; names file and line.
    """
    try:
        document = _parsed(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}{where}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path}: found {type(document).__name__}, expected `key: value` lines; see config/scenes/kitchen.yaml")
    return document
