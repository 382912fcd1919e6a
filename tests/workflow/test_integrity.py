"""What plain Snakemake gets wrong and this workflow must not: stale deliverables, unnoticed damage, killed jobs."""

import json
import os
import shutil
import signal
import subprocess
import time

import pytest
from support import error_of, manifests, planned

from tests.errors import named
from tests.unit import own_scene as own
from workflow.artifacts.manifest import write
from workflow.registry import STAGES

NOTHING = "Nothing to be done"


def test_second_run_does_nothing(workflow):
    assert NOTHING in workflow.run("scenes/tiny").stderr


def test_touched_code_inputs_and_scene_file_rerun_nothing(workflow):
    (workflow.folder / "config/scenes/tiny.yaml").touch()
    assert NOTHING in workflow.run("scenes/tiny").stderr


def test_a_setting_reruns_its_stage_and_those_below(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text().replace("render: {samples: 8}", "render: {samples: 9}"))
    dry = workflow.run("scenes/tiny", "-n")
    assert planned(dry) == {"render", "metrics", "report", "publish"}
    forecast = dry.stderr[dry.stderr.rindex("\nstage ") :].split("\n")
    said = ["stage", "render", "metrics", "report", "publish", "expected:", "quality", "config/scenes/tiny.yaml"]
    assert [line.split(" ")[0] for line in forecast if line] == said


@pytest.mark.long
def test_failed_run_does_not_leave_the_old_deliverable_as_up_to_date(workflow):
    """A parameter changes, the first affected job fails, the same command comes again: everything below must be rebuilt."""
    path = workflow.folder / "config/scenes/tiny.yaml"
    before = json.loads((workflow.folder / "scenes/tiny/manifest.json").read_text())
    path.write_text(path.read_text().replace("render: {samples: 8}", "render: {samples: 9}"))
    maps = workflow.folder / "results/tiny/render/maps"
    shutil.rmtree(maps)
    maps.write_text("in the way")
    failed = workflow.run("scenes/tiny")
    named(error_of(failed), maps.relative_to(workflow.folder))
    maps.unlink()
    again = workflow.run("scenes/tiny")
    assert again.returncode == 0 and NOTHING not in again.stderr, again.stderr[-2000:]
    after = json.loads((workflow.folder / "scenes/tiny/manifest.json").read_text())
    assert after != before
    for stage in ("render", "metrics"):
        manifest = json.loads((workflow.folder / f"results/tiny/{stage}/manifest.json").read_text())
        assert manifest["fingerprint"] != "" and manifest["stage"] == stage
    render = json.loads((workflow.folder / "results/tiny/render/manifest.json").read_text())
    assert render["settings"]["render"]["samples"] == 9


def test_damage_with_unchanged_time_stamp_is_found_named_and_rebuilt(workflow):
    victim = workflow.folder / "results/tiny/metrics/metrics.parquet"
    status, data = victim.stat(), bytearray(victim.read_bytes())
    whole = bytes(data)
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    os.utime(victim, ns=(status.st_atime_ns, status.st_mtime_ns))
    verify = workflow.run("verify")
    assert verify.returncode != 0
    assert "results/tiny/metrics/metrics.parquet" in verify.stdout + verify.stderr
    rebuilt = workflow.run("scenes/tiny")
    assert rebuilt.returncode == 0, rebuilt.stderr[-2000:]
    assert "results/tiny/metrics/metrics.parquet: " in rebuilt.stderr and planned(rebuilt) >= {"metrics"}
    assert victim.read_bytes() == whole
    assert NOTHING in workflow.run("scenes/tiny").stderr
    assert workflow.run("verify").returncode == 0


def test_edited_deliverable_is_found(workflow):
    page = workflow.folder / "scenes/tiny/plan.yaml"
    text = page.read_text() + "\n# edited\n"
    page.write_text(text)
    verify = workflow.run("verify")
    assert verify.returncode != 0 and "scenes/tiny/plan.yaml" in verify.stdout + verify.stderr
    assert planned(workflow.run("scenes/tiny", "-n")) == {"publish"}


@pytest.mark.long
def test_published_files_that_are_gone_are_named_and_published_again(workflow):
    deliverable = workflow.folder / "scenes/tiny"
    before = {path.name: path.read_bytes() for path in deliverable.glob("maps/*")}
    (deliverable / "plan.yaml").unlink()
    (deliverable / "maps/001.exr").unlink()
    verify = workflow.run("verify")
    assert verify.returncode != 0
    *damaged, total = verify.stderr.strip().splitlines()[-3:]
    for line, path in zip(damaged, ("scenes/tiny/maps/001.exr", "scenes/tiny/plan.yaml"), strict=True):
        assert line.startswith(f"{path}: ") and line.endswith("snakemake --cores 2 scenes/tiny --forcerun publish")
    assert total.split()[0] == "2"
    assert planned(workflow.run("scenes/tiny", "-n")) == {"publish"}
    again = workflow.run("scenes/tiny")
    assert again.returncode == 0 and all(f"{path}: " in again.stderr for path in ("tiny/maps/001.exr", "tiny/plan.yaml"))
    assert {path.name: path.read_bytes() for path in deliverable.glob("maps/*")} == before
    assert (deliverable / "plan.yaml").is_file()
    assert NOTHING in workflow.run("scenes/tiny").stderr


@pytest.mark.long
def test_what_publishing_left_is_made_by_publishing_again(workflow):
    """The record of stage publish is no output of a rule; and a deliverable can be sound and not the one that is wanted."""
    record, deliverable = workflow.folder / "results/tiny/publish/published.json", workflow.folder / "scenes/tiny/manifest.json"
    whole = record.read_bytes()
    record.write_bytes(whole.replace(b'"files"', b'"filez"'))
    dry = workflow.run("scenes/tiny", "-n")
    assert planned(dry) == {"publish"} and "published.json: " in dry.stderr
    record.write_bytes(whole)
    write(deliverable, json.loads(deliverable.read_text()) | {"fingerprint": "0" * 16})
    assert planned(workflow.run("scenes/tiny", "-n")) == {"publish"}


@pytest.mark.long
def test_the_last_line_is_the_reason_of_the_failed_job(workflow):
    """Also where several jobs fail, and after a run that failed for another reason."""
    folder = workflow.folder
    own.bare(folder / "data/mm")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(folder / "data/mm/mesh.ply", 1000 * vertices, faces)
    text = "source: {kind: folder, path: data/mm}\ncapture: {width: 64, height: 48}\nprior: {kind: retinex}\n"
    workflow.write("mm", text + "segmentation: {kind: geometry}\n")
    old = folder / "results/tiny/logs/base.state.json"
    old.write_text(json.dumps({"state": "failed", "reason": "long ago", "fingerprint": ""}))
    os.utime(old, (0, 0))
    failed = workflow.run("scenes/mm")
    named(error_of(failed), "mm", "capture", "results/mm/logs/capture.log", "data/mm/mesh.ply", "5590 m")
    assert "long ago" not in failed.stderr


@pytest.mark.long
def test_killed_run_resumes_to_the_same_result(finished, tmp_path):
    """kill -9 on a running job, then on a job and Snakemake itself: the same command completes, every manifest equals the
    undisturbed run's. A Snakemake that could not clean up leaves its lock; it says so, and that --unlock removes it."""
    workflow = finished.copy(tmp_path / "run")
    shutil.rmtree(workflow.folder / "scenes")
    for stage in set(STAGES) - {"capture", "prior"}:  # so much is left to do
        shutil.rmtree(workflow.folder / "results/tiny" / stage, ignore_errors=True)
    process, job = _running(workflow, "segmentation|base")
    os.kill(job, signal.SIGKILL)
    process.communicate()
    assert process.returncode not in (0, -signal.SIGKILL)
    process, job = _running(workflow, "shading|affines")
    os.kill(process.pid, signal.SIGKILL)
    os.kill(job, signal.SIGKILL)
    process.communicate()
    locked = workflow.run("scenes/tiny")
    assert locked.returncode and "--unlock" in locked.stderr
    assert workflow.run("scenes/tiny", "--unlock").returncode == 0
    again = workflow.run("scenes/tiny")
    assert again.returncode == 0, again.stderr[-2000:]
    assert manifests(workflow.folder) == manifests(finished.folder)


def _running(workflow, stages):
    """Snakemake, and the id of a job of one of the stages that it has just started."""
    process = subprocess.Popen(workflow.command("scenes/tiny"), stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        out = subprocess.run(["pgrep", "-f", "--", f"-m workflow ({stages}) tiny"], capture_output=True, text=True)
        mine = [int(pid) for pid in out.stdout.split() if _works_in(int(pid), workflow.folder)]
        if mine:
            return process, mine[-1]
        time.sleep(0.02)
    raise AssertionError("no job was seen running")


def _works_in(pid, folder):
    """Whether a process is a Python (not the shell that starts it) in a folder."""
    try:
        python = "python" in os.path.basename(os.path.realpath(f"/proc/{pid}/exe"))
        return python and os.path.realpath(f"/proc/{pid}/cwd") == os.path.realpath(folder)
    except OSError:
        return False


def test_every_stage_has_a_manifest_that_chains(finished):
    import hashlib

    for stage in STAGES.values():
        if stage.on_demand:
            continue
        path = finished.folder / f"results/tiny/{stage.name}/manifest.json"
        document = json.loads(path.read_text())
        assert set(document["inputs"]) == set(stage.upstream)
        for name, facts in document["inputs"].items():
            data = (finished.folder / f"results/tiny/{name}/manifest.json").read_bytes()
            assert hashlib.sha256(data).hexdigest() == facts["manifest_sha256"]
