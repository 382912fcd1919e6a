"""Writes that survive a power cut, hashes, and the two data formats (EXR, Parquet) as plain dictionaries of arrays."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import shutil
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.intake.names import fault_of_name, shown

LONGEST = 220
"""Bytes of a name of a file that is written: the longest name of a view, what is added to it, and room for a temporary name."""
_DTYPES = {"float16": np.float16, "float32": np.float32, "uint32": np.uint32}


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


LARGEST_RECORD = 1 << 28
"""Bytes of a file of facts, such as a manifest or the stamps of a stage: far more than any that the workflow writes."""


def read_record(path: Path | str) -> bytes:
    """Return the content of a file of facts, which may have come with the results of somebody else.

    Raises:
        OSError: it cannot be read, is no regular file (a pipe would be waited for), or is larger than `LARGEST_RECORD`.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(handle, "rb") as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        if status.st_size > LARGEST_RECORD:
            raise OSError(errno.EFBIG, "too large for a file of facts", str(path))
        return file.read(LARGEST_RECORD + 1)


def facts_in(path: Path | str) -> dict[str, Any]:
    """Return the object that a JSON file of facts holds; an empty one if the file is not there, cannot be read or holds anything
    else. Never raises: it is for facts that a caller can do without, or that its own reader reports."""
    try:
        document = json.loads(read_record(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def fault_of(path: Path, facts: dict[str, Any], digest: Callable[[Path], str]) -> str:
    """Return what is wrong with a file that a manifest lists; empty if it is as it was written.

    Args:
        path: of the file.
        facts: what the manifest says of it.
        digest: returns the SHA-256 of a file, in hexadecimal.
    """
    try:
        if not path.is_file():
            return "missing"
        if (size := path.stat().st_size) != facts["bytes"]:
            return f"{size} bytes on disk, {facts['bytes']} were written"
        return "" if digest(path) == facts["sha256"] else "its content changed since it was written (sha256 differs)"
    except FileNotFoundError:  # a job that makes it again has removed it meanwhile
        return "missing"


def inside(folder: Path, name: str) -> Path:
    """Return `folder / name`, which must be a file below `folder`, also after symbolic links are followed.

    Raises:
        InputError: `name` is empty or absolute, has a part `..` or one that `fault_of_name` refuses, or leads through a link out
            of the folder.
    """
    parts = name.split("/")
    fault = next(filter(None, (fault_of_name(part, LONGEST) for part in parts)), "")
    if not fault and (folder / name).parent.resolve().is_relative_to(folder.resolve()):
        return folder / name
    inner = fault and name and not name.startswith("/") and ".." not in parts
    problem = f"a part of it {fault}" if inner else "it would leave this folder"
    raise InputError(f"{folder}: the file name {shown(name)}: {problem}; it is neither read nor written")


def is_inside(folder: Path, name: str) -> bool:
    """Return whether `inside` takes this name."""
    try:
        inside(folder, name)
    except InputError:
        return False
    return True


def write_atomically(path: Path, write: Callable[[Path], None], settled: bool = True, flushed: bool = True) -> None:
    """Call `write(temporary)` for a file next to `path`, flush it to disk and rename it to `path`. No reader sees half a file;
    after a power cut `path` has its old content or the new one.

    Args:
        path: of the file; folders that lack are made.
        write: writes the content to the path that it is given.
        settled: flush the folder as well, so that the new content is there after a power cut. A caller that writes many files
            flushes each folder once instead (`flush_folders`).
        flushed: flush the content. Without it the file may be empty or torn after a power cut, so its readers must do without it.

    Raises:
        OSError: with the name of the file, whatever part of the work failed.
    """
    with named(path):
        make_folder(path.parent, settled)
        temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
        if temporary.is_symlink():  # which would be written through
            temporary.unlink()
        try:
            write(temporary)
            if flushed:
                _flush(temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        if settled:
            flush_folder(path.parent)


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Add the name of a file to errors of the operating system that have none, such as those of writing and flushing."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def copy(source: Path, destination: Path) -> None:
    """Copy the content of a file as `write_atomically`; the caller flushes the folder."""
    write_atomically(destination, lambda temporary: _copy(source, temporary), settled=False)


def _copy(source: Path, temporary: Path) -> None:
    shutil.copyfile(source, temporary)


def _flush(path: Path) -> None:
    with open(path, "rb") as handle:
        os.fsync(handle.fileno())


def make_folder(folder: Path, settled: bool = True) -> None:
    """Make a folder and those above it that lack; if `settled`, they are there after a power cut."""
    lacking = [place for place in (folder, *folder.parents) if not place.exists()] if settled else []
    folder.mkdir(parents=True, exist_ok=True)
    for place in lacking:
        flush_folder(place.parent)


UNFLUSHED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EBADF)
"""What disks answer that cannot flush a folder, some of the network among them; their names are theirs to keep."""


def flush_folder(folder: Path) -> None:
    """Flush the names in a folder to disk: files that were made, renamed or removed in it stay so after a power cut."""
    with named(folder):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno not in UNFLUSHED:
                raise
        finally:
            os.close(handle)


def flush_folders(folder: Path) -> None:
    """Flush the names in a folder and in all below it, each once."""
    for place, _, _ in os.walk(folder, topdown=False):
        flush_folder(Path(place))


def remove(path: Path) -> None:
    """Remove a file, if it is there, so that it stays away after a power cut."""
    path.unlink(missing_ok=True)
    if path.parent.is_dir():
        flush_folder(path.parent)


def write_exr(
    path: Path, channels: dict[str, np.ndarray], attributes: dict[str, Any] | None = None, settled: bool = True
) -> dict[str, str]:
    """Write (H, W) arrays of float16, float32 or uint32 as one EXR, compressed without loss. Returns channel -> dtype.

    `attributes` go into its header: text, numbers, tuples, and (4, 4) float32 matrices for row vectors. `settled` is as
    in `write_atomically`.

    Raises:
        ValueError: shapes that differ, another dtype, or a value that is not finite.
    """
    import OpenEXR

    shapes = {a.shape for a in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"{path}: channels must share one (H, W) shape, found {sorted(shapes)}")
    for name, array in channels.items():
        if array.dtype.name not in _DTYPES:
            raise ValueError(f"{path}: channel {name} has dtype {array.dtype}; allowed: {', '.join(_DTYPES)}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{path}: channel {name} holds {np.size(array) - np.isfinite(array).sum()} non-finite values")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    data = {name: np.ascontiguousarray(array) for name, array in channels.items()}

    packed = io.BytesIO()  # OpenEXR tells nothing of an error of the disk when it writes the last part of a file
    with OpenEXR.File(header, data) as file:
        file.write(packed)

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as handle:
            handle.write(packed.getbuffer())

    write_atomically(path, write, settled)
    return {name: array.dtype.name for name, array in channels.items()}


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Return all channels of a single-part EXR as (H, W) arrays, with the names as stored."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def write_parquet(path: Path, columns: dict[str, Any], metadata: dict[str, str], settled: bool = True) -> dict[str, str]:
    """Write named columns; (n, k) arrays become fixed-size lists. Equal input gives equal bytes. Returns column -> type.

    `settled` is as in `write_atomically`.

    Raises:
        ValueError: columns of different length, or a value that is not finite.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays: dict[str, pa.Array] = {}
    for name, values in columns.items():
        array = np.asarray(values)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{path}: column {name} holds non-finite values")
        if array.ndim == 2:
            arrays[name] = pa.FixedSizeListArray.from_arrays(_arrow(array.ravel()), array.shape[1])
        else:
            arrays[name] = _arrow(array)
    lengths = {len(a) for a in arrays.values()}
    if len(lengths) > 1:
        raise ValueError(f"{path}: columns of different length { {k: len(a) for k, a in arrays.items()} }")
    table = pa.table(arrays).replace_schema_metadata({k: v for k, v in metadata.items()})

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as handle:
            pq.write_table(table, handle, row_group_size=1 << 20, **_encoding(table))

    write_atomically(path, write, settled)
    return {name: str(array.type) for name, array in arrays.items()}


def _encoding(table: Any) -> dict[str, Any]:
    """Return how columns are packed: floats byte by byte and without a dictionary of their values, which hardly ever repeat in
    tables of pixels and cells."""
    import pyarrow as pa

    leaves = {
        f"{name}.list.element" if pa.types.is_fixed_size_list(kind) else name: getattr(kind, "value_type", kind)
        for name, kind in zip(table.column_names, table.schema.types, strict=True)
    }
    floats = [leaf for leaf, kind in leaves.items() if pa.types.is_float32(kind) or pa.types.is_float64(kind)]
    rest = [leaf for leaf in leaves if leaf not in floats]
    return {"compression": "zstd", "use_dictionary": rest, "use_byte_stream_split": floats}


def read_parquet(path: Path, columns: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Return the columns of a table as numpy arrays; fixed-size lists become (n, k). Of `columns`, those there; None = all."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    out: dict[str, np.ndarray] = {}
    with pq.ParquetFile(path) as file:  # pq.read_table imports pyarrow.dataset, which takes longer than most tables
        table = file.read(None if columns is None else list(columns))
    for name in table.column_names:
        column = table[name].combine_chunks()
        if isinstance(column, pa.ChunkedArray):
            column = column.chunk(0) if column.num_chunks else pa.array([], column.type)
        if pa.types.is_fixed_size_list(column.type):
            out[name] = _values(column.flatten()).reshape(len(column), column.type.list_size)
        else:
            out[name] = _values(column)
    return out


def _arrow(values: np.ndarray) -> Any:
    """Return numbers, truth values or words (n,) as an Arrow array without nulls. `pa.array` imports pandas for that, a quarter
    of a second in every job."""
    import pyarrow as pa

    if values.dtype.kind in "UO":
        words = [str(value).encode() for value in values.tolist()]
        ends = np.cumsum([0, *map(len, words)]).astype(np.int32)
        return pa.Array.from_buffers(pa.string(), len(words), [None, pa.py_buffer(ends), pa.py_buffer(b"".join(words))])
    kind = pa.bool_() if values.dtype.kind == "b" else pa.from_numpy_dtype(values.dtype)
    data = np.packbits(values, bitorder="little") if values.dtype.kind == "b" else np.ascontiguousarray(values)
    return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(data)])


_ARROW_DTYPES = {"float": "float32", "double": "float64", "halffloat": "float16"}


def _values(column: Any) -> np.ndarray:
    """Return an Arrow array as a numpy array. `Array.to_numpy` imports pandas for that, a quarter of a second in every job."""
    kind = _ARROW_DTYPES.get(str(column.type), str(column.type))
    if column.null_count or not (kind == "bool" or np.dtype(kind if kind in np.sctypeDict else object).kind in "fiu"):
        return np.array(column.to_pylist(), object) if kind == "string" else column.to_numpy(zero_copy_only=False)
    data, end = column.buffers()[1], column.offset + len(column)
    if not len(column):
        return np.zeros(0, kind)
    if kind == "bool":
        bits = np.frombuffer(data, np.uint8, -(-end // 8))
        return np.unpackbits(bits, count=end, bitorder="little")[column.offset :].view(bool)
    return np.frombuffer(data, kind, end)[column.offset :]


def write_json(path: Path, document: Any, settled: bool = True, flushed: bool = True) -> None:
    """Write JSON with sorted keys. `settled` and `flushed` are those of `write_atomically`."""
    text = json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_atomically(path, lambda temporary: temporary.write_text(text), settled, flushed)
