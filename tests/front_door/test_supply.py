"""What is installed is known: locks, builds of torch that are accepted, licences. Nothing is fetched from outside."""

import hashlib
import http.server
import importlib.util
import re
import shutil
import subprocess
import sys
import threading
import zipfile

import pytest

from tests.errors import missing, refused

LOCKS = ("requirements.lock", "torch.lock", "torch-cuda.lock", "requirements-cluster.txt", "docs.txt")


def locked(repository, lock):
    return re.findall(r"^([\w.-]+)==([^\s\\]+)", (repository / "envs" / lock).read_text(), re.M)


def test_every_lock_has_hashes_and_they_fit_together(repository):
    """Each package of each lock; torch for every Python that is supported; one version wherever two locks name a package."""
    versions = {}
    for lock in LOCKS:
        for block in re.split(r"^(?=[A-Za-z0-9])", (repository / "envs" / lock).read_text(), flags=re.M)[1:]:
            name, version = re.match(r"([\w.-]+)==([^\s\\]+)", block).groups()
            assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", block), (lock, name)
            if lock != "docs.txt":  # it has its own environment
                assert versions.setdefault(name, version) == version, (lock, name)
    assert f"torch=={versions['torch']}\n" in (repository / "envs/requirements.in").read_text()
    text = (repository / "envs/torch.lock").read_text()
    builds = dict(re.findall(r"^#   ([0-9a-f]{64}) +\d+ +\d+ (\S+)$", text, re.M))
    assert set(builds) == set(re.findall(r"--hash=sha256:(\w+)", text))
    for python in ("cp311", "cp312", "cp313", "cp314"):
        assert f"torch-{versions['torch']}-{python}-{python}-manylinux_2_28_x86_64.whl" in builds.values()
    sizes = [row.split("\t") for row in (repository / "envs/sizes.tsv").read_text().splitlines()[2:]]
    assert {lock: int(count) for lock, count, *_ in sizes} == {
        lock: len(locked(repository, lock)) for lock in ("requirements.lock", "torch-cuda.lock")
    }


def test_pins_are_in_their_locks(repository):
    for pins, lock in (("requirements.in", LOCKS[0]), ("requirements-cluster.in", LOCKS[3]), ("docs.in", LOCKS[4])):
        found = dict(locked(repository, lock)) | dict(locked(repository, "torch.lock"))
        for name, version in locked(repository, pins):
            assert found[re.sub(r"[-_.]+", "-", name).lower()] == version, (pins, name)


def test_licences_of_every_locked_package_are_listed(repository):
    """With its version; and what lies in the repository is the file that the page means."""
    page = (repository / "envs/licences.md").read_text()
    rows = re.findall(r"^\| ([\w.-]+) \| (\d[^|]*) \| ([^|]+) \| (\w+) \|$", page, re.M)
    wanted = {(name, version) for lock in LOCKS for name, version in locked(repository, lock)}
    assert {(name, version) for name, version, _, _ in rows} == wanted
    assert all(text.strip() for _, _, text, _ in rows)
    noted = set(re.findall(r"^\| ([\w.-]+) \| [^|]+ \| \w+ \|$", page, re.M))
    for name, _, text, _ in rows:
        if re.search(r"GPL|MPL|Mozilla|Proprietary|LicenseRef", text):
            assert name in noted, f"{name}: {text}"
    files = re.findall(r"`([^`]+)` `([0-9a-f]{64})`", page)
    assert len(files) == 2
    for file, digest in files:
        assert hashlib.sha256((repository / file).read_bytes()).hexdigest() == digest


@pytest.mark.long
def test_the_image_is_built_and_works(repository, tmp_path):
    result = subprocess.run(
        ["bash", "envs/image-check.sh", tmp_path], cwd=repository, capture_output=True, text=True, timeout=7200
    )
    last = result.stderr.strip().splitlines()[-1]
    if result.returncode == 77:
        pytest.skip(last)
    assert result.returncode == 0 and last.startswith("image-check: ok: "), result.stdout[-2000:] + result.stderr[-2000:]


def test_an_image_check_that_cannot_be_says_why(repository, tmp_path, clean_environment):
    """Engines that reach no registry count as none, so CI continues."""
    for engine in ("docker", "podman"):
        (tmp_path / engine).write_text("#!/bin/sh\nexit 1\n")
        (tmp_path / engine).chmod(0o755)
    environment = {**clean_environment, "PATH": f"{tmp_path}:{clean_environment['PATH']}"}
    command = ["bash", "envs/image-check.sh", "--engine"]
    result = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, timeout=60)
    assert result.returncode == 77 and not missing(result.stderr, "Docker", "Podman")


@pytest.fixture
def lock(repository, tmp_path):
    """envs/lock.py, at work in a copy of envs/."""
    shutil.copytree(repository / "envs", tmp_path / "envs")
    specification = importlib.util.spec_from_file_location("lock_of_envs", tmp_path / "envs/lock.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module  # dataclasses look there
    specification.loader.exec_module(module)
    yield module
    del sys.modules[specification.name]


@pytest.fixture
def torch_wheel(tmp_path, lock):
    """A folder with a build of the pinned torch that no lock lists, and one of another version."""
    folder = tmp_path / "torch"
    folder.mkdir()
    name = f"torch-{lock.pinned_torch()}+cu999-cp312-cp312-manylinux_2_28_x86_64.whl"
    with zipfile.ZipFile(folder / name, "w", zipfile.ZIP_DEFLATED) as wheel:
        wheel.writestr("torch/weights", bytes(300_000))
    shutil.copy(folder / name, folder / "torch-0.1-cp312-cp312-manylinux_2_28_x86_64.whl")
    return folder / name


def added(lock, before):
    after = (lock.HERE / "torch.lock").read_text()
    assert {build.name for build in before} < {build.name for build in lock.read_builds()}
    (new,) = set(lock.read_builds()) - set(before)
    assert f"--hash=sha256:{new.sha256}" in after
    return new


def test_a_folder_of_wheels_adds_builds_of_torch(lock, torch_wheel):
    before = lock.read_builds()
    lock.add_builds(str(torch_wheel.parent))
    new = added(lock, before)
    assert (new.name, new.size, new.unpacked) == (torch_wheel.name, torch_wheel.stat().st_size, 300_000)
    assert new.sha256 == hashlib.sha256(torch_wheel.read_bytes()).hexdigest()


@pytest.mark.parametrize("published", [True, False])
def test_an_index_adds_the_hashes_that_it_publishes(lock, torch_wheel, published):
    """As PyTorch's index: a page of links, `+` escaped; sizes come from the end of the wheel. Without hashes it is refused."""
    data = torch_wheel.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    fragment = f"#sha256={digest}" if published else ""
    page = f'<html><a href="/files/{torch_wheel.name.replace("+", "%2B")}{fragment}">x</a><a href="torch-0.1.whl">y</a></html>'

    class Index(http.server.BaseHTTPRequestHandler):
        def do_HEAD(self, body=b"", status=200, kind="application/zip"):
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body or data)))
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self):
            if self.path == "/whl/torch/":
                return self.do_HEAD(page.encode(), kind="text/html")
            first, last = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"]).groups())
            return self.do_HEAD(data[first : last + 1], 206)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Index) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        before = lock.read_builds()
        address = f"http://127.0.0.1:{server.server_port}/whl"
        try:
            if published:
                lock.add_builds(address)
                new = added(lock, before)
                assert (new.name, new.sha256, new.size, new.unpacked) == (torch_wheel.name, digest, len(data), 300_000)
            else:
                with refused(address, "SHA-256", torch_wheel.name, kind=SystemExit):
                    lock.add_builds(address)
                assert lock.read_builds() == before
        finally:
            server.shutdown()
