"""What an error says as data: its kind, and the files, keys, values and commands that its message names, never its English."""

import re
from collections.abc import Generator
from contextlib import contextmanager

import pytest
from pydantic import ValidationError

from iif_core.errors import InputError


def missing(message: str, *names: object) -> list[str]:
    """Which of `names` do not stand in `message` as whole tokens.

    A token may end a longer path or key (`x.yaml` in config/scenes/x.yaml, `views` in capture.views) but not begin one: `capture`
    is missing in "capture.views", and 3 in "-3", "0.3" and "3.5".
    """
    absent = []
    for name in map(str, names):
        before = r"(?<![\w.-])" if name[:1].isdigit() else r"(?<!\w)" if name[:1].isalpha() else ""
        after = r"(?!\w|\.\w)" if name[-1:].isalnum() else ""
        if not re.search(before + re.escape(name) + after, message):
            absent.append(name)
    return absent


def named(message: str, *names: object) -> None:
    """Assert that `message` names all of `names` and says something about them."""
    absent = missing(message, *names)
    assert not absent, f"not named: {absent}\n{message}"
    rest = message
    for name in sorted(map(str, names), key=len, reverse=True):
        rest = rest.replace(name, " ")
    assert len(re.findall(r"[^\W\d_]{2,}", rest)) >= 2, f"names alone, no sentence: {message!r}"


@contextmanager
def refused(*names: object, kind: type[Exception] = InputError) -> Generator[pytest.ExceptionInfo, None, None]:
    """Expect an error of exactly this kind (no subclass) that names all of `names`: file, key, found and allowed values."""
    with pytest.raises(kind) as caught:
        yield caught
    assert caught.type is kind, f"a {caught.type.__name__}: {caught.value}"
    named(str(caught.value), *names)


@contextmanager
def misset(key: str, kind: str = "value_error", *names: object) -> Generator[pytest.ExceptionInfo, None, None]:
    """Expect pydantic to refuse the setting `key` (dotted) with an error of its type `kind` that names all of `names`."""
    with pytest.raises(ValidationError) as caught:
        yield caught
    faults = {}
    for fault in caught.value.errors():
        place = ".".join(part for part in map(str, fault["loc"]) if part.isidentifier() or part.isdigit())  # without types
        faults[place, fault["type"]] = fault["msg"]
    assert (key, kind) in faults, faults
    named(faults[key, kind], *names)
