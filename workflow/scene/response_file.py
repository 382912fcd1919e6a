"""`affines.response: {file: ...}`: a measured camera response, which is checked before any job starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.response import Response, sampled_response
from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.arrays import read_npy
from workflow.intake.documents import check_file, read_text, reading
from workflow.settings.names import did_you_mean_path

COLUMNS = ("x", "R", "G", "B")
FALL = 1e-3
"""Share of the range by which a measured curve may fall because of noise or rounding; such falls are flattened."""


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the file that the settings of a scene name, if any, after reading it once to refuse an unusable one."""
    setting = document["affines"]["response"]
    if not isinstance(setting, dict):
        return []
    read_response_file(Path(setting["file"]))
    return [Path(setting["file"])]


def read_response_file(path: Path) -> Response:
    """Read a curve of three channels and scale it to f(0) = 0 and f(1) = 1.

    Raises:
        InputError: no such file, unknown kind, missing columns, values that are not finite, outside [0, 1] or falling,
            x that does not rise from 0 to 1.
    """
    if not path.is_file():
        hint = did_you_mean_path(path)
        raise InputError(f"affines.response.file: {path}: not found; a path counts from the folder that Snakemake runs in.{hint}")
    readers = {".csv": _csv, ".parquet": _parquet, ".npy": _npy}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: a response is .csv, .parquet (columns x, R, G, B) or .npy (3, samples)")
    check_file(path, limits.TABLE_BYTES, "a camera response")
    with reading(path, "cannot be read as a response"):
        x, y = readers[path.suffix.lower()](path)
    if len(x) < 2 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"{path}: {len(x)} samples; a response needs at least 2, all numbers finite")
    if abs(x[0]) > 1e-6 or abs(x[-1] - 1) > 1e-6 or (np.diff(x) <= 0).any():
        raise InputError(f"{path}: x runs from {x[0]:g} to {x[-1]:g}; it must rise from 0 to 1 (exposed radiance)")
    if y.min() < -1e-6 or y.max() > 1 + 1e-6:
        raise InputError(f"{path}: sensor values from {y.min():g} to {y.max():g}; allowed: 0 to 1 (divide 8-bit values by 255)")
    for name, curve in zip("RGB", y, strict=True):
        fall = float(np.max(np.maximum.accumulate(curve) - curve))
        if fall > FALL or curve[-1] - curve[0] < 0.5:
            raise InputError(
                f"{path}: channel {name} goes from {curve[0]:g} to {curve[-1]:g} and falls by up to {fall:.3g};"
                f" a response rises, by at least half of the range, and falls by no more than {FALL:g}"
            )
    x = x.copy()
    x[0], x[-1] = 0.0, 1.0
    return sampled_response(x, y)


def _columns(table: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    missing = [name for name in COLUMNS if name not in table]
    if missing:
        raise ValueError(f"columns {', '.join(map(str, table))}; needed {', '.join(COLUMNS)}")
    x, *y = (np.asarray(table[name], np.float64) for name in COLUMNS)
    if any(column.ndim != 1 for column in (x, *y)):
        raise ValueError("columns of lists; needed is one number a row")
    return x, np.stack(y)


def _csv(path: Path) -> tuple[np.ndarray, np.ndarray]:
    lines = [line.split(",") for line in read_text(path, limits.TABLE_BYTES).splitlines() if line.strip()]
    names = [name.strip() for name in lines[0]] if lines else []
    if any(len(line) != len(names) for line in lines):
        raise ValueError(f"lines of different length; the first has {len(names)} columns")
    return _columns(dict(zip(names, zip(*lines[1:], strict=True), strict=False)) if len(lines) > 1 else {})


def _parquet(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path) as file:
        rows, names = file.metadata.num_rows, file.schema_arrow.names
        if rows > limits.TABLE_ROWS:
            raise ValueError(f"{rows} rows; a response may have {limits.TABLE_ROWS}")
        if lists := [name for name in COLUMNS if name in names and file.schema_arrow.field(name).type.num_fields]:
            raise ValueError(f"column {lists[0]} holds lists; needed is one number a row")
        table = file.read(columns=[name for name in COLUMNS if name in names]).to_pydict()
    return _columns(table if len(table) == len(COLUMNS) else dict.fromkeys(names))


def _npy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    y = read_npy(path)
    if y.ndim != 2 or y.shape[0] != 3 or y.shape[1] > limits.TABLE_ROWS:
        raise ValueError(f"shape {y.shape}; needed (3, samples)")
    return np.linspace(0.0, 1.0, y.shape[1]), y.astype(np.float64)
