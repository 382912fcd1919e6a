"""Tables inside a page that people write: what stands between `<!-- table: name -->` and `<!-- end -->` is made anew."""

from __future__ import annotations

import re
from collections.abc import Iterable

from iif_core.errors import InputError

_BLOCK = re.compile(r"<!-- table: (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def fill(text: str, blocks: dict[str, str]) -> str:
    """Put tables into a page between `<!-- table: name -->` and `<!-- end -->`.

    Raises:
        InputError: the page asks for a table that does not exist.
    """

    def block(found: re.Match[str]) -> str:
        name = found.group(1)
        if name not in blocks:
            raise InputError(f"the page asks for table {name}; there are {', '.join(blocks)}")
        return f"<!-- table: {name} -->\n\n{blocks[name]}\n\n<!-- end -->"

    return _BLOCK.sub(block, text)


def markdown(head: Iterable[str], body: Iterable[Iterable[str]], words: int = 1) -> list[str]:
    """Return the lines of a table in Markdown; the first `words` columns are left-aligned, the others right-aligned."""
    head = list(head)
    lines = [head, ["---"] * words + ["---:"] * (len(head) - words), *body]
    return [f"| {' | '.join(line)} |" for line in lines]
