"""The memory that each rule asks for against what its job took, for finished scenes of several sizes.

    python lab/benchmarks/memory.py <working folder> <scene>[=<name in the table>] ...

The memory asked for is what a plan says that knows nothing but the files of the scene (as on a cluster, before its capture is
there). The memory taken is the peak of the process (`max_rss_mb` of `benchmarks/<stage>.parts.json`); the load of the machine
does not change it. The rows go to lab/notebook/data/reliability_memory.json; `reliability.py` makes the table of them.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from workflow.costs.size import size_of_capture
from workflow.registry import STAGES
from workflow.runtime import forecast, native

ROW = Path(__file__).resolve().parents[2] / "lab/notebook/data/reliability_memory.json"


def asked(scene: str, quality: str) -> dict[str, int]:
    """Return the MB that the rules of a scene ask for in the working folder, which holds nothing of it yet."""
    return {
        stage.name: forecast.memory_mb(forecast.job_cost(stage.name, scene, quality))
        for stage in STAGES.values()
        if not stage.on_demand
    }


def taken(results: Path, scene: str) -> dict[str, float]:
    """Return the MB that the jobs of a finished scene took."""
    parts = (results / scene / "benchmarks").glob("*.parts.json")
    return {path.name.split(".")[0]: json.loads(path.read_text())["job"]["max_rss_mb"] for path in parts}


def rows(folder: Path, scenes: list[str], quality: str) -> list[dict[str, Any]]:
    """Return a row for every scene: name, size, and (asked, taken) of every stage."""
    out = []
    with tempfile.TemporaryDirectory() as place:
        for name in ("config", "data"):
            if (folder / name).exists():
                os.symlink((folder / name).resolve(), Path(place) / name)
        os.chdir(place)
        for scene, _, name in (text.partition("=") for text in scenes):
            manifest = json.loads((folder / "results" / scene / "capture/manifest.json").read_text())
            size, found, wanted = size_of_capture(manifest), taken(folder / "results", scene), asked(scene, quality)
            stages = {stage: [wanted[stage], round(found[stage])] for stage in wanted if stage in found}
            sizes = {"views": size.views, "pixels": size.pixels, "faces": size.faces}
            out.append({"scene": name or scene, **sizes, "stages": stages})
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--quality", default="draft")
    arguments = parser.parse_args()
    native.process_environment()
    found = rows(arguments.folder.resolve(), arguments.scenes, arguments.quality)
    ROW.write_text(json.dumps(found, indent=1) + "\n")
    for row in found:
        for stage, (wanted, took) in row["stages"].items():
            print(f"{row['scene']:24s} {stage:14s} asked {wanted:6d} MB, took {took:6d} MB: {wanted / took:.2f}")


if __name__ == "__main__":
    main()
