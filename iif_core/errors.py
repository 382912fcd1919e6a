"""Exceptions."""

import re

LONGEST_WORD = 1_000
"""Characters without a space in a message."""
_LONG = re.compile(rf"\S{{{LONGEST_WORD},}}")


class InputError(ValueError):
    """The input cannot be used. The message says what was found, what is allowed and what to do next.

    Words of more than `LONGEST_WORD` characters, which come from the input, are shortened; characters that steer a terminal are
    written out, such as `\\x1b`.
    """

    def __init__(self, message: str = ""):
        text = str(message)
        if not text.replace("\n", "").isprintable():
            text = "".join(c if c == "\n" or c.isprintable() else c.encode("unicode_escape").decode() for c in text)
        super().__init__(_LONG.sub(lambda word: f"{word[0][:100]}...{word[0][-20:]}", text))
