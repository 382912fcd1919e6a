"""Which LLVM is taken and which is refused; threads and environment of child processes.

Libraries are made up as files: only their names and what `_ask_version` hears from them count. The real
ones of this machine are asked at the end.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.errors import named, refused
from workflow.runtime import native


@pytest.fixture
def library(tmp_path, monkeypatch):
    """`library("lib/libLLVM.so.19.1", 19)` makes a file that answers 19; None: it cannot be loaded."""
    answers = {}

    def ask(path, _mtime, _size):
        answer = answers[os.path.realpath(path)]
        return (0, "file too short") if answer is None else (answer, None)

    def make(name, answer):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        answers[os.path.realpath(path)] = answer if answer is None or answer >= native.OLDEST_LLVM else 0
        return str(path)

    monkeypatch.setattr(native, "_ask_version", ask)
    return make


def find(tmp_path, *folders, variable=None):
    environment = {} if variable is None else {native.LLVM_VARIABLE: variable}
    return native.find_llvm(environment, [str(tmp_path / folder) for folder in folders])


def test_the_first_folder_wins(tmp_path, library):
    own = library("own/libLLVM.so", 19)
    library("base/libLLVM.so", 21)
    report = find(tmp_path, "own", "base")
    assert (report.path, report.version, report.problem) == (own, 19, None)


def test_a_link_is_followed(tmp_path, library):
    real = library("own/libLLVM.so.19.1", 19)
    os.symlink("libLLVM.so.19.1", tmp_path / "own/libLLVM.so")
    assert find(tmp_path, "own").path == real


def test_only_old_ones_are_named_with_what_to_do(tmp_path, library):
    old = [library("own/libLLVM.so", 15), library("base/libLLVM.so", 14)]
    report = find(tmp_path, "own", "base")
    assert report.path is None and report.version == 0
    assert "\n" not in report.problem
    for text in (*old, "older than 16", "needs LLVM 16", "bash envs/setup.sh", native.LLVM_VARIABLE):
        assert text in report.problem


def test_none_at_all(tmp_path):
    report = find(tmp_path, "empty")
    named(report.problem, "LLVM", "bash envs/setup.sh")


def test_one_that_cannot_be_loaded_is_passed_over(tmp_path, library):
    library("own/libLLVM.so", None)
    good = library("base/libLLVM.so", 17)
    assert find(tmp_path, "own", "base").path == good
    os.remove(good)
    assert "file too short" in find(tmp_path, "own", "base").problem


def test_variable_wins_when_usable(tmp_path, library):
    library("own/libLLVM.so", 19)
    chosen = library("elsewhere/libLLVM.so.18.1", 18)
    assert find(tmp_path, "own", variable=chosen).path == chosen
    assert find(tmp_path, "own", variable="").version == 19


@pytest.mark.parametrize(
    ("name", "answer", "reason"),
    [
        ("gone/libLLVM.so.19", "absent", "does not exist"),
        ("old/libLLVM-14.so.1", 14, "LLVM older than 16"),
        ("broken/libLLVM.so.19", None, "cannot be loaded"),
        (".", "absent", "is not a file"),
    ],
)
def test_variable_that_names_an_unusable_library_is_a_problem(tmp_path, library, name, answer, reason):
    """Even where another library would do: child processes inherit the variable."""
    library("own/libLLVM.so", 19)
    path = os.path.abspath(tmp_path / name) if answer == "absent" else library(name, answer)
    report = find(tmp_path, "own", variable=path)
    assert report.path is None
    for text in (native.LLVM_VARIABLE, path, reason, "LLVM 16 or newer"):
        assert text in report.problem


def test_relative_variable_becomes_absolute(tmp_path, library, monkeypatch):
    """Jobs run in other folders."""
    path = library("own/libLLVM.so.19.1", 19)
    monkeypatch.chdir(tmp_path)
    assert find(tmp_path, variable="own/libLLVM.so.19.1").path == path


def test_prepare_sets_the_variable_and_is_idempotent(monkeypatch):
    monkeypatch.setenv(native.LLVM_VARIABLE, os.environ.get(native.LLVM_VARIABLE, ""))
    first = native.prepare()
    assert os.environ[native.LLVM_VARIABLE] == first.path
    assert native.prepare() == first
    assert native.load_libusb()


def test_prepare_raises_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv(native.LLVM_VARIABLE, str(tmp_path / "libLLVM.so.19"))
    with refused(native.LLVM_VARIABLE, tmp_path / "libLLVM.so.19"):
        native.prepare()
    assert os.environ[native.LLVM_VARIABLE] == str(tmp_path / "libLLVM.so.19")


def python(code, repository, **environment):
    command = [sys.executable, "-c", code]
    variables = {"PATH": "/usr/bin:/bin", **environment}
    return subprocess.run(command, cwd=repository, env=variables, capture_output=True, text=True)


def test_prepare_after_drjit_is_refused(repository):
    child = python(
        f"import os\nos.environ.pop({native.LLVM_VARIABLE!r}, None)\nimport drjit\n"  # the environment sets it at every start
        "from workflow.runtime import native\nnative.prepare()",
        repository,
    )
    assert child.returncode == 1
    named(child.stderr.splitlines()[-1], "RuntimeError", "drjit", "prepare()")


def test_import_has_no_effect(repository):
    code = (
        "import os, sys; before = dict(os.environ)\n"
        "from workflow.runtime import native\n"
        "assert dict(os.environ) == before\n"
        "third_party = {'numpy', 'torch', 'drjit', 'mitsuba', 'open3d'} & set(sys.modules)\n"
        "assert not third_party, third_party"
    )
    assert python(code, repository).stderr == ""


def test_process_environment_of_an_empty_environment(repository):
    code = (
        "import os, subprocess, sys\n"
        "from workflow.runtime import native\n"
        "native.process_environment(); once = dict(os.environ); native.process_environment()\n"
        "assert dict(os.environ) == once\n"
        "os.chdir('/')\n"
        "print(subprocess.check_output(['python', '-c', 'import sys, os, workflow.runtime.native, numpy;'\n"
        '      \'print(sys.prefix, os.environ["PATH"], os.environ.get("HOME"), sep=chr(10))\'], text=True))'
    )
    child = python(code, repository, PATH=f"/usr/bin:{Path(sys.executable).parent}:/bin")
    prefix, path, home = child.stdout.splitlines()[:3]
    assert prefix == sys.prefix
    assert path.split(os.pathsep) == [str(Path(sys.executable).parent), "/usr/bin", "/bin"]
    assert os.path.isabs(home)


@pytest.mark.long
def test_limit_threads_reaches_libraries_imported_before_and_after(repository):
    code = (
        "import os, torch\n"
        "from workflow.runtime import native\n"
        "native.prepare(); native.limit_threads(1)\n"
        "import mitsuba, drjit, pyarrow\n"
        "mitsuba.set_variant('llvm_ad_rgb')\n"
        "counts = [torch.get_num_threads(), drjit.thread_count(), pyarrow.cpu_count()]\n"
        "print(os.environ['OMP_NUM_THREADS'], end=' ')\n"
        "native.limit_threads(3)\n"
        "print(counts, torch.get_num_threads(), drjit.thread_count(), pyarrow.cpu_count(), os.environ['OPENBLAS_NUM_THREADS'])"
    )
    assert python(code, repository).stdout.strip() == "1 [1, 1, 1] 3 3 3 1"


def test_limit_threads_refuses_none():
    with refused("threads", 0, 1):
        native.limit_threads(0)


def test_this_environment_has_its_own_llvm():
    """The wheel of the lock is found without help, and it is what it says."""
    report = native.find_llvm({})
    assert report.problem is None and report.version >= native.OLDEST_LLVM
    assert Path(report.path).is_relative_to(Path(sys.prefix).resolve())


SCENE = """<scene version="3.0.0"><integrator type="direct"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/></film></sensor>
<shape type="sphere"><point name="center" x="0" y="0" z="4"/></shape><emitter type="constant"/></scene>"""


def test_the_command_of_mitsuba_finds_the_llvm_of_this_environment(repository, tmp_path):
    """`mitsuba -m llvm_ad_rgb` without a variable: every Python of the environment names the library.
    Without it Dr.Jit takes the system's LLVM, and aborts where that is older than 16."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "site").mkdir()
    shutil.copy(repository / "envs/iif_llvm.pth", tmp_path / "site")
    code = (
        "import site, sys, os; site.addsitedir(sys.argv.pop(1)); print(os.environ['DRJIT_LIBLLVM_PATH'], flush=True)\n"
        "from mitsuba.cli import _main; sys.exit(_main())"
    )
    environment = {name: value for name, value in os.environ.items() if name != native.LLVM_VARIABLE}
    arguments = [str(tmp_path / "site"), "-m", "llvm_ad_rgb", "-o", str(tmp_path / "out.exr"), str(tmp_path / "scene.xml")]
    command = [sys.executable, "-c", code, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert result.returncode == 0, result.stderr[-2000:]
    assert Path(result.stdout.splitlines()[0]).resolve().is_relative_to(Path(sys.prefix).resolve())
    assert (tmp_path / "out.exr").stat().st_size > 0


def test_a_variable_that_is_set_is_kept(repository, tmp_path):
    code = (repository / "envs/iif_llvm.pth").read_text() + "print(os.environ['DRJIT_LIBLLVM_PATH'])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={native.LLVM_VARIABLE: "/mine.so"})
    assert result.stdout.strip() == "/mine.so"
    assert len((repository / "envs/iif_llvm.pth").read_text().strip().splitlines()) == 1  # Python runs single lines alone
