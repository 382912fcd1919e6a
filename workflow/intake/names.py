"""Names that come from files of strangers and become names of files: one function decides which are used."""

from __future__ import annotations

import unicodedata

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


def shown(value: object, longest: int = 80) -> str:
    """Return a value from a file for a message, shortened."""
    text = repr(value) if not isinstance(value, int) or abs(value) < 1 << 63 else f"an integer of {value.bit_length()} bits"
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
