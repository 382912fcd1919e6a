"""Files of the study of stability: a table for each part, all of them together, and what is kept in the documentation."""

from __future__ import annotations

import platform
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING

from iif_core.errors import InputError
from lab.stability import page, picture
from lab.stability.rows import COLUMNS, PARTS, measure
from workflow.artifacts.files import write_atomically
from workflow.report.blocks import fill
from workflow.runtime import fingerprint as fp
from workflow.settings.names import REPOSITORY, did_you_mean

if TYPE_CHECKING:
    import pandas as pd

PARTIAL = Path("results/studies/stability")
TABLE = Path("results/studies/stability.parquet")
KEPT = REPOSITORY / "lab/notebook/data/stability.csv"
PAGE = REPOSITORY / "lab/notebook/stability.md"


def code() -> str:
    """Return a digest of everything that the study measures, and measures with."""
    own = fp.modules_of("lab.stability")
    return fp.modules_digest(sorted({*own, *fp.import_closure(*own)}))


def write_part(part: str) -> None:
    """Measure a part and write results/studies/stability/<part>.parquet; its first row says where and how long.

    Raises:
        InputError: no such part.
    """
    import pandas as pd

    if part not in PARTS:
        raise InputError(f"stability {part}: no such part.{did_you_mean(part, list(PARTS))} There are {', '.join(PARTS)}")
    start = time.monotonic()
    frame = measure(part)
    seconds = time.monotonic() - start
    about = ("measured", part, _commit(), _machine(), "seconds", seconds, float("nan"), True, "")
    whole = pd.concat([pd.DataFrame([about], columns=list(COLUMNS)), frame], ignore_index=True)
    write_atomically(PARTIAL / f"{part}.parquet", lambda path: whole.to_parquet(path, index=False))


def collect() -> None:
    """Write results/studies/stability.parquet and .md from the parts.

    Raises:
        InputError: a part was not measured.
    """
    import pandas as pd

    missing = [part for part in PARTS if not (PARTIAL / f"{part}.parquet").is_file()]
    if missing:
        again = f"snakemake -s lab/Snakefile --cores 2 {TABLE}"
        raise InputError(f"{PARTIAL}: without {', '.join(missing)}; `{again}` measures every part")
    frame = pd.concat([pd.read_parquet(PARTIAL / f"{part}.parquet") for part in PARTS], ignore_index=True)
    write_atomically(TABLE, lambda path: frame.to_parquet(path, index=False))
    write_atomically(TABLE.with_suffix(".md"), lambda path: path.write_text(page.whole(frame)))


def keep() -> None:
    """Copy the table to lab/notebook/data/stability.csv, and make tables and picture of lab/notebook/stability.md from it anew.

    Raises:
        InputError: there is no table.
    """
    import pandas as pd

    if not TABLE.is_file():
        raise InputError(f"{TABLE}: not found; `snakemake -s lab/Snakefile --cores 2 {TABLE}` makes it")
    frame = pd.read_parquet(TABLE)
    write_atomically(KEPT, lambda path: frame.to_csv(path, index=False, float_format="%.4g"))
    text = fill(PAGE.read_text(), page.tables(kept()))
    write_atomically(PAGE, lambda path: path.write_text(text))
    picture.draw(frame, picture.PICTURE)


def kept() -> pd.DataFrame:
    """Read lab/notebook/data/stability.csv."""
    import pandas as pd

    return pd.read_csv(KEPT, keep_default_na=False, na_values={"value": [""], "limit": [""]})


def _commit() -> str:
    """Short hash of the commit, with a plus sign where files differ from it; empty outside a repository."""

    def git(*words: str) -> str:
        found = subprocess.run(["git", "-C", str(REPOSITORY), *words], capture_output=True, text=True, check=False)
        return found.stdout.strip() if found.returncode == 0 else ""

    commit = git("rev-parse", "--short", "HEAD")
    return f"{commit}+" if git("status", "--porcelain", "--", "iif_core", "workflow") else commit


def _machine() -> str:
    """Name of the processor, and whether it has AVX-512, by which compiled sums differ."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    wide = any(line.startswith("flags") and "avx512f" in line for line in lines)
    return (names[0] if names else platform.machine()) + (", AVX-512" if wide else "")
