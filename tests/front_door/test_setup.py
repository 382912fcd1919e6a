"""The first commands of a stranger: set up, ask the doctor, make. Nothing is downloaded here.

What setup.sh does before pip is tried in copies of the checkout, with stand-ins for python and df on PATH.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import zipfile
from email import message_from_string
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from tests.errors import missing, named
from workflow.runtime import doctor, native

pytestmark = pytest.mark.front_door


def run(command, folder, environment, **variables):
    return subprocess.run(command, cwd=folder, env={**environment, **variables}, capture_output=True, text=True, timeout=120)


@pytest.fixture
def copy(tmp_path, repository):
    """A checkout (in a folder with a space in its name) that was never set up."""
    folder = tmp_path / "a copy"
    for part in ("envs", "iif_core", "workflow"):
        shutil.copytree(repository / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture
def stand_in(tmp_path, clean_environment):
    """`stand_in("df", script)` puts a shell script before the system's command of that name."""
    tools = tmp_path / "tools"
    tools.mkdir()
    clean_environment["PATH"] = f"{tools}:{clean_environment['PATH']}"

    def make(name, script):
        (tools / name).write_text("#!/bin/sh\n" + script)
        (tools / name).chmod(0o755)
        return str(tools / name)

    return make


def needs_own_venv(repository):
    if not (repository / ".venv" / ".setup").is_file():
        pytest.skip("this environment was not made by envs/setup.sh")


def last_line(text):
    return text.strip().splitlines()[-1]


@pytest.mark.parametrize("script", ["envs/setup.sh", "envs/image-check.sh", ".ci/run"])
def test_scripts_are_executable_bash(script, repository, clean_environment):
    assert os.access(repository / script, os.X_OK)
    assert run(["bash", "-n", script], repository, clean_environment).returncode == 0


def test_second_setup_does_nothing(repository, clean_environment):
    """From any folder, without a word, without touching anything."""
    needs_own_venv(repository)
    stamp = repository / ".venv" / ".setup"
    before = stamp.stat().st_mtime_ns, stamp.read_text()
    torch = {name: os.environ[name] for name in ("TORCH", "TORCH_INDEX") if name in os.environ}
    result = run(["bash", str(repository / "envs/setup.sh")], "/", clean_environment, **torch)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert (stamp.stat().st_mtime_ns, stamp.read_text()) == before


def test_environment_of_another_checkout_is_left_alone(copy, tmp_path, clean_environment):
    """A link to it is refused; making it anew would break the other checkout."""
    other = tmp_path / "other"
    (other / ".venv").mkdir(parents=True)
    stamp = other / ".venv/.setup"
    stamp.write_text(f"lock torch {other}\nchecked\n")
    (copy / ".venv").symlink_to(other / ".venv")
    result = run(["bash", "envs/setup.sh"], copy, clean_environment)
    assert result.returncode == 1 and not missing(last_line(result.stderr), ".venv", other)
    assert stamp.read_text().startswith("lock")


def test_too_old_python(copy, stand_in, clean_environment):
    old = stand_in("oldpython", 'case "$2" in *exit*) exit 1;; *) echo 3.9;; esac\n')
    result = run(["bash", "envs/setup.sh"], copy, clean_environment, PYTHON=old)
    assert result.returncode == 1
    assert len(result.stderr.strip().splitlines()) == 1
    named(result.stderr, "Python 3.11", "Python 3.9", old, "PYTHON=")
    assert not (copy / ".venv").exists()


def test_absent_python(copy, clean_environment):
    result = run(["bash", "envs/setup.sh"], copy, clean_environment, PYTHON="/nowhere/python3")
    assert result.returncode == 1 and not missing(result.stderr, "Python 3.11", "/nowhere/python3")


def test_python_without_venv(copy, stand_in, clean_environment):
    stand_in("python3", 'case "$2" in *ensurepip*) exit 1;; *print*) echo 3.12;; esac\n')
    result = run(["bash", "envs/setup.sh"], copy, clean_environment)
    assert result.returncode == 1
    named(result.stderr, "python3 (3.12)", "venv", "python3.12-venv")


def test_small_disk(copy, stand_in, clean_environment):
    stand_in("df", "echo header; echo /dev/x 9999999 0 1048576 99% /\n")
    result = run(["bash", "envs/setup.sh"], copy, clean_environment, PYTHON=sys.executable)
    assert result.returncode == 1
    named(result.stderr, "1024 MB", 4000)


def wheel(folder, name, version, tag="py3-none-any"):
    """Write the smallest package that pip installs; return the file and its SHA-256."""
    about = f"{name}-{version}.dist-info"
    path = folder / f"{name}-{version}-{tag}.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        archive.writestr(f"{about}/WHEEL", f"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: {tag}\n")
        archive.writestr(f"{about}/RECORD", "")
    return path, hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def empty_environment(tmp_path_factory):
    """A .venv with nothing but pip, to be copied: making one takes seconds."""
    folder = tmp_path_factory.mktemp("empty") / ".venv"
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    return folder


@pytest.fixture
def index(copy, empty_environment, tmp_path, stand_in, clean_environment):
    """`index("+cpu", listed=True, sha256=...)`: a set-up checkout whose lock is one package, and pip's only source, a folder with
    that package and a torch; returns what setup.sh is to be run with."""
    pinned = re.search(r"^torch==(\S+)", (copy / "envs/requirements.in").read_text(), re.M)[1]
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    tag = f"{python}-{python}-linux_{os.uname().machine}"
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    environment = {k: v for k, v in clean_environment.items() if not k.startswith("PIP_")}
    environment |= {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheels), "PIP_NO_CACHE_DIR": "1"}
    stand_in("df", "echo header; echo /dev/x 99999999 0 20971520 9% /\n")

    def make(suffix, listed, sha256=None, extra=""):
        _, of_package = wheel(wheels, "iif_tiny", "1")
        (copy / "envs/requirements.lock").write_text(f"iif-tiny==1 --hash=sha256:{of_package}\n")
        path, of_torch = wheel(wheels, "torch", f"{pinned}{suffix}", tag)
        sha256 = sha256 or of_torch
        row = f"#   {sha256}  3000000  9000000 {path.name}\n" if listed else ""
        (copy / "envs/torch.lock").write_text(f"torch=={pinned} --hash=sha256:{sha256}\n{row}")
        (copy / "envs/sizes.tsv").write_text(f"requirements.lock\t1\t10\t20\n{extra}")
        (copy / ".venv").symlink_to(empty_environment)
        # As if another lock had been installed: brought up to date in place.
        (empty_environment / ".setup").write_text(f"lock torch {copy}\nchecked\n")
        subprocess.run([empty_environment / "bin/python", "-m", "pip", "uninstall", "-qy", "torch"], env=environment, check=True)
        return environment

    return make


def installed_torch(copy):
    return [path.name for path in copy.glob(".venv/lib/python*/site-packages/torch-*.dist-info")]


def test_torch_is_installed_by_its_hash_and_what_is_downloaded_is_said_first(copy, index):
    result = run(["bash", "envs/setup.sh"], copy, index("+cpu", listed=True))
    said = [line for line in result.stderr.splitlines() if line.startswith("setup: ")]
    named(said[0], "10 MB", "torch 2.13.0+cpu", "3 MB", "532 MB")
    assert said[2].startswith("setup: ") and "torch 2.13.0+cpu" in said[2]
    assert installed_torch(copy) == ["torch-2.13.0+cpu.dist-info"]
    assert "FAIL" in said[-1]  # the packages are not there


def test_a_torch_with_another_hash_is_refused(copy, index):
    result = run(["bash", "envs/setup.sh"], copy, index("+cpu", listed=True, sha256="0" * 64))
    assert result.returncode == 1
    named(last_line(result.stderr), "torch==2.13.0+cpu", "SHA-256")
    assert not installed_torch(copy) and not (copy / ".venv/.setup").exists()


def test_a_torch_that_pip_does_not_foresee_needs_a_hash_too(copy, index):
    """`pip index` is experimental: without its answer nothing else gets in."""
    environment = index("+cpu", listed=True, sha256="0" * 64)
    python = copy / ".venv/bin/python"
    real = os.readlink(python)
    python.unlink()
    python.write_text(f'#!/bin/bash\ncase "$*" in *"pip index"*) exit 1;; esac\nexec -a "$0" {real} "$@"\n')
    python.chmod(0o755)
    try:
        result = run(["bash", "envs/setup.sh"], copy, environment)
    finally:
        python.unlink()
        python.symlink_to(real)
    named(last_line(result.stderr), "torch==2.13.0", "SHA-256")
    assert not installed_torch(copy)


@pytest.mark.long
def test_the_cuda_builds_need_more_and_all_of_it_by_hash(copy, index, tmp_path):
    environment = index("", listed=True, extra="torch-cuda.lock\t1\t2000\t4000\n")
    _, right = wheel(tmp_path / "wheels", "iif_cuda", "1")
    (copy / "envs/torch-cuda.lock").write_text(f"iif-cuda==1 --hash=sha256:{right[::-1]}\n")
    tools = tmp_path / "gpu"
    for gpu, code in (("GPU", 0), ("no GPU", 9)):
        tools.mkdir(exist_ok=True)
        (tools / "nvidia-smi").write_text(f"#!/bin/sh\nexit {code}\n")
        (tools / "nvidia-smi").chmod(0o755)
        (copy / ".venv/.setup").write_text(f"lock torch {copy}\nchecked\n")
        result = run(["bash", "envs/setup.sh"], copy, {**environment, "PATH": f"{tools}:{environment['PATH']}"})
        named(result.stderr, "torch 2.13.0", "3 MB", "2000 MB", "6532 MB")
        assert ("TORCH_INDEX" in result.stderr) == (gpu == "no GPU")
        named(last_line(result.stderr), "CUDA", "iif-cuda==1", "SHA-256")


def test_a_build_that_is_not_listed_is_refused_unless_it_is_chosen(copy, index):
    """It is refused before any download. If it is chosen, a message says that it comes without a hash."""
    environment = index("+cu126", listed=False)
    result = run(["bash", "envs/setup.sh"], copy, environment)
    assert result.returncode == 1 and len(result.stderr.strip().splitlines()) == 1
    named(result.stderr, "torch 2.13.0+cu126", "envs/torch.lock", "make lock-torch", "TORCH=torch==2.13.0+cu126")
    (copy / ".venv/.setup").write_text(f"lock torch {copy}\nchecked\n")
    result = run(["bash", "envs/setup.sh"], copy, environment, TORCH="torch==2.13.0+cu126")
    named(result.stderr, "envs/torch.lock", "torch 2.13.0+cu126")
    assert installed_torch(copy) == ["torch-2.13.0+cu126.dist-info"]


@pytest.mark.long
def test_no_network(copy, stand_in, clean_environment):
    """Port 9 of this machine refuses connections. Afterwards .venv counts as incomplete."""
    stand_in("df", "echo header; echo /dev/x 99999999 0 8388608 9% /\n")  # the disk under the test may be smaller
    quick = {"PIP_RETRIES": "1", "PIP_TIMEOUT": "2", "PIP_CONFIG_FILE": os.devnull, "PIP_NO_CACHE_DIR": "1"}
    environment = {k: v for k, v in clean_environment.items() if not k.startswith("PIP_")} | quick
    for _ in range(2):
        result = run(
            ["bash", "envs/setup.sh"],
            copy,
            environment,
            PYTHON=sys.executable,
            PIP_INDEX_URL="http://127.0.0.1:9/simple",
        )
        assert result.returncode == 1
        assert not missing(last_line(result.stderr), "pip config list")
        assert not (copy / ".venv" / ".setup").exists()
    assert "incomplete" in result.stderr


def test_the_site_installs_on_every_python_that_is_allowed(repository):
    """What is pinned for `make docs` must not ask for a later release of Python 3.11 than Debian has."""
    found = list(repository.glob(".venv-docs/lib/python*/site-packages/*.dist-info/METADATA"))
    if not found:
        pytest.skip("no environment for the site; `make docs` makes it")
    needed = {path.parent.name: message_from_string(path.read_text())["Requires-Python"] for path in found}
    late = {name: asked for name, asked in needed.items() if not SpecifierSet(asked or "").contains("3.11.0")}
    assert not late


def test_doctor_passes_here(repository, clean_environment):
    """In an empty environment; every line has the promised form."""
    result = run([sys.executable, "-m", "workflow.runtime.doctor"], repository, clean_environment)
    lines = result.stdout.splitlines()
    assert result.returncode == 0, result.stdout + result.stderr
    assert all(line[:6] in ("ok    ", "warn  ") and ": " in line for line in lines)
    for what in (
        "python",
        "packages",
        "llvm",
        "drjit",
        "open3d",
        "gpu",
        "disk",
        "scratch",
        "cores",
        "kernel cache",
    ):
        assert any(line[6:].startswith(f"{what}: ") for line in lines), what


def test_doctor_asks_for_nothing_that_the_installation_brings(repository, tmp_path, clean_environment):
    """A fresh clone: the machine is judged, and what is missing comes by itself."""
    shutil.copytree(repository / "workflow", tmp_path / "workflow", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("iif_core", "envs"):
        shutil.copytree(repository / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    base = Path(sys.base_prefix) / "bin" / f"python{sys.version_info.major}.{sys.version_info.minor}"
    result = run([str(base), "-S", "-m", "workflow.runtime.doctor"], tmp_path, clean_environment)
    assert result.returncode == 0, result.stdout + result.stderr
    told = {line[6:].partition(":")[0]: line for line in result.stdout.splitlines()}
    assert "FAIL" not in result.stdout and {"python", "packages", "disk", "cores"} <= set(told) and "llvm" not in told
    assert "make scenes/kitchen" in told["packages"]
    (tmp_path / ".venv").mkdir()  # somebody began to install
    assert run([str(base), "-S", "-m", "workflow.runtime.doctor"], tmp_path, clean_environment).returncode == 1


def test_doctor_names_a_bad_llvm(repository, clean_environment):
    result = run(
        [sys.executable, "-m", "workflow.runtime.doctor"],
        repository,
        clean_environment,
        **{native.LLVM_VARIABLE: "/nowhere.so"},
    )
    assert result.returncode == 1
    failed = [line for line in result.stdout.splitlines() if line.startswith("FAIL")]
    assert len(failed) == 1
    assert f"{native.LLVM_VARIABLE} names /nowhere.so, which does not exist; unset it" in failed[0]


def test_doctor_survives_and_names_an_abort():
    finding = doctor._tried("drjit", "import os, sys; sys.stderr.write('LLVM ERROR: Cannot select\\n'); os.abort()", "1", "")
    assert finding.level == "FAIL" and "SIGABRT (LLVM ERROR: Cannot select)" in finding.found


def test_doctor_names_a_wrong_result_and_a_missing_system_library():
    assert "computed '2' instead of '1'" in doctor._tried("x", "print(2)", "1", "").found
    hidden = "import sys; sys.exit('ImportError: libatomic.so.1: cannot open shared object file\\nNameError: _drjit_ext')"
    assert "libatomic.so.1 (Debian and Ubuntu: libgl1" in doctor._tried("drjit", hidden, "1", "").advice
    error = "raise ImportError('libGL.so.1: cannot open shared object file: No such file or directory')"
    assert "libGL.so.1 (Debian and Ubuntu: libgl1" in doctor._tried("x", error, "1", "").advice


def test_doctor_compares_packages_with_the_pins(tmp_path):
    pins = tmp_path / "requirements.in"
    pins.write_text("# comment\nnumpy==0.1\nno-such-package-here==1\ntorch\n")
    missing, differing = doctor.check_packages(pins)
    assert missing.level == "FAIL" and "no-such-package-here" in missing.found and "numpy" not in missing.found
    assert differing.level == "warn" and "instead of 0.1" in differing.found


def test_doctor_warns_where_kernels_cannot_be_kept(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("DRJIT_CACHE_DIR", "/proc/drjit")
    (finding,) = doctor.check_kernel_cache()
    assert finding.level == "warn" and "DRJIT_CACHE_DIR" in finding.advice
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path / "new" / "folder"))
    (finding,) = doctor.check_kernel_cache()
    assert finding.level == "ok" and not (tmp_path / "new").exists()


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
class TestMake:
    def commands(self, repository, environment, *arguments):
        result = run(["make", "-n", *arguments], repository, environment)
        assert result.returncode == 0, result.stderr
        return [" ".join(line.split()) for line in result.stdout.splitlines()]

    def test_scene(self, repository, clean_environment):
        assert self.commands(repository, clean_environment, "scenes/kitchen", "CORES=2") == [
            "bash envs/setup.sh",
            ".venv/bin/snakemake --cores 2 scenes/kitchen",
        ]

    def test_quality(self, repository, clean_environment):
        lines = self.commands(repository, clean_environment, "scenes/kitchen", "QUALITY=standard", "CORES=2")
        assert lines[1] == ".venv/bin/snakemake --cores 2 scenes/kitchen --config quality=standard"

    def test_a_scene_that_exists_is_still_given_to_snakemake(self, tmp_path, repository, clean_environment):
        shutil.copy(repository / "Makefile", tmp_path)
        (tmp_path / "scenes" / "kitchen").mkdir(parents=True)
        (tmp_path / "relight" / "kitchen").mkdir(parents=True)
        (tmp_path / "results" / "kitchen" / "capture").mkdir(parents=True)
        (tmp_path / "results/kitchen/capture/manifest.json").touch()
        for target in ("scenes/kitchen", "scenes", "relight/kitchen", "results/kitchen/capture/manifest.json"):
            assert any(f"snakemake --cores all {target}" in line for line in self.commands(tmp_path, clean_environment, target))

    @pytest.mark.parametrize("folder", ["relight", "results", "config", "workflow"])
    def test_a_folder_that_is_no_target_is_refused(self, tmp_path, repository, clean_environment, folder):
        shutil.copy(repository / "Makefile", tmp_path)
        (tmp_path / folder).mkdir()
        result = run(["make", folder], tmp_path, clean_environment)
        assert result.returncode == 2 and "Nothing to be done" not in result.stdout + result.stderr
        assert result.stderr.startswith(f"{folder}: ")

    @pytest.mark.parametrize(("target", "hint"), [("scene/kitchen", "scenes/kitchen"), ("kitchen", "make help")])
    def test_an_unknown_target_is_answered(self, repository, clean_environment, target, hint):
        result = run(["make", target], repository, clean_environment)
        assert result.returncode == 2 and result.stderr.startswith(f"{target}: ") and hint in result.stderr

    def test_suite_and_continuous_integration(self, repository, clean_environment):
        lines = self.commands(repository, clean_environment, "test")
        in_parallel = ".venv/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0"
        assert lines[0] == "bash envs/setup.sh" and lines[-1] == f'{in_parallel} -m "not long"'
        assert self.commands(repository, clean_environment, "test-all")[-1] == f"{in_parallel} -o faulthandler_timeout=0"
        assert {"make lint", "make test"} <= set((repository / ".ci" / "run").read_text().splitlines())

    def test_no_goal_prints_help_and_does_nothing(self, repository, clean_environment):
        result = run(["make"], repository, clean_environment)
        assert result.returncode == 0 and "make scenes/<name>" in result.stdout
