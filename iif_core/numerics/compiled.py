"""Compilation of kernels, whose cache several processes may fill at the same time.

numba writes the index of its cache and the compiled code one after the other. Two processes that compile one function for
different types at the same time choose the same file for the code, and the index then leads to code for other types, which reads
memory that is not there (numba issue 4807). Here a process waits for the other.
"""

from __future__ import annotations

import fcntl
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile


class LockedCacheFile(IndexDataCacheFile):
    """Index and code of one function on disk; one process writes, and none reads meanwhile."""

    def save(self, key: Any, data: Any) -> None:
        with self._locked(fcntl.LOCK_EX):
            overloads = self._load_index()
            taken = set(overloads.values())
            free = (name for number in itertools.count(1) if (name := self._data_name(number)) not in taken)
            name = overloads.get(key) or next(free)
            # Code before index: after a kill in between, the index does not lead to older code.
            self._save_data(name, data)
            if key not in overloads:
                self._save_index({**overloads, key: name})

    def load(self, key: Any) -> Any:
        with self._locked(fcntl.LOCK_SH):
            return super().load(key)

    @contextmanager
    def _locked(self, kind: int) -> Iterator[None]:
        file = None
        with suppress(OSError):  # of a folder that is read-only, or a disk without locks
            access = os.O_RDWR if kind == fcntl.LOCK_EX else os.O_RDONLY
            file = os.open(f"{self._index_path}.lock", access | os.O_CREAT, 0o666)
            fcntl.flock(file, kind)
        try:
            yield
        finally:
            if file is not None:
                os.close(file)


class _LockedCache(FunctionCache):
    def __init__(self, function: Callable[..., Any]):
        super().__init__(function)
        plain = self._cache_file
        self._cache_file = LockedCacheFile(plain._cache_path, self._impl.filename_base, plain._source_stamp)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator as `numba.njit(**options)`, with a cache and without the interpreter's lock."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(nogil=True, cache=True, **options)(function)
        if hasattr(kernel, "enable_caching"):  # not where NUMBA_DISABLE_JIT is set
            kernel._cache = _LockedCache(function)
        return kernel

    return decorate
