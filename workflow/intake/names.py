"""Names that come from files of strangers and become names of files: one function decides which are used."""

from __future__ import annotations

import unicodedata
from functools import lru_cache
from pathlib import Path

LONGEST = 180
"""Bytes of a name. File systems allow 255, and names of temporary files and of layers are added to it."""
_NEVER = {"Cc", "Cs", "Zl", "Zp"}  # control characters, halves of surrogate pairs, separators of lines and paragraphs
_TURNING = set("\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")  # the direction of writing


def fault_of_name(name: str, longest: int = LONGEST) -> str:
    """Return why `name` cannot be the name of a file or folder that is written, or an empty text if it can.

    >>> fault_of_name("DSC 0001 (2)"), fault_of_name(".."), fault_of_name("a/b")
    ('', 'begins with a dot', 'holds a slash')
    """
    if not name or not name.strip():
        return "is empty"
    if name.startswith("."):
        return "begins with a dot"
    if "/" in name or "\\" in name:
        return "holds a slash"
    if any(unicodedata.category(c) in _NEVER or c in _TURNING for c in name):
        return "holds a control character"
    size = len(name.encode())
    if size > longest:
        return f"has {size} bytes (allowed {longest})"
    return ""


def same_name(name: str) -> str:
    """Return a form that is equal for names that some file systems take for one: upper and lower case, composed letters."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def forward(path: str) -> str:
    """Return a path with forward slashes, as programs on Windows write it with backslashes.

    >>> forward(r".\\images\\0001.jpg")
    './images/0001.jpg'
    """
    return path.replace("\\", "/")


def existing(path: Path) -> Path:
    """Return `path`, or where nothing is there the one file whose name differs in capital letters, or in how its letters are
    composed, alone: such names come from systems that do not tell them apart."""
    try:
        if path.exists() or path.parent == path:
            return path
        folder = existing(path.parent)
        stamp = folder.stat().st_mtime_ns if folder.is_dir() else None
    except OSError:  # a name that no file can have
        return path
    found = _listed(folder, stamp).get(same_name(path.name), ()) if stamp is not None else ()
    return folder / found[0] if len(found) == 1 else path


@lru_cache(64)
def _listed(folder: Path, _stamp: int) -> dict[str, tuple[str, ...]]:
    out: dict[str, tuple[str, ...]] = {}
    for entry in folder.iterdir():
        name = same_name(entry.name)
        out[name] = (*out.get(name, ()), entry.name)
    return out


def shown(value: object, longest: int = 80) -> str:
    """Return a value from a file for a message, shortened."""
    text = repr(value) if not isinstance(value, int) or abs(value) < 1 << 63 else f"an integer of {value.bit_length()} bits"
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
