"""Arrays of NumPy from files of strangers: the size that the header states is compared with the file before it is allocated."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import check_file, reading


def read_npy(path: Path) -> np.ndarray:
    """Return the numbers of a .npy file.

    Raises:
        InputError: no .npy file (an .npz of this name?), objects, cut short, or larger than `limits.ARRAY_BYTES`.
    """
    size = check_file(path, limits.ARRAY_BYTES, "an array of NumPy (.npy)")
    with path.open("rb") as file:
        start = file.read(6)
        if start[:4] == b"PK\x03\x04":
            raise InputError(f"{path}: an .npz archive under the name of an .npy file; save one array with `np.save`")
        if start != b"\x93NUMPY":
            raise InputError(f"{path}: not a readable array (no .npy file); save it with `np.save`")
        version, length = file.read(2), int.from_bytes(file.read(4), "little")
        if version[:1] != b"\x01" and length > size:  # NumPy would ask for as much memory; version 1 has two bytes for it
            raise InputError(f"{path}: cut short ({size} bytes; its header announces that it has {length} itself)")
        file.seek(0)
        with reading(path, "not a readable array"):
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
        needed = math.prod(shape) * dtype.itemsize
        if dtype.kind not in "biuf":
            raise InputError(f"{path}: holds {dtype}; expected numbers")
        if any(length < 0 for length in shape) or needed > size - file.tell():
            raise InputError(f"{path}: cut short ({size} bytes; its header announces an array of shape {shape})")
    with reading(path, "not a readable array"):
        return np.load(path, allow_pickle=False)
