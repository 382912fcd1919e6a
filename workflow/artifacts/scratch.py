"""Arrays that a job keeps on disk while it runs, because they are larger than its memory."""

from __future__ import annotations

import mmap
import os
import tempfile
from pathlib import Path
from typing import IO

import numpy as np

REGION = 1 << 30
"""Bytes that are mapped at a time: each mapping takes a file descriptor, of which a process may have only a thousand."""
ALIGNMENT = 64


class Scratch:
    """Keeps arrays in one file that has no name, so that nothing of it is left however the job ends."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._map: mmap.mmap | None = None
        self._start = self._used = 0  # of the mapped region in the file; in that region

    def __call__(self, array: np.ndarray) -> np.ndarray:
        """Write an array to the file, and return it mapped from there, to be read only. A full disk raises OSError."""
        if not array.size:
            return array
        if self._map is None or self._used + array.nbytes > len(self._map):
            self._map = self._next_region(max(REGION, array.nbytes))
        assert self._file is not None
        self._file.seek(self._start + self._used)
        self._file.write(np.ascontiguousarray(array).data)
        self._file.flush()
        out = np.frombuffer(self._map, array.dtype, array.size, self._used).reshape(array.shape)
        self._used += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
        return out

    def _next_region(self, size: int) -> mmap.mmap:
        """Lengthen the file, which takes no space before it is written, and map the new part."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 (its arrays are read until the job ends)
        end = self._file.seek(0, os.SEEK_END)
        self._start, self._used = -(-end // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY, 0
        self._file.truncate(self._start + size)
        return mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ, offset=self._start)


class Joined:
    """Joins arrays along their first axis, on disk: in a file that has no name, so that memory does not grow with them."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._rows, self._joined = 0, np.zeros(0)

    def add(self, part: np.ndarray) -> None:
        """Append rows, of the dtype and shape of those before."""
        if self._rows and self._file is None:
            raise ValueError("rows are added before they are read")
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 (closed by `array`)
            self._joined = np.zeros((0, *part.shape[1:]), part.dtype)
        if part.dtype != self._joined.dtype or part.shape[1:] != self._joined.shape[1:]:
            kept = f"{self._joined.dtype} {self._joined.shape[1:]}"
            raise ValueError(f"rows of {part.dtype} {part.shape[1:]} cannot join rows of {kept}")
        self._file.write(np.ascontiguousarray(part).data)
        self._rows += len(part)

    def array(self) -> np.ndarray:
        """Return all rows, mapped from the file, to be read only; nothing is added afterwards. A full disk raises OSError, here
        or while rows are added."""
        if self._file is not None:
            with self._file as file:
                file.flush()
                if self._rows:
                    shape = (self._rows, *self._joined.shape[1:])
                    self._joined = np.memmap(file, self._joined.dtype, "r", shape=shape).view(np.ndarray)
            self._file = None
        return self._joined
