"""What it costs a plan to compare the stamps of every artefact: `python lab/benchmarks/soundness.py [--scenes 100]`.

Scenes with as many stages and files as the kitchen at draft (small files: their contents are not read), in a temporary folder.
One row in lab/notebook/data/soundness.json; the page is lab/notebook/reliability.md.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from workflow.artifacts import StageWriter, sound, stamps
from workflow.artifacts.files import sha256_of
from workflow.registry import STAGES

ROWS = Path(__file__).resolve().parents[2] / "lab/notebook/data/soundness.json"
FILES = 33
"""Of each stage: 15 stages with 495 files."""


def build(root: Path, scenes: int) -> tuple[int, list[tuple[str, str]]]:
    """Write scenes, and return the number of files and the finished stages."""
    count, made = 0, []
    for number in range(scenes):
        scene = f"room{number}"
        for stage in (stage for stage in STAGES.values() if not stage.on_demand):
            inputs = {
                name: {"scene": scene, "fingerprint": "0", "manifest_sha256": sha256_of(root / scene / name / "manifest.json")}
                for name in stage.upstream
            }
            facts = {"scene": scene, "stage": stage.name, "fingerprint": "0", "inputs": inputs}
            writer = StageWriter(root / scene / stage.name, facts)
            for file in range(FILES):
                path = root / scene / stage.name / f"maps/{file:03d}.exr"
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(b"x" * file)  # without the flush of `StageWriter.bytes`: this is not what is measured
                digest = writer.stamps.of(path)
                writer.files[f"maps/{file:03d}.exr"] = {"sha256": digest, "bytes": file, "kind": "exr"}
            writer.finish()
            writer.stamps.save(stamps.place(root, scene, stage.name))
            count += FILES + 1
            made.append((scene, stage.name))
    return count, made


def compare(root: Path, made: list[tuple[str, str]]) -> float:
    """Return the seconds of one comparison of all stages."""
    sound.forget()
    start = time.perf_counter()
    assert not any(sound.stage_faults(root, scene, stage, "0") for scene, stage in made)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=100)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "results"
        files, made = build(root, arguments.scenes)
        warm = min(compare(root, made) for _ in range(5))
        for path in root.glob("*/*/manifest.json"):
            path.touch()
        touched = compare(root, made)
        for path in root.glob("*/stamps"):
            for stamp in path.iterdir():
                stamp.unlink()
        cold = compare(root, made)
    row = {"scenes": arguments.scenes, "stages": len(made), "files": files, "stamps": round(warm, 3)}
    row |= {"touched": round(touched, 3), "hashes": round(cold, 3)}
    ROWS.write_text(json.dumps(row, indent=1) + "\n")
    print(row)


if __name__ == "__main__":
    main()
