"""Text and JSON from files of strangers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.names import shown


@contextmanager
def reading(path: Path, problem: str, cure: str = "") -> Iterator[None]:
    """Turn whatever a reader of a foreign format makes of a broken file into an `InputError`: `<path>: <problem> (...)<cure>`."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: {problem} ({error.strerror or shorter(error)}){cure}") from None
    except MemoryError:
        raise InputError(f"{path}: {problem} (it asks for more memory than there is){cure}") from None
    except RecursionError:
        raise InputError(f"{path}: {problem} (nested too deeply){cure}") from None
    except Exception as error:
        kind = "" if type(error) is ValueError else f"{type(error).__name__}: "
        raise InputError(f"{path}: {problem} ({kind}{shorter(error)}){cure}") from None


def shorter(error: object, longest: int = 200) -> str:
    """Return the message of an error in one line that is not too long."""
    text = " ".join(str(error).split())
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def check_file(path: Path, limit: int, what: str) -> int:
    """Return the size of a file in bytes.

    Raises:
        InputError: it is no file, cannot be read, or has more than `limit` bytes; `what` says in the message what it should be.
    """
    try:
        if not path.is_file():
            found = "is a folder" if path.is_dir() else "not found" if not path.exists() else "is no ordinary file"
            raise InputError(f"{path}: {found}; expected {what}")
        size = path.stat().st_size
        with path.open("rb"):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}); expected {what}") from None
    if size > limit:
        raise InputError(f"{path}: {size} bytes; {what} may have {limit} (workflow/intake/limits.py)")
    return size


def read_bytes(path: Path, limit: int, what: str) -> bytes:
    """Return the content of a file; raises InputError as `check_file`."""
    check_file(path, limit, what)
    with reading(path, "cannot be read"):
        return path.read_bytes()


def read_text(path: Path, limit: int = limits.DOCUMENT_BYTES, what: str = "a text file") -> str:
    """Return the text of a UTF-8 file, with or without byte order mark.

    Raises:
        InputError: as `check_file`, or it is not UTF-8.
    """
    data = read_bytes(path, limit, what)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in data[:4]:
        raise InputError(f"{path}: not UTF-8 text (UTF-16, or no text at all); save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None


def read_json(path: Path, what: str = "a JSON document", limit: int = limits.DOCUMENT_BYTES) -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: as `read_text`; not JSON, nested too deeply, a key that stands twice in one object, or an integer that no
            number of 64 bits holds.
    """
    return parse_json(path, read_text(path, limit, what))


def parse_json(path: Path, text: str | bytes) -> Any:
    """Return the content of JSON text from a file; raises InputError as `read_json`."""
    try:
        return json.loads(text, object_pairs_hook=_once, parse_int=_integer)
    except (ValueError, RecursionError) as error:
        said = "nested too deeply" if isinstance(error, RecursionError) else shorter(error)
        if isinstance(error, json.JSONDecodeError) and error.pos >= len(text.rstrip()):
            said = f"it ends in the middle, after {len(text)} characters; copy or export the whole file again"
        elif isinstance(error, json.JSONDecodeError) and error.msg.startswith("Unterminated"):
            said += "; a quotation mark is missing, or the file was cut short"
        raise InputError(f"{path}: not valid JSON ({said})") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {shown(twice)} stands twice in one object")
    return out


def _integer(digits: str) -> int:
    if len(digits) > 19:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)
