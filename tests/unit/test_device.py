"""Where rays are traced: what `device` means, and that both devices find the same light."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.errors import missing, refused
from workflow.runtime import device

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def restored():
    """The device of the test process and the driver that Dr.Jit shall load, which others rely on."""
    before, driver = device._used, os.environ.get(device.DRIVER[0])
    yield
    device._used = before
    os.environ.pop(device.DRIVER[0], None)
    if driver is not None:
        os.environ[device.DRIVER[0]] = driver


CASES = [("auto", [], "cpu"), ("auto", ["A100"], "cuda"), ("cpu", ["A100"], "cpu"), ("cuda", ["A100"], "cuda")]


@pytest.mark.parametrize(("asked", "found", "kind"), CASES)
def test_what_is_asked_and_what_is_there(monkeypatch, asked, found, kind):
    monkeypatch.setattr(device, "cuda_devices", lambda: found)
    monkeypatch.setattr(device, "has_optix", lambda: True)
    monkeypatch.delenv(device.DRIVER[0], raising=False)
    used = device.use(asked)
    assert os.environ.get(device.DRIVER[0]) == ("libcuda.so.1" if kind == "cuda" else None)
    assert (used.kind, used.variant) == (kind, device.VARIANTS[kind])
    assert used.facts() == {"asked": asked, "kind": kind, "name": "A100" if kind == "cuda" else ""}
    assert str(used) == ("cuda (A100)" if kind == "cuda" else "cpu")


def test_cuda_without_a_device_is_an_error(monkeypatch):
    monkeypatch.setattr(device, "cuda_devices", list)
    with refused("device", "cuda", "device: auto"):
        device.use("cuda")


def test_a_device_that_cannot_trace_rays(monkeypatch, caplog):
    """As in a container that has the driver's libraries for computing alone."""
    monkeypatch.setattr(device, "cuda_devices", lambda: ["A100"])
    monkeypatch.setenv(device.OPTIX[0], "/nowhere/libnvoptix.so.1")
    with refused("device", "cuda", "A100", "OptiX", "NVIDIA_DRIVER_CAPABILITIES=all"):
        device.use("cuda")
    assert device.use("auto").kind == "cpu" and not missing(caplog.text, "A100")
    caplog.clear()
    assert device.use("cpu").kind == "cpu" and not caplog.text


CHOOSERS = {"runtime/device.py", "runtime/doctor.py", "exporters/mitsuba_render.py"}
"""The last two are separate programs: a probe in a child process, and what is exported next to scene.xml."""


def test_nothing_else_chooses_a_variant():
    """A module that names one would take a job from its device, in the middle of it."""
    files = [path for folder in ("iif_core", "workflow") for path in (ROOT / folder).rglob("*.py")]
    found = {str(path.relative_to(ROOT / "workflow")) for path in files if "set_variant(" in path.read_text()}
    assert found == CHOOSERS


def test_no_driver_is_no_device(monkeypatch):
    def missing(_):
        raise OSError("libcuda.so.1: cannot open shared object file")

    monkeypatch.setattr(device.ctypes, "CDLL", missing)
    assert device.cuda_devices() == []


def test_a_variant_that_was_chosen_before_stays(llvm):
    """Also where a stage in the same process asks for another device, and where a study takes samples."""
    before = llvm.variant()
    device._used = device.Device("cuda", "cuda", "A100")
    assert device.mitsuba() is llvm and llvm.variant() == before


RENDER = """
import sys
import numpy as np
from workflow.runtime import device, native
native.prepare()
device.use(sys.argv[1])
device.mitsuba()
from types import SimpleNamespace
from iif_core.light.transport import cache, emitters, geometry, materials, render, scene
from tests.oracles import face_materials
from tests.unit.transport_rooms import Room
names = {}
for module in (cache, emitters, geometry, face_materials, render, scene):
    names |= vars(module)
T = SimpleNamespace(**{name: value for name, value in names.items() if name[0] != "_"})
room = Room(T)
world = T.Scene(room.geometry, room.material, room.emitters)
halves = [T.render(world, room.origin, room.directions, T.PathOptions(64, 6, seed)) for seed in range(2)]
np.save(sys.argv[2], np.stack(halves))
"""


@pytest.mark.skipif(not device.cuda_devices(), reason="no CUDA device")
def test_cpu_and_gpu_find_the_same_light(tmp_path):
    found = []
    for kind in ("cpu", "cuda"):
        subprocess.run([sys.executable, "-c", RENDER, kind, str(tmp_path / f"{kind}.npy")], cwd=ROOT, check=True)
        found.append(np.load(tmp_path / f"{kind}.npy"))
    noise = np.sqrt(((found[0][0] - found[0][1]) ** 2).sum((0, 1)) + ((found[1][0] - found[1][1]) ** 2).sum((0, 1)))
    away = (found[0].mean(0) - found[1].mean(0)).sum(0)
    assert (np.abs(away) < 4 * noise / 2).all(), (away, noise)
