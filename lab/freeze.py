"""`python -m lab.freeze`: does a change of the code leave every artefact as it was, byte by byte?

    python -m lab.freeze record before.json          # in the checkout before the change, or in another one (--checkout)
    python -m lab.freeze compare before.json         # after it

`record` makes small scenes with every prior and every segmentation that ships, at all qualities, in an empty folder, and writes
the SHA-256 of each file that a stage or a deliverable holds. `compare` makes them again and names what differs. Bytes are those
of one machine and one number of cores, so both belong on the same machine, and the file into no repository.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workflow.artifacts.files import write_exr
from workflow.artifacts.store import StageReader, ids_from_disk, material_maps, split_rgb

REPOSITORY = Path(__file__).resolve().parents[1]
TINY = """\
source: {kind: builtin, scene: tiny}
capture: {dynamic_range: ldr, views: 4, width: 48, height: 48, samples: 32}
emission: {rows: 2000, samples: 8}
shading: {samples: 8, levels: 6}
affines: {pixels: 8000, iterations: 5}
render: {samples: 8}
room: {lightmap_size: 128, samples: 256}
"""
KITCHEN = """\
source: {kind: builtin, scene: kitchen}
limits: {views: 8, width: 96, height: 96}
room: {lightmap_size: 256, samples: 256}
"""
PRIORS = {
    "learned": "{kind: learned, samples: 3}",
    "retinex": "{kind: retinex, samples: 3}",
    "simulated": "{kind: simulated, samples: 3, strength: 0.5}",
    "files": "{kind: files, path: made, samples: 2}",
    "pooled": "{kind: pooled, samples: 2, of: [{kind: learned}, {kind: retinex}]}",
}
SEGMENTATIONS = {"given": "{kind: given}", "geometry": "{kind: geometry}", "masks": "{kind: masks, path: made}"}
SOURCE_OF_FILES = "tiny-simulated-given"
"""The scene whose predictions and objects are written as files of other programs, for prior `files` and segmentation `masks`."""
NOT_COMPARED = {"manifest.json", "timings.parquet", "report.html", "scene.json"}
"""Files that hold times, versions or digests of the code."""


@dataclass(frozen=True)
class Scene:
    """A scene to be made: its file, and the quality."""

    text: str
    quality: str = "draft"


def scenes() -> dict[str, Scene]:
    """Return every scene by its name; the one that others take their files from comes first."""
    out = {
        f"tiny-{prior}-{objects}": Scene(f"{TINY}prior: {PRIORS[prior]}\nsegmentation: {SEGMENTATIONS[objects]}\n")
        for prior in ("simulated", *PRIORS)
        for objects in SEGMENTATIONS
    }
    out |= {f"tiny-{quality}": Scene(TINY, quality) for quality in ("standard", "paper")}
    return out | {f"kitchen-{quality}": Scene(KITCHEN, quality) for quality in ("draft", "standard", "paper")}


def make(folder: Path, names: list[str], checkout: Path, cores: int) -> dict[str, dict[str, str]]:
    """Make scenes with the code of a checkout; return scene -> file -> SHA-256.

    Raises:
        SystemExit: a scene failed.
    """
    (folder / "config/scenes").mkdir(parents=True, exist_ok=True)
    every, found = scenes(), {}
    for number, name in enumerate(names, 1):
        (folder / f"config/scenes/{name}.yaml").write_text(every[name].text)
        print(f"{number}/{len(names)} {name}", flush=True)
        command = [sys.executable, "-m", "snakemake", "-s", str(checkout / "Snakefile"), "-d", str(folder), "--cores", str(cores)]
        command += [f"scenes/{name}", "--config", f"quality={every[name].quality}"]
        run = subprocess.run(command, capture_output=True, text=True, cwd=checkout)
        if run.returncode:
            raise SystemExit(f"{name}: failed\n{run.stderr[-4000:]}")
        if name == SOURCE_OF_FILES:
            _write_files(folder, name)
        found[name] = digests(folder, name)
    return found


def digests(folder: Path, name: str) -> dict[str, str]:
    """Return the SHA-256 of every file of the stages and of the deliverable of a scene."""
    found = {}
    for path in sorted((folder / "results" / name).glob("*/manifest.json")):
        if path.parent.name not in ("report", "publish"):
            facts = json.loads(path.read_text())["files"]
            found |= {f"{path.parent.name}/{file}": own["sha256"] for file, own in facts.items()}
    delivered = folder / "scenes" / name
    for path in sorted(delivered.rglob("*")):
        if path.is_file() and path.name not in NOT_COMPARED:
            found[f"scenes/{path.relative_to(delivered)}"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _write_files(folder: Path, name: str) -> None:
    """Write the predictions and the objects of a scene as other programs would, to made/ in the folder."""
    prior, objects = (StageReader(folder / "results" / name / stage, stage, name) for stage in ("prior", "segmentation"))
    made = folder / "made"
    for kind in ("albedo", "roughness", "metallic"):
        (made / "predictions" / kind).mkdir(parents=True, exist_ok=True)
    (made / "masks").mkdir(exist_ok=True)
    for path in sorted((prior.directory / "maps").glob("*.exr")):
        channels = prior.exr(f"maps/{path.name}")
        for k in range(2):
            maps = material_maps(channels, f"prior.{k:03d}.")
            file = f"{path.stem}_{k:03d}.exr"
            write_exr(made / "predictions/albedo" / file, {name: v for name, v in split_rgb(maps["albedo"]).items()})
            for kind in ("roughness", "metallic"):
                write_exr(made / "predictions" / kind / file, {"Y": maps[kind].astype(np.float32)})
        ids = ids_from_disk(objects.exr(f"maps/{path.name}")["object.id"])
        write_exr(made / "masks" / path.name, {"Y": (ids + 1).astype(np.float32)})


def differences(before: dict[str, dict[str, str]], after: dict[str, dict[str, str]]) -> list[str]:
    """Return a line for each file that is new, gone or other than before."""
    lines = []
    for name in after:
        old, new = before.get(name, {}), after[name]
        for file in sorted(old.keys() | new.keys()):
            if old.get(file) != new.get(file):
                what = "new" if file not in old else "gone" if file not in new else "differs"
                lines.append(f"{name}: {file}: {what}")
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status: 1 where something differs."""
    parser = argparse.ArgumentParser(prog="python -m lab.freeze", description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("record", "compare"))
    parser.add_argument("file", type=Path, help="where the digests are kept")
    parser.add_argument("--only", default="", help="names of scenes that contain this text")
    parser.add_argument("--checkout", type=Path, default=REPOSITORY, help="whose Snakefile runs; by default this one")
    parser.add_argument("--folder", type=Path, help="where the scenes are made; by default a temporary folder")
    parser.add_argument("--cores", type=int, default=2)
    options = parser.parse_args(arguments)
    names = [name for name in scenes() if options.only in name or name == SOURCE_OF_FILES]
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        found = make(folder, names, options.checkout.resolve(), options.cores)
    if options.command == "record":
        options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
        print(f"{sum(map(len, found.values()))} files of {len(found)} scenes: {options.file}")
        return 0
    lines = differences(json.loads(options.file.read_text()), found)
    print("\n".join(lines) or f"all {sum(map(len, found.values()))} files of {len(found)} scenes are the same bytes")
    return 1 if lines else 0


if __name__ == "__main__":
    raise SystemExit(main())
