"""The page lab/notebook/reliability.md: its tables are made anew from the rows that other commands have left.

    python lab/benchmarks/reliability.py                  the page alone
    python lab/benchmarks/reliability.py --damage folder  also damages a copy of its results/, file by file

Other rows: `python lab/benchmarks/soundness.py`, `python lab/benchmarks/memory.py`,
`python lab/benchmarks/batch.py --keep`, `python -m tests.workflow.crash --all`, `make fuzz`, `make test-slurm`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from workflow.artifacts import manifest as manifests
from workflow.artifacts import sound, stamps
from workflow.artifacts.manifest import MANIFEST
from workflow.artifacts.verify import damaged
from workflow.report.blocks import fill, markdown

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "lab/notebook/data"
PAGE = ROOT / "lab/notebook/reliability.md"
HARMLESS = ("cases", "accepted", "refused")


def rows(name: str) -> dict[str, Any]:
    """Return the rows of a table; empty if it was never measured."""
    path = DATA / f"{name}.json"
    return json.loads(path.read_text()) if path.is_file() else {}


# ---------------------------------------------------------------------------------------------------------------- damage


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _with_old_time(harm: Callable[[Path], None]) -> Callable[[Path], None]:
    def harmed(path: Path) -> None:
        status = path.stat()
        harm(path)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    return harmed


KINDS: dict[str, Callable[[Path], None]] = {
    "one bit": _flip,
    "one bit, time stamp set back": _with_old_time(_flip),
    "emptied": lambda path: path.write_bytes(b""),
    "cut in half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "removed": lambda path: path.unlink(),
}


class Folder:
    """A finished stage, or what is published of a scene, in a copy of results/ and scenes/.

    Attributes:
        path: of the folder; name: of the stage, empty for what is published.
        mark: fingerprint under which it is wanted.
    """

    def __init__(self, root: Path, path: Path):
        published = path.parent == root / "scenes"
        self.root, self.path, self.name = root, path, "" if published else path.name
        self.scene = path.name if published else path.parent.name
        self.mark = json.loads((path / MANIFEST).read_text())["fingerprint"]
        self.noted = stamps.place(root / "results", self.scene, self.name or stamps.DELIVERABLE)

    def faults(self) -> tuple[str, ...]:
        """Return what is found when a run is planned."""
        sound.forget()
        results = self.root / "results"
        if self.name:
            return sound.stage_faults(results, self.scene, self.name, self.mark)
        return sound.deliverable_faults(self.path, results, self.scene, self.mark)

    def count(self, row: dict[str, int], path: Path) -> None:
        """Count whether a damaged file or folder is named."""
        row["cases"] += 1
        row["plan"] += any(str(path) in line for line in self.faults())
        row["verify"] += any(str(path) in line for line in damaged(self.root, [self.scene]))


def damage(source: Path) -> dict[str, Any]:
    """Damage each file of each finished stage and of each published scene in `source` in each way, and count what is found."""
    more = ("that of another scene put in its place", "stage removed")
    out: dict[str, Any] = {kind: {"cases": 0, "verify": 0, "plan": 0} for kind in (*KINDS, *more)}
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        for part in ("results", "scenes"):
            shutil.copytree(source / part, root / part, symlinks=True)
        found = sorted(path.parent for pattern in ("results/*/*/", "scenes/*/") for path in root.glob(pattern + MANIFEST))
        assert not list(damaged(root)), "what is there must be sound to begin with"
        folders = [Folder(root, path) for path in found]
        for folder in folders:
            assert not folder.faults(), folder.path  # notes the stamps of the copy
        for folder in folders:
            for path in sorted(path for path in folder.path.rglob("*") if path.is_file() and path.stat().st_size):
                for kind, harm in KINDS.items():
                    kept, noted = path.read_bytes(), folder.noted.read_bytes()
                    harm(path)
                    folder.count(out[kind], path)
                    path.write_bytes(kept)
                    folder.noted.write_bytes(noted)
                    assert not folder.faults()  # sound again; the new stamp is noted
            aside = root / "aside"
            folder.path.rename(aside)
            if folder.name:  # Snakemake itself knows that a published scene is not there
                folder.count(out[more[1]], folder.path)
            shutil.copytree(aside, folder.path)
            other = folder.path / MANIFEST
            text = other.read_text().replace(f'"scene": "{folder.scene}"', '"scene": "elsewhere"')
            manifests.write(other, json.loads(text))  # sound in itself
            folder.count(out[more[0]], folder.path)
            shutil.rmtree(folder.path)
            aside.rename(folder.path)
            assert not folder.faults()
    return out


# ---------------------------------------------------------------------------------------------------------------- tables


def table(heads: list[str], body: list[list[Any]], words: int = 1) -> str:
    """Return a table in Markdown, integers with commas; the first `words` columns hold words."""
    cells = ([f"{cell:,}" if isinstance(cell, int) else str(cell) for cell in line] for line in body)
    return "\n".join(markdown(heads, cells, words))


def tables() -> dict[str, str]:
    """Return the tables of the page by name."""
    crash, fuzz, harm = rows("reliability_crash"), rows("reliability_fuzz"), rows("reliability_damage")
    out = {}
    body = [[kind, row["cases"], row["verify"], row["plan"]] for kind, row in harm.items()]
    out["damage"] = table(["what is done to a file", "cases", "named by verify", "named when a run is planned"], body)
    body = []
    for kind, words in (("power_cuts", "power cut"), ("faults", "error of the disk")):
        for case, row in crash.get(kind, {}).items():
            body.append([f"{words}, {case}", row["points"], row["kept"] + row.get("unharmed", 0), row["lost"], row["wrong"]])
    for case, row in crash.get("stages", {}).items():
        body.append([f"stage {case}", row["points"], row["kept"] + row.get("unharmed", 0), row["lost"], row["wrong"]])
    out["crash"] = table(["trial", "points", "old or new, whole", "to be made again", "silently wrong"], body)
    bad = sorted({key for row in fuzz.get("kinds", {}).values() for key in row if key not in HARMLESS})
    body = [
        [kind, row["cases"], row["accepted"], row["refused"], *(row.get(key, 0) for key in bad)]
        for kind, row in sorted(fuzz.get("kinds", {}).items())
    ]
    body.append(["all", *(sum(line[i] for line in body) for i in range(1, 4 + len(bad)))] if body else ["all", 0, 0, 0])
    out["fuzz"] = table(["kind of file", "cases", "accepted", "refused", *bad], body)
    cost = rows("soundness")
    body = [[cost["scenes"], cost["stages"], cost["files"], cost["stamps"], cost["touched"], cost["hashes"]]] if cost else []
    heads = ["scenes", "stages", "files", "seconds, stamps", "seconds, first plan after a run", "seconds, contents hashed"]
    out["cost"] = table(heads, body)
    out["memory"] = _memory()
    out |= batch_tables(rows("reliability_batch"))
    slurm = rows("reliability_slurm")
    body = [[name, ", ".join(f"{key}: {value}" for key, value in row.items())] for name, row in slurm.items()]
    out["slurm"] = table(["trial", "result"], body)
    return out


def _memory() -> str:
    """Return the table of memory: what each rule asked for over what its job took, a column a scene."""
    scenes = list(rows("reliability_memory"))
    stages = list(dict.fromkeys(stage for scene in scenes for stage in scene["stages"]))
    body = []
    for stage in stages:
        cells = []
        for scene in scenes:
            asked, taken = scene["stages"].get(stage, (0, 0))
            cells.append(f"{asked} / {taken} = {asked / taken:.2f}" if taken else "")
        body.append([stage, *cells])
    size = "{scene}: {views} photographs, {millions:.2g} Mpx, {thousands:,.0f} thousand faces"
    heads = [size.format(**scene, millions=scene["pixels"] / 1e6, thousands=scene["faces"] / 1e3) for scene in scenes]
    return table(["rule", *heads], body)


BATCH = {
    "real": "scenes that are computed",
    "prepared": "scenes that are finished before",
    "faulty": "of the computed ones with a fault",
    "damaged": "of the finished ones with a damaged artefact",
    "plan_seconds": "plan (`snakemake -n scenes`), seconds",
    "plan_cpu": "plan, CPU seconds",
    "plan_mb": "plan, memory in MB",
    "run_minutes": "run with faults, minutes",
    "scenes_an_hour": "scenes delivered an hour",
    "page_cpu_first": "summary and page, CPU seconds, all pictures made",
    "page_cpu": "summary and page, CPU seconds, pictures there",
    "page_mb": "page, MB",
    "pictures_mb": "pictures of the page, MB",
}
"""Row of reliability_batch.json -> its name in the table."""


def batch_tables(found: dict[str, Any]) -> dict[str, str]:
    """Return the tables of a batch: what was measured, and what the summary said of each kind of fault."""
    body = [[words, found[key]] for key, words in BATCH.items() if found.get(key) is not None]
    body += [["wrong in the end", len(found["wrong"])]] if found else []
    faults = [
        [words, " in ".join(filter(None, (status, stage))), reason.replace("|", "/")[:160]]
        for words, (status, stage, reason) in found.get("faults", {}).items()
    ]
    return {
        "batch": table(["what", "measured"], body),
        "batch_faults": table(["fault", "status", "reason in summary.tsv, its beginning"], faults, 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--damage", type=Path, help="folder with results/ of finished scenes; a copy of it is damaged")
    arguments = parser.parse_args()
    if arguments.damage:
        (DATA / "reliability_damage.json").write_text(json.dumps(damage(arguments.damage), indent=1) + "\n")
    PAGE.write_text(fill(PAGE.read_text(), tables()))


if __name__ == "__main__":
    main()
