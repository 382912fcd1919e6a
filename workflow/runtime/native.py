"""Native libraries and the process environment, which must be right before `mitsuba` or `open3d` is imported.

Dr.Jit compiles through a shared libLLVM. With LLVM 15 it aborts the whole process in the first kernel ("Cannot select
fminimum") instead of raising an error, and without LLVM it fails only when a variant is chosen. Therefore the library is
found and its version is asked here, in a child process, before Dr.Jit is imported. Open3D needs libusb although no camera is ever
opened; where the system has no libusb, the one in the `libusb-package` wheel is loaded under its soname.

Only the standard library is used, and importing this module changes nothing.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from iif_core.errors import InputError

OLDEST_LLVM = 16
LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "ARROW_IO_THREADS",
)
SMALL_MATRICES = "OPENBLAS_NUM_THREADS"
"""Always 1: NumPy's and SciPy's matrices are small here, and threads that wait for one another doubled the CPU time of stages.
Sums in another order would also make results depend on the number of threads."""
# LLVMGetVersion exists from LLVM 16 on: its absence is the answer "older".
_ASK = """
import ctypes, sys
try: library = ctypes.CDLL(sys.argv[1])
except OSError as error: sys.exit(str(error))
major = ctypes.c_uint()
try: library.LLVMGetVersion(ctypes.byref(major), None, None)
except AttributeError: print(0)
else: print(major.value)
"""


@dataclass(frozen=True)
class LlvmReport:
    """The LLVM library that Dr.Jit shall load, or the reason why there is none.

    Attributes:
        path: absolute path of the usable library, None if there is none.
        version: its major version, 0 if `path` is None.
        problem: one line that says what was found, what is needed and what to do; None if `path` is usable.
    """

    path: str | None
    version: int
    problem: str | None


def find_llvm(environment: Mapping[str, str] | None = None, folders: Sequence[str] | None = None) -> LlvmReport:
    """Find an LLVM >= 16: the one that `DRJIT_LIBLLVM_PATH` names, otherwise the one that is installed with this environment.

    A variable that names an unusable library is a problem, because it was set on purpose and every child process inherits it.
    Never raises.

    Args:
        environment: by default `os.environ`.
        folders: of libraries, best first; by default those of this environment and of the Python that it was made from.
    """
    chosen = (os.environ if environment is None else environment).get(LLVM_VARIABLE, "")
    if chosen:
        path = os.path.abspath(os.path.expanduser(chosen))
        version, reason = _version(path)
        problem = f"{LLVM_VARIABLE} names {path}, {reason}; unset it or name an LLVM {OLDEST_LLVM} or newer"
        return LlvmReport(None, 0, problem) if reason else LlvmReport(path, version, None)
    if folders is None:
        folders = [f"{prefix}/lib" for prefix in dict.fromkeys((sys.prefix, sys.base_prefix))]
    paths = [os.path.realpath(f"{folder}/libLLVM.so") for folder in folders]
    reasons = []
    for path in filter(os.path.exists, paths):
        version, reason = _version(path)
        if reason is None:
            return LlvmReport(path, version, None)
        reasons.append(f"{path}, {reason}")
    found = "found only " + "; ".join(reasons) if reasons else "found no LLVM library"
    return LlvmReport(
        None,
        0,
        f"{found}. Dr.Jit needs LLVM {OLDEST_LLVM} or newer (older ones abort the process): "
        f"run `bash envs/setup.sh`, which installs one without root, or set {LLVM_VARIABLE} to a libLLVM.so",
    )


def load_libusb() -> bool:
    """Make libusb-1.0 available to a later `import open3d`; return False where neither system nor wheel has it."""
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
        return True
    except OSError:
        pass
    spec = importlib.util.find_spec("libusb_package")  # importing it would need importlib_resources
    if spec is None or spec.origin is None:
        return False
    try:
        ctypes.CDLL(str(Path(spec.origin).with_name("libusb-1.0.so")), mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True


def prepare() -> LlvmReport:
    """Set `DRJIT_LIBLLVM_PATH` to a usable LLVM and make libusb loadable; call it before importing Mitsuba. Idempotent.

    Raises:
        InputError: there is no usable LLVM.
        RuntimeError: Dr.Jit is imported already; it reads the variable at its import, so it may hold a wrong LLVM.
    """
    if "drjit" in sys.modules and not os.environ.get(LLVM_VARIABLE):
        raise RuntimeError("drjit was imported before native.prepare(); call prepare() first")
    load_libusb()
    report = find_llvm()
    if report.path is None:
        raise InputError(report.problem)
    os.environ[LLVM_VARIABLE] = report.path
    return report


def process_environment() -> None:
    """Put this interpreter first on PATH and the repository first on PYTHONPATH, for this process's children.

    Thus `.venv/bin/snakemake` works in an environment that was never activated, or is empty, and jobs find the code from any
    working folder. HOME, where Dr.Jit and Snakemake keep their caches, is taken from the user database if it is unset.
    Idempotent.
    """
    repository = Path(__file__).resolve().parents[2]
    for variable, first in (("PATH", Path(sys.executable).parent), ("PYTHONPATH", repository)):
        rest = [part for part in os.environ.get(variable, "").split(os.pathsep) if part and part != str(first)]
        os.environ[variable] = os.pathsep.join([str(first), *rest])
    home = os.path.expanduser("~")
    if "HOME" not in os.environ and os.path.isabs(home):
        os.environ["HOME"] = home


def limit_threads(count: int) -> None:
    """Let numerical libraries use `count` threads, the calling one included.

    Libraries that are not yet imported read it from environment variables, as do child processes; torch and pyarrow are set
    directly if they are imported already. Dr.Jit reads no variable, so after prepare() it is imported here and set. OpenBLAS has
    one thread whatever `count` is (SMALL_MATRICES); one that NumPy has already started keeps its own.

    Raises:
        InputError: `count` is below 1.
    """
    if count < 1:
        raise InputError(f"threads: found {count}, allowed is 1 or more")
    for variable in THREAD_VARIABLES:
        os.environ[variable] = str(count)
    os.environ[SMALL_MATRICES] = "1"
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(count)
    if pyarrow := sys.modules.get("pyarrow"):
        pyarrow.set_cpu_count(count)
        pyarrow.set_io_thread_count(count)
    if "drjit" in sys.modules or (os.environ.get(LLVM_VARIABLE) and importlib.util.find_spec("drjit")):
        importlib.import_module("drjit").set_thread_count(count)


def _version(path: str) -> tuple[int, str | None]:
    """Return the major version that the library itself reports, and why it cannot be used (None if it can)."""
    if not os.path.exists(path):
        return 0, "which does not exist"
    if not os.path.isfile(path):
        return 0, "which is not a file"
    status = os.stat(path)
    version, error = _ask_version(path, status.st_mtime_ns, status.st_size)
    if error is not None:
        return 0, f"which cannot be loaded ({error})"
    if version < OLDEST_LLVM:
        return version, f"which is LLVM {version or f'older than {OLDEST_LLVM}'}"
    return version, None


@lru_cache(maxsize=32)
def _ask_version(path: str, _mtime_ns: int, _size: int) -> tuple[int, str | None]:
    # In a child: two LLVMs in one process can clash, and a broken one may crash it.
    command = [sys.executable, "-I", "-S", "-c", _ASK, path]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        return 0, f"asking it failed: {error}"
    if child.returncode == 0 and child.stdout.strip().isdigit():
        return int(child.stdout), None
    lines = child.stderr.strip().splitlines()
    return 0, lines[-1] if lines else f"its loader ended with code {child.returncode}"
