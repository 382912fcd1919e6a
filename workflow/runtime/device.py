"""Where light transport runs: on the CPU (Dr.Jit through LLVM) or on a CUDA device.

The device is chosen once for a process, at its entry (`use`), and every part that traces rays asks for it (`mitsuba`). It is no
part of fingerprints, because the results are the same numbers up to rounding and random choices.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
from dataclasses import asdict, dataclass
from types import ModuleType

from iif_core.errors import InputError

VARIANTS = {"cpu": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
DRIVER = ("DRJIT_LIBCUDA_PATH", "libcuda.so.1")
OPTIX = ("DRJIT_LIBOPTIX_PATH", "libnvoptix.so.1")
"""Libraries of NVIDIA's driver: the variable that names each to Dr.Jit, and its name where the variable is not set. Rays are
traced with OptiX, which containers leave out unless they are asked for the driver's graphics libraries."""


@dataclass(frozen=True)
class Device:
    """The device of this process: what was `asked` for (`auto`, `cpu` or `cuda`), the `kind` that is used (`cpu` or `cuda`), and
    the `name` of the CUDA device."""

    asked: str
    kind: str
    name: str = ""

    @property
    def variant(self) -> str:
        """Name of Mitsuba's variant."""
        return VARIANTS[self.kind]

    def facts(self) -> dict[str, str]:
        """Return what a manifest records."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.kind} ({self.name})" if self.name else self.kind


_used = Device("cpu", "cpu")


def use(asked: str) -> Device:
    """Choose the device of this process.

    Args:
        asked: `auto`: a CUDA device where there is one that can trace rays; `cpu`; `cuda`.

    Raises:
        InputError: `cuda`, and the driver finds no device or has no OptiX; there is no silent fall-back.
    """
    global _used
    names = cuda_devices() if asked != "cpu" else []
    if asked == "cuda" and not names:
        raise InputError(
            "device: found cuda, but this machine has no CUDA device, or no driver for it (libcuda.so.1); set `device: auto` or"
            " `device: cpu`, or run on another machine"
        )
    if names and not has_optix():
        lacking = f"{names[0]} cannot trace rays, because its driver has no OptiX (libnvoptix.so.1)"
        advice = "in a container, ask for all libraries of the driver with NVIDIA_DRIVER_CAPABILITIES=all"
        if asked == "cuda":
            raise InputError(f"device: found cuda, but {lacking}; {advice}, or set `device: auto` or `device: cpu`")
        logging.getLogger("device").warning("%s; rays are traced on the CPU. Otherwise, %s", lacking, advice)
        names = []
    if names:
        # Dr.Jit looks for libcuda.so, which is there for developers alone; it shall load what was found here.
        os.environ.setdefault(*DRIVER)
    _used = Device(asked, "cuda", names[0]) if names else Device(asked, "cpu")
    return _used


def mitsuba() -> ModuleType:
    """Return Mitsuba with the variant of the device, unless this process has chosen another variant that works on RGB arrays."""
    module = importlib.import_module("mitsuba")
    if not (module.variant() or "").startswith(tuple(VARIANTS.values())):
        module.set_variant(_used.variant)
    return module


def cuda_devices() -> list[str]:
    """Return the names of the CUDA devices that the driver shows to this process; empty without a driver."""
    driver = _loaded(*DRIVER)
    if driver is None:
        return []
    count = ctypes.c_int()
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return []
    names = []
    for number in range(count.value):
        device, name = ctypes.c_int(), ctypes.create_string_buffer(128)
        driver.cuDeviceGet(ctypes.byref(device), number)
        driver.cuDeviceGetName(name, len(name), device)
        names.append(name.value.decode(errors="replace"))
    return names


def has_optix() -> bool:
    """Tell whether the driver has the library with which rays are traced."""
    return _loaded(*OPTIX) is not None


def _loaded(variable: str, name: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(os.environ.get(variable) or name)
    except OSError:
        return None
