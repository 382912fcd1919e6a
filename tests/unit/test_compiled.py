"""Compiled code gives the same bytes whether it was compiled just now or read from the compiler's cache.

A loop that is called by another exists twice: as a copy in the caller and on its own. Which of the two the linker takes
depends on the state of the cache, and their float sums differ in the last bits, so such loops must be inlined.
"""

import importlib
import itertools
import os
import pkgutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

import iif_core
import lab.published
from iif_core.numerics.compiled import LockedCacheFile

PROGRAM = """
import hashlib
import numpy as np
from iif_core.fusion import kernels
from iif_core.fusion.problem import LOWEST

rng = np.random.default_rng(0)
n, n_segments, n_predictions = 20000, 40, 8
inner = np.sort(rng.choice(np.arange(1, n), n_segments - 1, replace=False))
start = np.r_[0, inner, n].astype(np.int64)
values = rng.random((n_predictions, 5, n)).astype(np.float16).view(np.uint16)
affine = rng.normal(0, 0.1, (n_segments, n_predictions, kernels.CROSS)).astype(np.float32)
mixed, target = rng.random((2, 5, n)).astype(np.float32)
network = kernels.sorting_network(n_predictions)
pixels = kernels.Pixels(values, mixed, target, rng.random(n).astype(np.float32), start)
b, votes = kernels.disagreement(pixels, affine, np.ones(n_predictions, bool), network, LOWEST, 1e-3)
print(hashlib.sha256(b.tobytes() + votes.tobytes() + kernels.mixture(values, affine, start, LOWEST).tobytes()).hexdigest())
"""


def _compiled():
    packages = [pkgutil.walk_packages(root.__path__, f"{root.__name__}.") for root in (iif_core, lab.published)]
    for package in itertools.chain(*packages):
        module = importlib.import_module(package.name)
        for name, value in vars(module).items():
            if isinstance(value, Dispatcher) and value.py_func.__module__ == package.name:
                yield f"{package.name}.{name}", module, value


def test_every_loop_called_by_another_is_inlined():
    found = list(_compiled())
    called = [
        (name, value)
        for name, _, value in found
        if any(value.py_func.__name__ in caller.py_func.__code__.co_names for _, _, caller in found if caller is not value)
    ]
    assert len(found) > 40 and len(called) > 10
    apart = [name for name, value in called if not (value.targetoptions.get("forceinline") or value.targetoptions.get("inline"))]
    assert not apart


@pytest.mark.long
def test_fresh_and_cached_code_give_the_same_bytes(tmp_path):
    run = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    ]
    assert run[0] == run[1]


@pytest.mark.parametrize("locked", [True, False])
def test_two_processes_may_compile_one_function_at_a_time(tmp_path, monkeypatch, locked):
    """For different types: without the lock, both choose the same file, and one finds there what is the other's (numba #4807)."""
    plain = IndexDataCacheFile._load_index

    def slowly(self):
        found = plain(self)
        time.sleep(0.2)
        return found

    monkeypatch.setattr(IndexDataCacheFile, "_load_index", slowly)
    kind = LockedCacheFile if locked else IndexDataCacheFile
    first, second = (kind(str(tmp_path), "f", "stamp") for _ in range(2))
    with ThreadPoolExecutor(
        2
    ) as pool:  # a lock of flock() belongs to an opened file, so threads exclude each other like processes
        list(pool.map(lambda own: own[0].save(*own[1:]), [(first, "int", b"of int"), (second, "float", b"of float")]))
    found = kind(str(tmp_path), "f", "stamp")
    assert ([found.load("int"), found.load("float")] == [b"of int", b"of float"]) == locked


def test_the_cache_of_a_read_only_checkout_is_read(tmp_path, monkeypatch):
    LockedCacheFile(str(tmp_path), "f", "stamp").save("int", b"of int")

    def refuse(*arguments):
        raise PermissionError(arguments)

    monkeypatch.setattr(os, "open", refuse)
    assert LockedCacheFile(str(tmp_path), "f", "stamp").load("int") == b"of int"


def test_every_kernel_has_a_locked_cache():
    assert [name for name, _, value in _compiled() if not isinstance(value._cache._cache_file, LockedCacheFile)] == []
