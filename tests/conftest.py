"""Fixtures for all tests. Native libraries are prepared here, before any test module imports Mitsuba."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from types import SimpleNamespace

import pytest

import lab  # noqa: F401  registers its plug-in, also for the processes that tests start
from iif_core.errors import InputError
from tests import hanging
from tests.browser import browser, page_for  # noqa: F401  fixtures
from workflow.runtime import device, native

REPOSITORY = Path(__file__).resolve().parents[1]
THREADS = 2
# As in every job, before anything imports NumPy: threads that wait for one another make small matrices several times as slow.
os.environ[native.SMALL_MATRICES] = "1"
os.environ["PYTHONFAULTHANDLER"] = "1"  # a process that a test started tells where it hung

try:
    native.prepare()
    _llvm_problem = None
except InputError as error:  # only the tests that need LLVM shall fail
    _llvm_problem = str(error)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files with long tests first, so that both processes of pytest-xdist end at about the same time. One begins with the
    kitchen of the snapshot, and the other meanwhile makes the tiny scene that the rest of `tests/workflow` shares."""
    long = REPOSITORY / "tests/workflow"
    items.sort(key=lambda item: (long not in item.path.parents, item.path != long / "test_snapshot.py"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """End whatever a test waits for in vain; those marked `long`, and those of a cluster, may take their time."""
    if item.get_closest_marker("long") or REPOSITORY / "tests/slurm" in item.path.parents:
        return (yield)

    def end() -> None:
        def tell(processes: str) -> None:
            item.add_report_section("call", "hanging", f"after {hanging.LIMIT:.0f} s these are killed:\n{processes}")

        hanging.end_all(os.getpid(), tell)

    timer = threading.Timer(hanging.LIMIT, end)
    timer.daemon = True
    timer.start()
    drjit = sys.modules.get("drjit")  # with one thread, left by another test, Mitsuba waits for ever when it writes an EXR file
    if drjit and not _llvm_problem and drjit.thread_count() != THREADS:
        drjit.set_thread_count(THREADS)
    try:
        return (yield)
    finally:
        timer.cancel()


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def llvm():
    """Mitsuba with `llvm_ad_rgb` on two threads; the value is the `mitsuba` module. `IIF_TEST_DEVICE=cuda` has the tests that ask
    for it trace their rays on a CUDA device, with `cuda_ad_rgb`."""
    if _llvm_problem:
        pytest.fail(_llvm_problem, pytrace=False)
    device.use(os.environ.get("IIF_TEST_DEVICE", "cpu"))
    mitsuba = device.mitsuba()
    native.limit_threads(THREADS)
    return mitsuba


@pytest.fixture(scope="session")
def test_scene() -> Callable[[str], Path]:
    """`test_scene(name)`: folder of a scene from outside; skips where no place has it.

    Places: $IIF_TEST_SCENES alone if it is set, else data/, else the folders */scenes next to the checkout.
    """

    def find(name: str) -> Path:
        named = os.environ.get("IIF_TEST_SCENES")
        places = [Path(named)] if named else [REPOSITORY / "data", *sorted(REPOSITORY.parent.glob("*/scenes"))]
        for place in places:
            if (place / name).is_dir():
                return (place / name).resolve()
        pytest.skip(f"no scene {name} in {' or '.join(map(str, places))}; set IIF_TEST_SCENES")

    return find


@pytest.fixture
def clean_environment(tmp_path: Path) -> dict[str, str]:
    """Variables of a stranger who has just logged in (`env -i`): an empty HOME, pip's own configuration."""
    passed = {
        name: value
        for name, value in os.environ.items()
        if name.startswith("PIP_")
        or name in ("SSL_CERT_FILE", "SSL_CERT_DIR", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE")
        or name.lower() in ("http_proxy", "https_proxy", "no_proxy", "all_proxy")
    }
    home = tmp_path / "home"
    home.mkdir()
    configuration = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "pip" / "pip.conf"
    if configuration.is_file():
        passed.setdefault("PIP_CONFIG_FILE", str(configuration))
    return {**passed, "PATH": "/usr/bin:/bin", "HOME": str(home)}


@pytest.fixture(scope="session")
def T(llvm):
    """Public names of the modules of `iif_core.light.transport`, imported after Mitsuba's variant is set."""
    from iif_core.light.transport import cache, emitters, geometry, materials, matrix, render, scene, shading
    from tests.oracles import face_materials

    modules = (cache, emitters, face_materials, geometry, materials, matrix, render, scene, shading)
    return SimpleNamespace(**{name: value for module in modules for name, value in vars(module).items() if name[0] != "_"})
