"""Device, threads and denoiser of a process, chosen once at its entry."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import numpy as np

from lab.prior.photographs import Denoiser
from workflow.runtime import device, native

OIDN_FOLDER = "IIF_OIDN"
"""Environment variable: folder of libOpenImageDenoise with its CUDA device, for machines without the package of the product."""


def prepare(asked: str, threads: int) -> str:
    """Choose where rays are traced and how many threads a process uses.

    Args:
        asked: `cpu`, `cuda` or `auto`.
        threads: of numerical libraries and of Dr.Jit.

    Returns:
        `cpu` or `cuda`.

    Raises:
        InputError: no such device, or no LLVM.
    """
    kind = device.use(asked).kind
    if kind == "cpu":
        native.prepare()
    device.mitsuba()
    native.limit_threads(threads)
    return kind


def denoiser(kind: str) -> Denoiser:
    """Return the denoiser of the product on the CPU, and Intel Open Image Denoise on CUDA where IIF_OIDN names its libraries."""
    if folder := os.environ.get(OIDN_FOLDER):
        return LibraryDenoiser(Path(folder), cuda=kind == "cuda")
    from workflow.models.denoise import denoise, require_denoiser

    require_denoiser()
    return denoise


class LibraryDenoiser:
    """Intel Open Image Denoise through its C interface, on a CUDA device or on the CPU.

    Args:
        folder: where the shared libraries lie.
        cuda: the kind of device.

    Raises:
        RuntimeError: the library finds no such device.
    """

    _CPU, _CUDA = 1, 3  # OIDNDeviceType
    _FLOAT3 = 3  # OIDNFormat

    def __init__(self, folder: Path, cuda: bool):
        self.cuda = cuda
        self._lib = _declared(ctypes.CDLL(str(folder / "libOpenImageDenoise.so.2")))
        self._device = self._lib.oidnNewDevice(self._CUDA if cuda else self._CPU)
        if not self._device:
            raise RuntimeError(f"{folder}: Open Image Denoise finds no {'CUDA' if cuda else 'CPU'} device")
        self._lib.oidnCommitDevice(self._device)
        self._check()
        self._filter = self._lib.oidnNewFilter(self._device, b"RT")
        for switch in (b"hdr", b"cleanAux"):
            self._lib.oidnSetFilterBool(self._filter, switch, True)
        self._check()

    def __call__(self, radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Denoise a linear picture (H, W, 3), guided by noise-free albedo and normals."""
        import torch

        where = "cuda" if self.cuda else "cpu"
        images = [torch.as_tensor(np.ascontiguousarray(image, np.float32), device=where) for image in (radiance, albedo, normal)]
        images.append(torch.empty_like(images[0]))
        if self.cuda:
            torch.cuda.synchronize()
        height, width = radiance.shape[:2]
        for name, image in zip((b"color", b"albedo", b"normal", b"output"), images, strict=True):
            self._lib.oidnSetSharedFilterImage(self._filter, name, image.data_ptr(), self._FLOAT3, width, height, 0, 0, 0)
        self._lib.oidnCommitFilter(self._filter)
        self._lib.oidnExecuteFilter(self._filter)
        self._check()
        return np.maximum(images[-1].cpu().numpy(), 0)

    def _check(self) -> None:
        message = ctypes.c_char_p()
        if self._lib.oidnGetDeviceError(self._device, ctypes.byref(message)):
            raise RuntimeError(f"Open Image Denoise: {(message.value or b'').decode(errors='replace')}")


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    """Declare the functions that are used."""
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    declarations = {
        "oidnNewDevice": (pointer, [ctypes.c_int]),
        "oidnCommitDevice": (None, [pointer]),
        "oidnNewFilter": (pointer, [pointer, ctypes.c_char_p]),
        "oidnSetSharedFilterImage": (None, [pointer, ctypes.c_char_p, pointer, ctypes.c_int, *[size] * 5]),
        "oidnSetFilterBool": (None, [pointer, ctypes.c_char_p, ctypes.c_bool]),
        "oidnCommitFilter": (None, [pointer]),
        "oidnExecuteFilter": (None, [pointer]),
        "oidnGetDeviceError": (ctypes.c_int, [pointer, ctypes.POINTER(ctypes.c_char_p)]),
    }
    for name, (result, arguments) in declarations.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
