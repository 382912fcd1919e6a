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

import pytest
from numba.core.dispatcher import Dispatcher

import iif_core
import lab.published

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
