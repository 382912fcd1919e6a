"""What Snakemake's own commands say about the workflow, in a folder that has nothing but one scene. No job is run."""

import os
import shutil
from pathlib import Path

import pytest
from support import Workflow, error_of

from tests.errors import named
from workflow.registry import STAGES


@pytest.fixture(scope="module")
def fresh(repository, tmp_path_factory):
    workflow = Workflow(repository, tmp_path_factory.mktemp("commands"))
    workflow.write("tiny", "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\n")
    return workflow


def succeeded(result):
    assert result.returncode == 0 and "Traceback" not in result.stderr, result.stderr[-3000:]
    return result.stdout


def test_every_rule_has_a_description(fresh):
    lines = succeeded(fresh.run("--list")).splitlines()
    assert {line.split()[0] for line in lines} > set(STAGES)
    assert all(line.endswith(".)") for line in lines), lines


def test_the_linter_has_nothing_to_say(fresh):
    succeeded(fresh.run("--lint"))


@pytest.mark.long
def test_commands_that_run_nothing_know_the_default_target(fresh):
    assert "scenes/tiny" in succeeded(fresh.run("--summary"))
    assert "FROM " in succeeded(fresh.run("--containerize"))
    graph = succeeded(fresh.run("--rulegraph"))
    nodes = {line.split("[")[0].strip(): line.split('"')[1] for line in graph.splitlines() if "label" in line}
    edges = {tuple(nodes[end.strip()] for end in line.split("->")) for line in graph.splitlines() if "->" in line}
    wanted = {(needed, stage.name) for stage in STAGES.values() if not stage.on_demand for needed in stage.upstream}
    assert wanted <= edges and ("publish", "batch") in edges


@pytest.mark.long
def test_a_folder_without_scenes_knows_those_of_the_repository(repository, tmp_path):
    elsewhere = Workflow(repository, tmp_path)
    assert "publishing scenes/kitchen" in succeeded(elsewhere.run("scenes/kitchen", "-n"))
    assert "relight-kitchen-s0: Render the recovered scene under other light" in succeeded(elsewhere.run("relight/kitchen", "-n"))
    misspelt = elsewhere.run("scenes/kichen", "-n")
    assert misspelt.returncode == 1 and "Did you mean scenes/kitchen?" in misspelt.stderr.strip().splitlines()[-1]


def copy_of(repository, checkout):
    """What of a checkout is needed to run."""
    checkout.mkdir()
    shutil.copy(repository / "Snakefile", checkout)
    for part in ("config", "examples", "iif_core", "lab", "profiles", "workflow"):
        shutil.copytree(repository / part, checkout / part, ignore=shutil.ignore_patterns("__pycache__"))
    return checkout


@pytest.mark.long
def test_results_do_not_depend_on_where_the_checkout_lies_and_how_it_is_named(repository, finished, tmp_path):
    moved = finished.copy(tmp_path / "run")
    moved.repository = Path(os.path.relpath(copy_of(repository, tmp_path / "checkout")))
    assert not moved.repository.is_absolute()
    assert "Nothing to be done" in succeeded(moved.run("scenes/tiny", "-n"))


@pytest.mark.long
def test_a_checkout_may_have_a_space_in_its_path(repository, tmp_path):
    """Snakemake refuses the path of an image that has one, even where no image is used."""
    checkout = copy_of(repository, tmp_path / "a copy")
    spaced = Workflow(checkout, checkout)
    assert "publishing scenes/kitchen" in succeeded(spaced.run("scenes/kitchen", "-n"))
    succeeded(spaced.run("verify"))
    image = spaced.run("scenes/kitchen", "-n", "--sdm", "apptainer")
    assert image.returncode == 1
    assert "a copy/envs/iif.sif" in image.stdout + image.stderr


@pytest.mark.long
def test_the_image_is_named_where_it_is_asked_for(fresh):
    """The next step, which looks for apptainer, is Snakemake's own."""
    asked = fresh.run("scenes/tiny", "-n", "--sdm", "apptainer")
    if shutil.which("apptainer") or shutil.which("singularity"):
        assert asked.returncode == 0, asked.stderr
    else:
        assert "apptainer or singularity command has to be available" in asked.stdout + asked.stderr


@pytest.mark.parametrize(
    "arguments, found, meant",
    [
        (["scenes/tiny/report"], "scenes/tiny/report", "scenes/tiny"),
        (["scenes/../tiny"], "tiny", "scenes/tiny"),
        (["scenes/a/tinny"], "scenes/a/tinny", "scenes/tiny"),
        (["results/tiny/bse/manifest.json"], "results/tiny/bse/manifest.json", "results/tiny/base/manifest.json"),
        (["scenes/tiny", "--forcerun", "bse"], "bse", "base"),
        (["tiny"], "tiny", "scenes/tiny"),
    ],
)
def test_a_target_that_nothing_makes_is_one_error(fresh, arguments, found, meant):
    result = fresh.run("-n", *arguments)
    last = result.stderr.strip().splitlines()[-1]
    assert result.returncode == 1 and "Exception" not in result.stderr
    assert last.startswith(
        f"error: {found}: no rule makes this. Did you mean {meant}? Targets are scenes/<name>, plan/<name>, bench/<name> and "
    )


def test_status_is_asked_without_snakemake(fresh):
    result = fresh.run("status", "-n")
    assert result.returncode == 1 and "Ask `python -m workflow status`" in result.stderr.strip().splitlines()[-1]


@pytest.mark.long
def test_a_profile_that_is_not_there_is_one_error(fresh, monkeypatch):
    """Snakemake passes over it, and a run that was meant for a cluster would compute where it was called."""
    monkeypatch.setenv("PWD", os.getcwd())
    result = fresh.run("scenes/tiny", "-n", "--workflow-profile", "workflow/profiles/slurm-scene")
    assert result.returncode == 1
    named(error_of(result), "--workflow-profile workflow/profiles/slurm-scene", os.getcwd(), "workflow/profiles/slurm-scenes")


@pytest.mark.long
@pytest.mark.parametrize("target", ["plan/tiny", "relight/tiny"])
def test_a_link_in_the_place_of_a_folder_is_one_error(fresh, target):
    path = fresh.folder / target
    path.parent.mkdir()
    path.symlink_to(fresh.folder / "config")
    result = fresh.run(target, "-n")
    path.unlink()
    path.parent.rmdir()
    assert result.returncode == 1
    assert result.stderr.strip().splitlines()[-1].startswith(f"error: {target}: a symbolic link to ")


@pytest.mark.parametrize("target", ["scenes/tiny", "relight/tiny"])
def test_a_file_in_the_place_of_a_scene_is_one_error(fresh, target):
    path = fresh.folder / target
    path.parent.mkdir()
    path.write_text("")
    result = fresh.run(target, "-n")
    path.unlink()
    path.parent.rmdir()
    assert result.returncode == 1
    assert result.stderr.strip().splitlines()[-1] == f"error: {target}: a file, where the workflow makes a folder. Move it away."
