"""Records of arrays with one row for each of many things, such as the pixels of a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np


class Rows:
    """Base of frozen dataclasses whose arrays have one row for each of n things; so have the arrays of a tuple of arrays.

    Attributes:
        WHOLE: names of fields that belong to all rows together; fields that hold no array do so anyway.
    """

    WHOLE: ClassVar[tuple[str, ...]] = ()

    def _columns(self) -> dict[str, Any]:
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in self.WHOLE and isinstance(value, np.ndarray | tuple)
        }

    def take(self, choice: np.ndarray | slice) -> Self:
        """Return the chosen rows: indices (k,) int, a mask (n,) bool, or a slice."""
        taken = {
            name: tuple(part[choice] for part in value) if isinstance(value, tuple) else value[choice]
            for name, value in self._columns().items()
        }
        return replace(self, **taken)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of one or more records, one after another; what belongs to all rows together is that of the first."""
        columns = {
            name: tuple(np.concatenate(of_parts) for of_parts in zip(*(getattr(part, name) for part in parts), strict=True))
            if isinstance(value, tuple)
            else np.concatenate([getattr(part, name) for part in parts])
            for name, value in parts[0]._columns().items()
        }
        return replace(parts[0], **columns)
