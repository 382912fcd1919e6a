"""Arrays that a job keeps on disk while it runs, because they are larger than its memory."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import IO

import numpy as np


class Scratch:
    """Keeps arrays in one file that has no name, so that nothing of it is left however the job ends."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._file: IO[bytes] | None = None

    def __call__(self, array: np.ndarray) -> np.ndarray:
        """Write an array to the file, and return it mapped from there, to be read only."""
        if not array.size:
            return array
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 (its arrays are read until the job ends)
        start = self._file.seek(0, os.SEEK_END)
        self._file.write(np.ascontiguousarray(array).data)
        self._file.flush()
        return np.memmap(self._file, array.dtype, "r", start, array.shape)
