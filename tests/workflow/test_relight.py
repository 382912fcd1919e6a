"""`snakemake relight/<scene>`: pictures under other light, without touching what is published."""

import json

from support import planned

from workflow.artifacts.files import read_exr

RELIGHT = """
relight:
  - {name: dimmed, emitters: 0.5, samples: 8}
  - name: lamp
    emitters: off
    sphere: {center: [1.0, 1.0, 1.2], radius: 0.1, radiance: [20, 20, 20]}
    camera: {frames: 2, width: 32, height: 24}
    samples: 8
"""


def test_relighting_is_made_on_demand(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    bare = workflow.run("relight/tiny")
    assert bare.returncode != 0 and "no relighting is configured" in bare.stderr and "Traceback" not in bare.stderr
    path.write_text(path.read_text() + RELIGHT)
    assert planned(workflow.run("relight/tiny", "-n")) == {"relight", "relit"}
    assert "Nothing to be done" in workflow.run("scenes/tiny").stderr
    result = workflow.run("relight/tiny")
    assert result.returncode == 0, result.stderr[-3000:]
    folder = workflow.folder / "relight/tiny"
    found = sorted(
        p.relative_to(folder).as_posix() for p in folder.rglob("[!.]*") if p.is_file()
    )  # Snakemake leaves a time stamp
    frames = [f"{name}.{kind}" for name in ("dimmed/frame_0000", "lamp/frame_0000", "lamp/frame_0001") for kind in ("exr", "png")]
    assert found == sorted([*frames, "contact_sheet.png", "relight.json"])
    assert read_exr(folder / "lamp/frame_0001.exr")["R"].shape == (24, 32)
    facts = json.loads((folder / "relight.json").read_text())["relightings"]
    assert [entry["frames"] for entry in facts] == [1, 2] and all(entry["exposure"] > 0 for entry in facts)
