"""Fingerprints: they change when, and only when, a result may."""

import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from workflow import plugins, settings
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fp

SCENE = "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\n"


def fingerprints(root, folder, quality="draft"):
    """Fingerprints of all stages, computed by the code in `root`, run in `folder`, in a fresh process."""
    code = (
        "import json; from workflow.runtime import fingerprint as f; from workflow.registry import STAGES;"
        f"print(json.dumps({{s: f.fingerprint(s, 't', {quality!r}) for s in STAGES}}))"
    )
    environment = {"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin", plugins.VARIABLE: "lab.plugins"}
    out = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


@pytest.fixture
def checkout(repository, tmp_path):
    """A copy of the code and a folder with one scene."""
    for name in ("iif_core", "workflow", "lab", "config"):
        # Byte code too, so that it need not be compiled; but not what other processes write just now.
        passing = shutil.ignore_patterns("*.pyc.*", "*.nb?", "*.tmp*", "notebook")
        shutil.copytree(repository / name, tmp_path / "code" / name, ignore=passing)
    scenes = tmp_path / "run/config/scenes"
    scenes.mkdir(parents=True)
    (scenes / "t.yaml").write_text(SCENE)
    return tmp_path / "code", tmp_path / "run"


def changed(before, after):
    return {stage for stage in before if before[stage] != after[stage]}


def below(stage):
    out = {stage}
    for name in STAGES:
        if out & set(STAGES[name].upstream):
            out.add(name)
    return out


def test_code_edit_changes_only_the_stage_and_below(checkout):
    code, run = checkout
    before = fingerprints(code, run)
    metrics = code / "iif_core/evaluation/metrics.py"
    metrics.write_text(metrics.read_text() + "\nEXTRA = 1\n")
    after = fingerprints(code, run)
    assert "metrics" in changed(before, after)
    assert "affines" not in changed(before, after) and "render" not in changed(before, after)


@pytest.mark.parametrize(
    "module, first", [("iif_core.light.emission.gains", "emission"), ("iif_core.fitting.selection", "affines")]
)
def test_a_change_of_a_later_part_does_not_make_earlier_ones_anew(module, first):
    document = settings.dump(settings.load("kitchen", "draft", Path(__file__).parents[2]))
    names = list(STAGES)
    earlier = names[: names.index(first)]
    assert earlier and not [s for s in earlier if module in fp.stage_modules(s, document)]
    assert module in fp.stage_modules(first, document)


@pytest.mark.long
def test_touch_and_comments_change_nothing(checkout):
    code, run = checkout
    before = fingerprints(code, run)
    for path in code.rglob("*.py"):
        path.write_text(path.read_text() + "\n# a remark\n")
    assert changed(before, fingerprints(code, run)) == set()


@pytest.mark.long
def test_setting_changes_stage_and_below(checkout):
    code, run = checkout
    before = fingerprints(code, run)
    (run / "config/scenes/t.yaml").write_text(SCENE + "shading: {samples: 6}\n")
    assert changed(before, fingerprints(code, run)) == below("shading")


@pytest.mark.long
def test_unrelated_comment_in_scene_file_changes_nothing(checkout):
    code, run = checkout
    before = fingerprints(code, run)
    (run / "config/scenes/t.yaml").write_text("# hello\n" + SCENE)
    assert changed(before, fingerprints(code, run)) == set()


@pytest.mark.long
@pytest.mark.parametrize("prior", ["learned", "retinex"])
def test_a_plan_loads_no_compiler(checkout, prior):
    """Snakemake asks for the fingerprints of all stages whenever it is called, so plug-ins must not load what only jobs need."""
    code, run = checkout
    (run / "config/scenes/t.yaml").write_text(f"source: {{kind: builtin, scene: kitchen}}\nprior: {{kind: {prior}}}\n")
    probe = """
import sys
from workflow.runtime import fingerprint
for stage in ("capture", "prior", "segmentation", "base", "affines"):
    fingerprint.fingerprint(stage, "t", "draft")
print([name for name in ("numba", "torch", "mitsuba", "scipy", "open3d") if name in sys.modules])
"""
    found = subprocess.run(
        [sys.executable, "-c", probe], cwd=run, env=os.environ | {"PYTHONPATH": str(code)}, capture_output=True, text=True
    )
    assert found.returncode == 0 and found.stdout.strip() == "[]", found.stdout + found.stderr


def test_closure_covers_what_a_stage_really_imports(repository):
    """Import every stage (with every plug-in) in a separate process; it must load nothing of ours that the digest misses."""
    # The processes are forks of one that holds the libraries, which take most of the time.
    probe = textwrap.dedent(
        """
        import importlib, json, os, sys
        from workflow.runtime import native
        native.prepare()
        import mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        import numba, pandas, pyarrow.parquet, scipy.optimize, torch
        import workflow.settings  # takes its defaults from the options of the solvers; their values are in the fingerprint
        before = set(sys.modules)
        for names in json.loads(sys.argv[1]):
            child = os.fork()
            if child == 0:
                status = 1
                try:
                    for name in names: importlib.import_module(name)
                    ours = [m for m in set(sys.modules) - before if m.split(".")[0] in ("iif_core", "workflow", "lab")]
                    os.write(1, (json.dumps(sorted(ours)) + "\\n").encode())
                    status = 0
                finally:
                    os._exit(status)
            assert os.waitpid(child, 0)[1] == 0, names
        """
    )
    kinds_of = {
        "capture": ("source", ("builtin", "mitsuba", "folder", "scannetpp", "fipt")),
        "prior": ("prior", ("learned", "simulated", "files", "retinex", "rgbx", "marigold", "pooled")),
        "segmentation": ("segmentation", ("given", "masks", "geometry")),
    }
    document = settings.dump(settings.load("kitchen", "draft", repository))
    cases, roots = [], []
    for stage in STAGES:
        section, kinds = kinds_of.get(stage, (None, (None,)))
        for kind in kinds:
            cases.append((stage, kind, fp.stage_modules(stage, document | ({section: {"kind": kind}} if section else {}))))
            roots.append([STAGES[stage].module] + ([plugins.implementation(section, kind)] if section else []))
    command = [sys.executable, "-c", probe, json.dumps(roots)]
    out = subprocess.run(command, cwd=repository, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    for (stage, kind, modules), line in zip(cases, out.stdout.splitlines(), strict=True):
        missed = [m for m in json.loads(line) if m not in modules and not fp.is_infrastructure(m)]
        assert not missed, (stage, kind, missed)


def test_function_level_imports_are_in_the_closure():
    """The static walk sees imports inside functions, which a runtime probe of module imports would not."""
    assert "iif_core.camera.pinhole" in fp.import_closure("workflow.scene.normal_form")


def test_raw_digest_follows_content_not_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    photo = tmp_path / "a.png"
    photo.write_bytes(b"one")
    first = fp.raw_digest([photo])
    photo.touch()
    assert fp.raw_digest([photo]) == first
    photo.write_bytes(b"two")
    assert fp.raw_digest([photo]) != first


@pytest.mark.long
def test_weights_of_vgg_count_where_they_are_read(checkout):
    code, run = checkout
    weights = run / "results/weights/lpips_vgg.npz"
    weights.parent.mkdir(parents=True)

    def with_and_without():
        weights.write_bytes(b"weights")
        present = fingerprints(code, run)
        weights.unlink()
        return changed(present, fingerprints(code, run))

    assert with_and_without() == below("base_scores")
    (run / "config/scenes/t.yaml").write_text(SCENE + "metrics: {lpips_vgg: true}\n")
    assert with_and_without() == below("base_scores") | below("metrics")


@pytest.mark.long
def test_what_is_remembered_of_the_code_changes_nothing(checkout):
    """Without, with, and with a damaged memory: the same; an edit that keeps size and time stamp is seen."""
    code, run = checkout
    memory, affines = run / "results/.code-digests.json", code / "workflow/stages/affines.py"
    first = fingerprints(code, run)
    assert memory.is_file() and fingerprints(code, run) == first
    kept = memory.read_text()
    capture = str(code / "workflow/stages/capture.py")
    digest = json.loads(kept)["files"][capture][1][0]
    for text in ('{"by": 3}', kept.replace(digest, "0" * len(digest)), kept.replace(capture, "x")):
        assert text != kept
        memory.write_text(text)
        assert fingerprints(code, run) == first
    memory.unlink()
    threads = (
        "from concurrent.futures import ThreadPoolExecutor as P; from workflow.runtime import fingerprint as f;"
        "stages = ['render', 'affines', 'emission', 'base'] * 4;"
        "list(P(8).map(lambda s: f.fingerprint(s, 't', 'draft'), stages))"
    )
    environment = {"PYTHONPATH": str(code), "PATH": "/usr/bin:/bin", plugins.VARIABLE: "lab.plugins"}
    subprocess.run([sys.executable, "-c", threads], cwd=run, env=environment, check=True)
    before = affines.stat()
    affines.write_text(affines.read_text() + "\nEXTRA = 1\n")
    one = fingerprints(code, run)
    affines.write_text(affines.read_text().replace("EXTRA = 1", "EXTRA = 2"))
    os.utime(affines, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert changed(first, one) == changed(one, fingerprints(code, run)) == below("affines")
