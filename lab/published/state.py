"""How far a long descent has come, kept in the folder of its stage, so that a job that is killed continues from there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from workflow.artifacts.files import inside, write_atomically
from workflow.artifacts.store import UNFINISHED, StageWriter


def keep_state(writer: StageWriter, name: str, arrays: Mapping[str, np.ndarray], facts: Any) -> None:
    """Write down where a computation is; `StageWriter.finish` removes it."""
    document = json.dumps({"by": writer.provenance["fingerprint"], "facts": facts})

    def write(path: Path) -> None:
        with path.open("wb") as file:  # or NumPy would append .npz to the name
            np.savez(file, **{f"array.{key}": array for key, array in arrays.items()}, document=np.array(document))

    path = inside(writer.directory, f"{UNFINISHED}/{name}.npz")
    for left in path.parent.glob(f".{path.stem}.*"):  # by a job that was killed while it wrote
        left.unlink(missing_ok=True)
    write_atomically(path, write, settled=False)


def kept_state(writer: StageWriter, name: str) -> tuple[dict[str, np.ndarray], Any] | None:
    """Return arrays and facts of `keep_state`; None if there is nothing, or nothing that this job can continue from: it was
    written under another fingerprint, or is damaged."""
    try:
        with np.load(inside(writer.directory, f"{UNFINISHED}/{name}.npz"), allow_pickle=False) as kept:
            document = json.loads(str(kept["document"]))
            if document["by"] != writer.provenance["fingerprint"]:
                return None
            return {key.removeprefix("array."): kept[key] for key in kept.files if key != "document"}, document["facts"]
    except Exception:  # whatever zipfile and NumPy make of a damaged archive: the work begins again
        return None
