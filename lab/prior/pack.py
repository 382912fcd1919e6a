"""Everything that training needs on a GPU machine without a network, in one folder of less than 64 MiB.

Mitsuba and Dr.Jit are cut down to what path tracing on CUDA loads, and Open Image Denoise to its CUDA device and the weights for
HDR pictures with clean guides. torch, numpy, scipy, numba, Pillow and safetensors must be there. `run.sh` unpacks the folder once
on a machine and calls `python3 -m lab.prior train`.
"""

from __future__ import annotations

import io
import lzma
import shutil
import struct
import tarfile
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

from iif_core.errors import InputError
from lab.prior import assets as assets_of

REPOSITORY = Path(__file__).parents[2]
MOST = 64 * 2**20
"""Bytes of the folder at most."""
PACKAGES = ("iif_core", "workflow", "lab")
_PLUGINS = ("diffuse", "uniform", "perspective", "hdrfilm", "independent", "gaussian", "box", "path", "srgb", "d65", "rgb")
_NOT_LOADED = ("include/", "cmake/", "pkgconfig/", "mitsuba_stubs/", "data/")
_OTHER_VARIANTS = ("llvm_ad_", "scalar_spectral", "cuda_ad_mono", "cuda_ad_spectral")
_CORE = "libOpenImageDenoise_core.so.*.*.*"
_OIDN = ("libOpenImageDenoise.so.2", _CORE, "libOpenImageDenoise_device_cuda.so.*.*.*")
_WEIGHTS, _USED_WEIGHTS = "blobs7weights", "rt_hdr_calb_cnrm"
"""In the names of symbols: weights of the denoiser, and those that are used."""


def pack(target: Path, wheels: Path, assets: Path | None, init: Path | None) -> int:
    """Write the folder.

    Args:
        target: folder that is written anew.
        wheels: folder with wheels of mitsuba and drjit for the Python of the GPU machine.
        assets: textures and skies, or None.
        init: weights to start from, or None.

    Returns:
        Bytes of the folder.

    Raises:
        InputError: a wheel or the denoiser is missing, or the folder would be too large.
    """
    found = {name: sorted(wheels.glob(f"{name}-*.whl")) for name in ("mitsuba", "drjit")}
    if missing := [name for name, files in found.items() if len(files) != 1]:
        raise InputError(f"pack: {wheels} must hold one wheel each of mitsuba and drjit; look at {', '.join(missing)}")
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    _write(target / "site.tar.xz", lambda tar: [_add_wheel(tar, files[0]) for files in found.values()])
    _write(target / "oidn.tar.xz", _add_denoiser)
    _write(target / "code.tar.xz", _add_code)
    if assets:
        assets_of.load(assets).save(target / "assets.npz")
    if init:
        shutil.copy(init, target / "init.safetensors")
    shutil.copy(Path(__file__).with_name("run.sh"), target / "run.sh")
    size = sum(path.stat().st_size for path in target.iterdir())
    if size > MOST:
        raise InputError(
            f"pack: {target} has {size / 2**20:.1f} MiB; at most {MOST / 2**20:.0f} are allowed: leave out --init or --assets"
        )
    return size


def _write(path: Path, fill: Callable[[tarfile.TarFile], object]) -> None:
    with lzma.open(path, "wb", preset=6) as compressed, tarfile.open(fileobj=compressed, mode="w") as tar:
        fill(tar)


def is_loaded(name: str) -> bool:
    """Tell whether path tracing on CUDA loads a file of the wheel of mitsuba or drjit."""
    package, _, inside = name.partition("/")
    if package not in ("mitsuba", "drjit") or not inside or inside.startswith(_NOT_LOADED) or inside.endswith(".pyi"):
        return False
    if package == "drjit":
        return True
    if inside == "mitsuba" or inside.startswith(_OTHER_VARIANTS):  # the program of that name, and variants
        return False
    return not inside.startswith("plugins/") or Path(inside).stem.removeprefix("lib") in _PLUGINS


def _add_wheel(tar: tarfile.TarFile, wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        for entry in file.infolist():
            if not entry.is_dir() and is_loaded(entry.filename):
                own = tarfile.TarInfo(entry.filename)
                own.size, own.mode = entry.file_size, 0o755
                tar.addfile(own, file.open(entry))


def _add_denoiser(tar: tarfile.TarFile) -> None:
    from importlib.util import find_spec

    spec = find_spec("pyoidn")
    if spec is None or not spec.submodule_search_locations:
        raise InputError("pack: the package pyoidn (Intel Open Image Denoise) is missing; run `bash envs/setup.sh`")
    folder = Path(spec.submodule_search_locations[0]) / "oidn" / "lib"
    for pattern in _OIDN:
        files = sorted(folder.glob(pattern))
        if len(files) != 1:
            raise InputError(f"pack: {len(files)} files {pattern} in {folder}; one is needed")
        data = files[0].read_bytes()
        data = without_other_weights(data) if pattern == _CORE else data
        entry = tarfile.TarInfo(files[0].name)
        entry.size, entry.mode = len(data), 0o755
        tar.addfile(entry, io.BytesIO(data))


def without_other_weights(library: bytes) -> bytes:
    """Blank the weights in the denoiser's library (64-bit ELF) that are for other kinds of pictures; they do not compress.

    Raises:
        InputError: the library has no symbols of weights, or none of those that are used.
    """
    out = bytearray(library)
    table, count = struct.unpack_from("<Q", library, 0x28)[0], struct.unpack_from("<H", library, 0x3C)[0]
    # Of a section header: type, address, offset, size, link; of a symbol: name, section, value, size.
    sections = [struct.unpack_from("<4xI8xQQQI", library, table + 64 * i) for i in range(count)]
    kept = 0
    for kind, _, offset, size, link in sections:
        if kind != 2:  # SHT_SYMTAB
            continue
        names = sections[link][2]
        for at in range(offset, offset + size, 24):
            name_at, section, value, length = struct.unpack_from("<IxxHQQ", library, at)
            name = library[names + name_at : library.index(b"\0", names + name_at)].decode()
            if _WEIGHTS in name and _USED_WEIGHTS in name:
                kept += 1
            elif _WEIGHTS in name:
                start = value - sections[section][1] + sections[section][2]
                out[start : start + length] = bytes(length)
    if not kept:
        raise InputError(f"pack: the denoiser has no weights named {_USED_WEIGHTS}; another release? Adapt lab/prior/pack.py")
    return bytes(out)


def _add_code(tar: tarfile.TarFile) -> None:
    """Add the modules of all packages, and the tables that they read."""
    for path in _sources(REPOSITORY / package for package in PACKAGES):
        tar.add(path, str(path.relative_to(REPOSITORY)))


def _sources(folders: Iterable[Path]) -> list[Path]:
    return sorted(path for folder in folders for path in folder.rglob("*") if path.suffix in (".py", ".csv") and path.is_file())
