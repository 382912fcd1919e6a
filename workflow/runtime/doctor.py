"""Report what this machine offers, one line per check: `python -m workflow.runtime.doctor` or `make doctor`.

    ok|warn|FAIL  what: found - what to do

The exit code is 1 if any check FAILs. Only the standard library is imported here. Libraries that can abort the process (Dr.Jit
with a wrong LLVM) or lack a system library (Open3D) are tried in child processes, so that an abort can be reported.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from workflow.runtime import native

REPOSITORY = Path(__file__).resolve().parents[2]
PINS = REPOSITORY / "envs" / "requirements.in"
INSTALL = "run `bash envs/setup.sh`"
OLDEST_PYTHON = (3, 11)
NEWEST_PYTHON = (3, 14)  # the newest one with wheels for every pin
GIB = 1 << 30
CHILD_TIMEOUT_S = 300

# LLVM < 16 cannot compile `minimum`; the other two numbers are a gradient and the mean of a ray-traced image.
DRJIT_PROBE = """
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
x = mi.Float(1, 4, 16)
dr.enable_grad(x)
y = dr.sum(dr.minimum(dr.sqrt(x), 3))
dr.backward(y)
film = {"type": "hdrfilm", "width": 4, "height": 4}
scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "integrator": {"type": "path"},
                      "sensor": {"type": "perspective", "film": film}})
print(round(y[0], 4), round(dr.grad(x)[1], 4), round(float(mi.render(scene, spp=1).numpy().mean()), 4))
"""
DRJIT_ANSWER = "6.0 0.25 1.0"
OPEN3D_PROBE = """
from workflow.runtime import native
native.load_libusb()
import open3d
print(len(open3d.geometry.TriangleMesh.create_box().triangles))
"""
OPEN3D_ANSWER = "12"


@dataclass(frozen=True)
class Finding:
    """One line of the report; `level` is `ok`, `warn` (works with a restriction) or `FAIL` (does not work)."""

    level: str
    what: str
    found: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.level:<4}  {self.what}: {self.found}" + (f" - {self.advice}" if self.advice else "")


def check_python() -> Iterator[Finding]:
    found = f"{'.'.join(map(str, sys.version_info[:3]))} at {sys.executable}"
    if sys.version_info < OLDEST_PYTHON:
        yield Finding("FAIL", "python", found, "3.11 or newer is needed: run `PYTHON=python3.11 bash envs/setup.sh`")
    elif sys.version_info[:2] > NEWEST_PYTHON:
        yield Finding("warn", "python", found, "tried with 3.11 to 3.14 only")
    else:
        yield Finding("ok", "python", found)


def check_packages(pins: Path = PINS) -> Iterator[Finding]:
    """Check that every requirement of the pin file is installed as pinned; a local suffix such as +cpu is ignored."""
    missing, differing, count = [], [], 0
    for line in pins.read_text().splitlines():
        match = re.match(r"([A-Za-z0-9._-]+)(?:==([^\s;#]+))?", line)
        if match is None:
            continue
        count += 1
        name, pinned = match.groups()
        try:
            found = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
            continue
        if pinned and found.split("+")[0] != pinned.split("+")[0]:
            differing.append(f"{name} {found} instead of {pinned}")
    if missing:
        yield Finding("FAIL", "packages", "missing " + ", ".join(missing), INSTALL)
    if differing:
        yield Finding("warn", "packages", ", ".join(differing), f"results may differ from the lock's: {INSTALL}")
    if not missing and not differing:
        yield Finding("ok", "packages", f"all {count} of {pins.name} are installed as pinned")


def check_llvm() -> Iterator[Finding]:
    """Check the LLVM that will be used and, if there is one, Dr.Jit and Mitsuba with it."""
    report = native.find_llvm()
    if report.path is None:
        yield Finding("FAIL", "llvm", report.problem)
        return
    yield Finding("ok", "llvm", f"{report.version} at {report.path}")
    yield _tried("drjit", DRJIT_PROBE, DRJIT_ANSWER, "kernel, gradient and render agree with closed forms", report.path)


def check_open3d() -> Iterator[Finding]:
    yield _tried("open3d", OPEN3D_PROBE, OPEN3D_ANSWER, "loads")


def check_gpu() -> Iterator[Finding]:
    """Report GPUs; none is needed, so this check never fails."""
    names, advice = _nvidia_gpus(), ""
    if not names:
        yield Finding("ok", "gpu", "none found; none is needed")
        return
    try:
        torch = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        torch = "absent"
    if "+cpu" in torch:
        advice = f"torch is the CPU build {torch}; envs/README.md says how to install a CUDA build"
    yield Finding("ok", "gpu", ", ".join(names), advice)


def check_disk(repository: Path = REPOSITORY) -> Iterator[Finding]:
    """Check space and write permission where results and temporary files go."""
    for what, folder, plenty_gib in (
        ("disk", repository, 5.0),
        ("scratch", Path(tempfile.gettempdir()), 2.0),
    ):
        advice = "free some" if what == "disk" else "free some, or set TMPDIR to a folder on a larger disk"
        free = shutil.disk_usage(folder).free / GIB
        found = f"{free:.1f} GiB free in {folder}"
        if error := _write_error(folder):
            yield Finding("FAIL", what, f"{folder} cannot be written ({error})", advice.replace("free some, or ", ""))
        elif free < plenty_gib:
            yield Finding("FAIL" if free < 0.2 else "warn", what, found, f"{plenty_gib:.0f} GiB are advisable: {advice}")
        else:
            yield Finding("ok", what, found)


def check_compute() -> Iterator[Finding]:
    """Report processors and memory that this process may use, within its affinity and control group."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _control_group("cpu.max")
    if quota and quota[0] != "max":
        cores = min(cores, max(1, round(int(quota[0]) / int(quota[1]))))
    yield Finding("ok", "cores", str(cores))
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return
    limit = _control_group("memory.max")
    if limit and limit[0] != "max":
        memory = min(memory, int(limit[0]))
    advice = "" if memory >= 4 * GIB else "4 GiB are advisable: use `--cores 1` and quality draft"
    yield Finding("warn" if advice else "ok", "memory", f"{memory / GIB:.1f} GiB", advice)


def check_kernel_cache() -> Iterator[Finding]:
    """Check the cache of compiled kernels, `$DRJIT_CACHE_DIR` or `~/.drjit`; without it every process compiles them again."""
    named = os.environ.get("DRJIT_CACHE_DIR", "")
    folder = Path(named or os.path.expanduser("~/.drjit"))
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if error := _write_error(existing):
        advice = "each process compiles its kernels anew; set DRJIT_CACHE_DIR to a folder that can be written"
        yield Finding("warn", "kernel cache", f"{folder} cannot be written ({error})", advice)
    else:
        yield Finding("ok", "kernel cache", str(folder))


def check_optional() -> Iterator[Finding]:
    """Report optional tools."""
    validator = REPOSITORY / ".node/node_modules/gltf-validator"
    advice = "optional, lets the tests check scene.glb: `make node` (needs npm)"
    yield Finding("ok", "gltf-validator", *((str(validator), "") if validator.is_dir() else ("not found", advice)))
    oidn = find_spec("pyoidn") is not None
    advice = "rendered scenes and re-renderings are denoised with it: `bash envs/setup.sh`, or set denoise: false"
    yield Finding("ok" if oidn else "warn", "oidn", "pyoidn" if oidn else "not found", "" if oidn else advice)


CHECKS: tuple[Callable[[], Iterable[Finding]], ...] = (
    check_python,
    check_packages,
    check_llvm,
    check_open3d,
    check_gpu,
    check_disk,
    check_compute,
    check_kernel_cache,
    check_optional,
)
NEED_PACKAGES = {check_llvm, check_open3d, check_optional}
"""Checks that fail before anything is installed."""


def _tried(what: str, code: str, answer: str, success: str, llvm: str = "") -> Finding:
    child = _run([sys.executable, "-c", code], {native.LLVM_VARIABLE: llvm} if llvm else {})
    lines = child.stdout.split("\n")
    if child.returncode == 0 and answer in lines:
        return Finding("ok", what, success)
    if child.returncode == 0:
        return Finding("FAIL", what, f"computed {child.stdout.strip()!r} instead of {answer!r}", INSTALL)
    errors = [line for line in child.stderr.splitlines() if re.search(r"error|cannot|not be", line, re.IGNORECASE)]
    # Dr.Jit raises its own error, which hides the library that it could not load.
    lacking = [line for line in errors if "cannot open shared object" in line]
    reason = (lacking or errors or child.stderr.strip().splitlines() or [""])[-1].strip()[:300]
    if child.returncode < 0:
        first = (errors or [reason])[0].strip()[:120]
        reason = f"the process was ended by {signal.Signals(-child.returncode).name}" + (f" ({first})" if first else "")
    advice = INSTALL
    if library := re.search(r"(lib[\w+.-]+\.so[.\d]*): cannot open shared object", reason):
        packages = "libgl1 libegl1 libx11-6 libatomic1 libusb-1.0-0"
        advice = f"install the system library {library[1]} (Debian and Ubuntu: {packages})"
    return Finding("FAIL", what, reason or f"ended with code {child.returncode}", advice)


def _run(command: list[str], variables: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **(variables or {})}
    try:
        return subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=CHILD_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return subprocess.CompletedProcess(command, 1, "", str(error))


def _nvidia_gpus() -> list[str]:
    tool = shutil.which("nvidia-smi")
    child = _run([tool, "--query-gpu=name,memory.total", "--format=csv,noheader"]) if tool else None
    return child.stdout.strip().splitlines() if child and child.returncode == 0 else []


def _write_error(folder: Path) -> str | None:
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-"):
            return None
    except OSError as error:
        return error.strerror or type(error).__name__


def _control_group(name: str) -> list[str]:
    try:
        return Path("/sys/fs/cgroup", name).read_text().split()
    except OSError:
        return []


def check_nothing_yet() -> Iterator[Finding]:
    yield Finding(
        "ok", "packages", "not installed yet - the first `make scenes/kitchen` installs all (`bash envs/setup.sh` alone)"
    )


def checks(repository: Path = REPOSITORY) -> Iterable[Callable[[], Iterable[Finding]]]:
    """Return the checks; before the installation, those of the machine alone."""
    if (repository / ".venv").exists() or find_spec("snakemake") or find_spec("mitsuba"):
        return CHECKS
    return [check_nothing_yet if one is check_packages else one for one in CHECKS if one not in NEED_PACKAGES]


def main() -> int:
    """Print every finding as it is made; return 1 if any FAILs, else 0."""
    failed = False
    for check in checks():
        try:
            findings = list(check())
        except Exception as error:  # a check that breaks must not hide the others
            findings = [Finding("FAIL", check.__name__.removeprefix("check_"), repr(error), "please report this bug")]
        for finding in findings:
            print(finding, flush=True)
            failed |= finding.level == "FAIL"
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
