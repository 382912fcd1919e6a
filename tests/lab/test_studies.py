"""Studies: names of derived scenes, what they override, what they share, errors, and the arithmetic of the table."""

import itertools
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from iif_core.fusion.uncertainty import CALIBRATION
from lab.studies import files, variants
from lab.studies import table as study_table
from tests.errors import refused
from workflow import plugins, settings
from workflow.artifacts import DamagedArtefact, StageWriter
from workflow.runtime import fingerprint as fp
from workflow.runtime.job import Job
from workflow.runtime.timings import read_parts
from workflow.scoring import scores
from workflow.settings import derived

SCENE = "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated, strength: 0.5}\ncapture: {views: 9, width: 32}\n"
SHARED = "t: {capture: {width: 64}, prior: {samples: 4}}\n"
STUDY = """\
title: A study
scenes: [t]
variants:
  full: {}
  mean-2: {label: the mean, overrides: {base: {variant: object_mean}, capture: {views: 3}}}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """`folder(name, text)` writes config/<name>.yaml in an empty folder, which is the current one; studies in lab/config/."""
    monkeypatch.chdir(tmp_path)

    def write(name, text):
        path = tmp_path / ("lab/config" if name.startswith("studies/") else "config") / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        for cached in (fp.resolved, fp.fingerprint, fp.home, study_table.plan, variants._load_study, files._load_study):
            cached.cache_clear()

    write("scenes/t", SCENE)
    write("studies/scenes", SHARED)
    write("studies/a", STUDY)
    yield write
    for cached in (fp.resolved, fp.fingerprint, fp.home, study_table.plan, variants._load_study, files._load_study):
        cached.cache_clear()


def test_names_come_apart_as_they_were_put_together(folder):
    assert derived.derived("t--a-mean-2-s17") == ("t", "a", "mean-2", 17)
    assert derived.derived(derived.scene_of("a", "my-room", "sgd-s3", 0)) == ("my-room", "a", "sgd-s3", 0)
    assert derived.derived("t--s3") == ("t", "", "", 3)
    for plain in ("t", "t--", "t--a", "t--s03", "t--a-full", "t--A-full-s0"):
        assert derived.derived(plain) is None
    folder("scenes/t--s3", SCENE)  # a scene of that name goes first
    assert derived.derived("t--s3") is None and derived.bases("t--s3") == []


def test_without_the_laboratory_only_the_product_derives_scenes(folder, monkeypatch):
    monkeypatch.setattr(plugins, "derived", lambda: None)
    assert derived.derived("t--a-full-s0") is None and derived.derived("t--s0") is None
    assert derived.derived("t--bench-p03-s0") == ("t", "bench", "p03", 0)
    assert derived.bases("t--relight-evening-s0") == ["t"] and derived.bases("t--bench-p03-s0") == []
    assert derived.bases("t--s3") == [] and derived.shared_scene("t--s3") == "t--s3"
    with refused("config/scenes/t--a-full-s0.yaml", "not found"):
        settings.load("t--a-full-s0")


def test_a_folder_without_studies_uses_those_of_the_repository(tmp_path, repository):
    assert variants.study_names(tmp_path) == variants.study_names(repository) != []


def test_layers_lie_over_one_another(folder):
    shared, variant = settings.load("t--s5"), settings.load("t--a-mean-2-s5")
    assert (shared.capture.views, shared.capture.width, shared.prior.samples, shared.prior.strength) == (9, 64, 4, 0.5)
    assert (variant.capture.views, variant.capture.width, variant.base.variant) == (3, 64, "object_mean")
    assert shared.prior.seed == variant.prior.seed == 5 and shared.seed == variant.seed == 0
    assert settings.load("t").prior.seed is None and settings.load("t").capture.width == 32


def test_an_entry_with_a_source_needs_no_scene_file(folder):
    own = "r: {source: {kind: builtin, scene: sky}, prior: {kind: simulated, shared: 3.0}}\n"
    folder("studies/scenes", SHARED + own)
    folder("studies/a", STUDY.replace("scenes: [t]", "scenes: [t, r]"))
    room = settings.load("r--a-mean-2-s1")
    assert (room.source.scene, room.prior.shared, room.capture.views, room.prior.seed) == ("sky", 3.0, 3, 1)
    assert len(study_table.plan("a", "draft").cells) == 12
    with refused("config/scenes/r.yaml", "t"):
        settings.load("r")
    folder("studies/scenes", SHARED + own.replace("scene: sky", "scene: sku"))
    with refused("lab/config/studies/scenes.yaml", "r", "source.scene", "'sku'"):
        settings.load("r--s0")
    folder("studies/scenes", SHARED + "r: {prior: {kind: simulated}}\n")
    with refused("lab/config/studies/scenes.yaml", "r", "source", "t"):
        settings.load("t--s0")


def test_what_agrees_is_shared_and_what_does_not_is_not(folder):
    def homes(scene):
        return {stage: fp.home(stage, scene, "draft") for stage in ("capture", "segmentation", "prior", "base", "base_scores")}

    assert set(homes("t--a-full-s0").values()) == {"t--s0"}
    assert homes("t--a-full-s1") == {
        "capture": "t--s0",
        "segmentation": "t--s1",
        "prior": "t--s1",
        "base": "t--s1",
        "base_scores": "t--s1",
    }
    assert set(homes("t--a-mean-2-s0").values()) == {"t--a-mean-2-s0"}  # its photographs are others
    assert fp.home("capture", "t", "draft") == "t"
    folder("studies/a", STUDY.replace(", capture: {views: 3}", ""))
    assert homes("t--a-mean-2-s1") == {
        "capture": "t--s0",
        "segmentation": "t--s1",
        "prior": "t--s1",
        "base": "t--a-mean-2-s1",
        "base_scores": "t--a-mean-2-s1",
    }
    assert len(study_table.inputs("a", "draft")) == 6


LATE = """\
title: Late
scenes: [t]
seeds: [0, 1]
scores: metrics
costs: [base, affines]
protocols: [raw, scaled]
common: {base: {predictions: 2}, affines: {robust_width: 0.2}}
variants:
  first: {}
  same: {row: prior_k0}
  other: {overrides: {affines: {model: object_mean}}}
  far: {overrides: {base: {ridge: 0.5}, affines: {robust_width: 0.3}}}
"""


def test_variants_share_what_an_earlier_one_made(folder):
    folder("studies/late", LATE.replace("  far:", "  every: {overrides: {affines: {model: fipt}}}\n  far:"))

    def home(variant, seed, stage):
        return fp.home(stage, f"t--late-{variant}-s{seed}", "draft")

    for seed in (0, 1):
        assert home("first", seed, "prior") == f"t--s{seed}"
        for stage in ("base", "emission", "shading", "affines", "metrics"):
            assert home("same", seed, stage) == home("first", seed, stage) == f"t--late-first-s{seed}"
        for stage in ("base", "emission", "shading"):
            assert home("other", seed, stage) == f"t--late-first-s{seed}"
        for stage in ("affines", "render", "metrics"):
            assert home("other", seed, stage) == f"t--late-other-s{seed}"
        # It reads the light of every pixel.
        assert home("every", seed, "emission") == f"t--late-first-s{seed}"
        assert home("every", seed, "shading") == f"t--late-every-s{seed}"
        assert home("far", seed, "capture") == "t--s0" and home("far", seed, "base") == f"t--late-far-s{seed}"
    assert settings.load("t--late-far-s0").base.predictions == 2 and settings.load("t--late-far-s0").affines.robust_width == 0.3
    # What depends on the variant but not on the seed is made once.
    folder("studies/late", LATE.replace("base: {ridge: 0.5}", "capture: {views: 3}"))
    assert home("far", 1, "capture") == "t--late-far-s0" and home("far", 1, "prior") == "t--late-far-s1"
    assert len(study_table.inputs("late", "draft")) == 6  # `same` adds nothing


def test_a_study_does_not_move_with_what_draft_is(folder):
    """Its variants start from the defaults of the settings; another quality can be asked for by name."""
    folder("quality/draft", "shading: {samples: 16}\n")
    folder("quality/standard", "shading: {samples: 64}\n")
    folder("studies/late", LATE)
    default = settings.load("t--late-far-s0").shading.samples
    assert default == settings.load("t--s0").shading.samples == 32
    assert settings.load("t").shading.samples == 16
    assert settings.load("t--late-far-s0", "standard").shading.samples == 64


def test_a_variant_chooses_a_preset_over_what_the_study_shares(folder):
    text = "title: x\nscenes: [t]\ncommon: {shading: {pixels: 500000}}\nvariants:\n  ours: {}\n"
    folder("studies/a", text + "  theirs: {preset: published, overrides: {emission: {iterations: 7}}}\n")
    ours, theirs = (settings.load(f"t--a-{name}-s0") for name in ("ours", "theirs"))
    assert (ours.shading.pixels, ours.emission.solver) == (500000, "direct")
    assert (theirs.shading.pixels, theirs.emission.solver) == ("all", "published")
    assert theirs.emission.iterations == 7 and theirs.prior == ours.prior
    for stage in ("capture", "prior", "segmentation"):
        assert fp.home(stage, "t--a-theirs-s0", "draft") == fp.home(stage, "t--a-ours-s0", "draft")
    folder("scenes/t", SCENE + "base: {solver: sgd, texture: cells, iterations: 5}\naffines: {solver: sgd, epochs: 1}\n")
    folder("studies/a", text + "  theirs: {preset: published}\n")
    theirs = settings.load("t--a-theirs-s0")  # what the scene sets for another method is not part of the published one
    assert (theirs.base.texture, theirs.base.iterations, theirs.affines.epochs) == (None, None, 3)
    folder("scenes/t", SCENE.replace("capture: {", "capture: {dynamic_range: hdr, "))
    with refused("a.yaml, variant theirs", "emission: solver: published", "capture: {dynamic_range: ldr}"):
        settings.load("t--a-theirs-s0")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LATE + "reference: best\n", ["reference: best", "first, same, other, far"]),
        (LATE + "repeats: {best: [3]}\n", ["repeats.best", "first, same, other, far"]),
        (LATE + "repeats: {far: []}\n", ["repeats.far", "[]", 1]),
        (LATE.replace("affines]", "affine]"), ["costs", "affine", "affines"]),
        (LATE.replace("scores: metrics", "scores: report"), ["scores", "'report'", "'metrics'"]),
        (LATE.replace("[raw, scaled]", "[raw, best]"), ["protocols.1", "'best'", "'raw'"]),
        (LATE.replace("predictions: 2}", "predictions: 0}"), ["late.yaml", "common", "base.predictions", 0, 1]),
        (
            LATE.replace("model: object_mean", "model: fipt, solver: sgd"),
            ["late.yaml, variant other", "solver: sgd", "model: fipt", "direct, adam"],
        ),
    ],
)
def test_mistakes_in_a_study_of_the_result(folder, text, words):
    folder("studies/late", text)
    with refused("lab/config/studies/late.yaml", *words):
        study_table.plan("late", "draft")


def test_a_variant_has_further_seeds(folder):
    folder("studies/late", LATE + "repeats: {far: [1, 3]}\n")
    cells = study_table.plan("late", "draft").cells
    assert [(cell.variant, cell.seed) for cell in cells if cell.variant in ("other", "far")] == [
        *(("other", 0), ("other", 1)),
        *(("far", 0), ("far", 1), ("far", 3)),
    ]
    assert fp.home("capture", "t--late-far-s3", "draft") == "t--s0" and fp.home("prior", "t--late-far-s3", "draft") == "t--s3"


def test_costs_are_added_over_stages(folder, tmp_path):
    folder("studies/late", LATE)
    cell = study_table.Cell("t", "other", 0, "t--late-other-s0")
    for scene, stage, cpu, memory in (("t--late-first-s0", "base", 3.0, 900), ("t--late-other-s0", "affines", 4.0, 300)):
        path = tmp_path / "results" / scene / "benchmarks" / f"{stage}.parts.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        job = {"seconds": 2 * cpu, "cpu_seconds": cpu, "max_rss_mb": memory, "threads": 2}
        path.write_text(json.dumps({"job": job, "solve": {"seconds": 1.0, "cpu_seconds": cpu / 2}}))
    costs = study_table._costs(cell, "draft", ["base", "affines"])
    assert (costs["cpu_seconds"], costs["max_rss_mb"], costs["solver_cpu_seconds"]) == (7.0, 900, 2.0)
    assert study_table._costs(cell, "draft", ["base", "render", "affines"])["cpu_seconds"] is None


def test_table_of_the_result_reads_the_row_of_each_variant(folder, tmp_path):
    """From what stage metrics leaves to table, page and picture."""
    folder("studies/late", LATE.replace("[0, 1]", "[0]") + "paper: {other: {protocol: scaled, values: {albedo/psnr: 10.6}}}\n")
    for scene, gain in (("t--late-first-s0", 0.0), ("t--late-other-s0", 1.0), ("t--late-far-s0", 2.0)):
        rows = [
            (variant, view, quantity, "psnr", protocol, base + gain + view_gain)
            for variant, base in (("result", 20.0), ("prior_k0", 10.0))
            for view, view_gain in (("a", 0.0), ("b", 1.0))
            for quantity, protocol in (("albedo", "raw"), ("albedo", "scaled"), ("rgb", "raw"))
            if quantity == "albedo" or variant == "result"
        ]
        writer = StageWriter(tmp_path / "results" / scene / "metrics", {"scene": scene, "stage": "metrics", "fingerprint": "x"})
        names = ("variant", "view", "quantity", "metric", "protocol", "value")
        writer.table(
            "variants.parquet", {name: list(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}
        )
        writer.finish()
    study_table.write_study("late", "draft")
    frame = pd.read_parquet("results/studies/late.parquet")
    raw = frame[(frame["protocol"] == "raw") & (frame["quantity"] == "albedo")].set_index("variant")
    assert raw["value"].to_dict() == {"first": 20.5, "same": 10.5, "other": 21.5, "far": 22.5} and (raw["views"] == 2).all()
    assert frame[frame["quantity"] == "rgb"]["variant"].tolist() == ["first", "other", "far"]
    paper = frame[frame["paper"].notna()]
    assert paper[["variant", "protocol", "paper"]].to_numpy().tolist() == [["other", "scaled", 10.6]]
    assert "10.60 (scaled)" in Path("results/studies/late.md").read_text()
    assert Path("results/studies/late.png").stat().st_size > 5000
    folder("studies/late", LATE.replace("[0, 1]", "[0]").replace("prior_k0", "prior_k9"))
    with refused("row: prior_k9", "variants.parquet", "prior_k0, result"):
        study_table.table("late", "draft")


def test_finished_scores_are_kept_before_the_study_ends(folder, tmp_path):
    """Cells that are not there or were made by other code are left out, and older rows of other cells stay."""
    folder("studies/late", LATE.replace("[0, 1]", "[0]"))
    names = ("variant", "view", "quantity", "metric", "protocol", "value")
    for variant, mark in (("first", None), ("other", "stale")):
        scene = f"t--late-{variant}-s0"
        mark = mark or fp.fingerprint("metrics", scene, "draft")
        writer = StageWriter(tmp_path / "results" / scene / "metrics", {"scene": scene, "stage": "metrics", "fingerprint": mark})
        rows = [("result", "a", "albedo", "psnr", "raw", 20.0), ("prior_k0", "a", "albedo", "psnr", "raw", 10.0)]
        columns = zip(names, zip(*rows, strict=True), strict=True)
        writer.table("variants.parquet", {name: list(column) for name, column in columns})
        writer.finish()
    kept = tmp_path / "kept.csv"
    pd.DataFrame(
        [[scene, "first", 0, "albedo", "psnr", "raw", 1.5, 2, None, None, None, None, "z"] for scene in ("u", "t")],
        columns=study_table.KEPT,
    ).to_csv(kept, index=False)
    for _ in range(2):
        study_table.keep_rows("late", "draft", kept)
        frame = pd.read_csv(kept)
        assert frame[["scene", "variant", "value"]].to_numpy().tolist() == [
            ["t", "first", 20.0],
            ["t", "same", 10.0],
            ["u", "first", 1.5],
        ]


def test_page_of_the_result_has_means_over_scenes_and_the_protocol_of_each_number():
    study = files.Study(
        title="T",
        scenes=["t", "u"],
        seeds=[0],
        scores="metrics",
        costs=["affines"],
        protocols=["raw", "scaled"],
        variants={"a": files.Variant(label="first")},
        paper={"a": files.Paper(protocol="scaled", values={"albedo/psnr": 20.0, "roughness/l2": 0.5})},
        show=["albedo/psnr", "roughness/l2"],
    )
    row = {"variant": "a", "seed": 0, "cpu_seconds": 1.0, "status": "ok"}
    frame = pd.DataFrame(
        [
            row | {"scene": s, "quantity": q, "metric": m, "protocol": p, "value": v}
            for s, q, m, p, v in (
                ("t", "albedo", "psnr", "raw", 10.0),
                ("u", "albedo", "psnr", "raw", 20.0),
                ("t", "albedo", "psnr", "scaled", 22.0),
                ("u", "albedo", "psnr", "scaled", 23.0),
                ("t", "roughness", "l2", "raw", 0.1),
                ("u", "roughness", "l2", "raw", 0.3),
            )
        ],
        columns=[name for name, _ in study_table.COLUMNS],
    )
    lines = study_table.page(study, frame, {}).splitlines()
    albedo, roughness = (next(i for i, line in enumerate(lines) if line.startswith(f"## {q}")) for q in ("albedo", "roughness"))
    cells = [text.strip() for text in lines[albedo + 4].strip("|").split("|")]
    assert cells == ["first", "10.00", "22.00", "20.00", "23.00", "15.00", "22.50", "20.00 (scaled)"]
    cells = [text.strip() for text in lines[roughness + 4].strip("|").split("|")]
    assert cells == ["first", "0.1", "0.3", "0.2", "0.5 (raw)"]
    assert "## cost of affines" in lines


def test_page_says_by_how_much_the_reference_moves():
    study = files.Study(
        title="T",
        scenes=["t"],
        reference="a",
        variants={"a": files.Variant(), "b": files.Variant()},
        show=["albedo/psnr"],
    )
    rows = [("a", 0, "psnr", 20.0, 1.0), ("a", 1, "psnr", 24.0, 1.0), ("b", 0, "psnr", 21.0, 1.0), ("b", 1, "psnr", 27.0, 1.0)]
    lines = study_table.page(study, frame_of(rows), {}).splitlines()
    cells = {line.split("|")[1].strip(): line.split("|")[2].strip() for line in lines if line.startswith(("| a", "| b"))}
    assert cells == {"a": "22.00 ± 3", "b": "24.00 (+2 ± 1)"}


def test_scenes_can_be_the_rows_of_the_page():
    study = files.Study(
        title="Rooms",
        scenes=["a", "b"],
        seeds=[0],
        scores="metrics",
        rows="scenes",
        protocols=["raw", "scaled"],
        variants={"ours": {"label": "result"}, "base": {"row": "base"}},
        show=["albedo/psnr", "emission/iou"],
    )
    values = {("a", "ours"): 30.0, ("a", "base"): 25.0, ("b", "ours"): 28.0}
    rows = [
        {"scene": scene, "variant": variant, "seed": 0, "quantity": "albedo", "metric": "psnr", "protocol": "scaled", "value": v}
        for (scene, variant), v in values.items()
    ]
    frame = pd.DataFrame(rows).assign(status="ok", **dict.fromkeys(study_table.COSTS))
    page = study_table.page(study, frame, {})
    assert "| scene | result |  base |\n" in page and "| a     |  30.00 | 25.00 |\n| b     |  28.00 |       |\n" in page
    assert "| mean  |  29.00 | 25.00 |" in page and "emission IoU\n\nNot scored" in page and "scaled" in page


def test_a_shared_result_is_read_from_where_it_lies(folder, tmp_path):
    job = Job("segmentation", "t--a-full-s1", "draft", 1)
    with refused("results/t--s0/capture/manifest.json", kind=DamagedArtefact):
        job.read("capture")


def test_grids_are_variants(folder):
    folder("studies/a", "title: x\nscenes: [t]\ngrids: [{base.ridge: [0.1, 1.0e-3], base.variant: [full, uniform]}]\n")
    variants = files.load_study("a").variants
    assert list(variants) == ["0_1-full", "0_1-uniform", "0_001-full", "0_001-uniform"]
    assert variants["0_001-uniform"].overrides == {"base": {"ridge": 0.001, "variant": "uniform"}}
    assert settings.load("t--a-0_001-uniform-s2").base.ridge == 0.001


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (STUDY + "colour: 1\n", ["lab/config/studies/a.yaml", "colour", "title", "scenes"]),
        (STUDY.replace("label:", "lable:"), ["variants.mean-2.lable", "label", "overrides", "preset", "row"]),
        (STUDY + "plot: {kind: pie}\n", ["plot.kind", "'pie'", "'bars'"]),
        (STUDY + "plot: {kidn: bars}\n", ["plot.kidn", "kind, x, group, history, log"]),
        (STUDY + "plot: {kind: line, x: base.sweeps}\n", ["plot", "'base.sweeps'", "base.variant"]),
        (STUDY.replace("mean-2", "me an"), ["variants", "'me an'"]),
        (STUDY.replace("scenes: [t]", "scenes: [tt]"), ["scenes", "tt", "lab/config/studies/scenes.yaml", "t"]),
        (STUDY.replace("scenes: [t]", "scenes: []"), ["scenes", "[]", 1]),
        (STUDY.replace("scenes: [t]\n", ""), ["scenes", "lab/config/studies/aggregation.yaml"]),
        (STUDY + "show: [albedo/pnsr]\n", ["show", "'albedo/pnsr'", "psnr"]),
        (STUDY + "paper: {best: {protocol: raw, values: {}}}\n", ["paper.best", "full, mean-2"]),
        (
            STUDY + "paper: {full: {protocol: raw, values: {albedo: 3}}}\n",
            ["paper.full.values", "'albedo'", "<quantity>/<metric>"],
        ),
        (STUDY + "paper: {full: {protocol: best, values: {}}}\n", ["paper.full.protocol", "'best'", "'raw'"]),
        (STUDY + "grids: [{base: [1]}]\n", ["grids.0", "base: [1]", "<section>.<key>"]),
        ("title: x\nscenes: [t]\n", ["variants: {<name>: {overrides: ...}}", "grids"]),
        ("title: x\n  scenes: [t]\n", ["a.yaml, line 2", "YAML"]),
    ],
)
def test_mistakes_in_a_study(folder, text, words):
    folder("studies/a", text)
    with refused("lab/config/studies/a.yaml", *words):
        files.load_study("a")


def test_settings_are_blamed_on_the_file_that_spoils_them(folder):
    folder("studies/a", STUDY.replace("object_mean", "mode"))
    with refused("lab/config/studies/a.yaml, variant mean-2", "base.variant", "'mode'", "'full'"):
        study_table.plan("a", "draft")
    folder("studies/scenes", "t: {capture: {widht: 64}}\n")
    with refused("lab/config/studies/scenes.yaml, t", "capture.widht", "width"):
        study_table.plan("a", "draft")
    folder("scenes/t", SCENE + "sed: 3\n")
    with refused("config/scenes/t.yaml", "sed", "seed"):
        study_table.plan("a", "draft")


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ("t--a-mean-s0", ["lab/config/studies/a.yaml", "mean", "full, mean-2"]),
        ("t--b-full-s0", ["lab/config/studies/b.yaml", "a"]),
        ("u--a-full-s0", ["config/scenes/u.yaml", "t"]),
    ],
)
def test_unknown_derived_scenes(folder, scene, words):
    with refused(*words):
        settings.load(scene)


def test_unlisted_scenes(folder):
    folder("scenes/u", SCENE)
    with refused("lab/config/studies/scenes.yaml: u", "t"):
        settings.load("u--a-full-s0")
    folder("studies/scenes", SHARED + "kitchn: {}\n")
    with refused("lab/config/studies/scenes.yaml", "kitchn", "source"):
        files.load_study("a")


@pytest.mark.parametrize("quality", [q if q == "draft" else pytest.param(q, marks=pytest.mark.long) for q in settings.QUALITIES])
def test_shipped_studies_load_at_every_quality(repository, monkeypatch, quality):
    monkeypatch.chdir(repository)
    for name in variants.study_names():
        study = files.load_study(name)
        for scene, variant in itertools.product(study.scenes, study.variants):
            settings.load(derived.scene_of(name, scene, variant, study.seeds[0]), quality)


def test_parts_of_a_job_are_timed(folder):
    job = Job("base", "t", "draft", 2)
    for _ in range(2):
        with job.timed("solve"):
            sum(range(200000))
    with pytest.raises(ZeroDivisionError), job.timed("rest"):
        _ = 1 / 0
    job.write_timings()
    parts = read_parts("t", "base")
    assert set(parts) == {"solve", "rest", "job", "expected"} and parts["expected"]["cpu_seconds"] > 0
    assert 0 < parts["solve"]["cpu_seconds"] <= parts["job"]["cpu_seconds"]
    assert parts["job"]["max_rss_mb"] > 10 and parts["job"]["threads"] == 2
    assert read_parts("t", "prior") == {}


def test_pareto_front():
    cost, value = [1, 2, 3, 3, 4], [5, 7, 6, 7, 9]
    assert study_table.pareto_front(cost, value, True) == [True, True, False, False, True]
    assert study_table.pareto_front(cost, value, False) == [True, False, False, False, False]
    assert study_table.pareto_front([1, 1], [2, 2], True) == [True, True]
    assert study_table.pareto_front([], [], True) == []


def frame_of(values, **columns):
    rows = [
        {"scene": "t", "variant": variant, "seed": seed, "quantity": "albedo", "metric": metric, "protocol": "raw"}
        | {"value": value, "cpu_seconds": cost, "status": "ok"}
        for variant, seed, metric, value, cost in values
    ]
    return pd.DataFrame(rows, columns=[name for name, _ in study_table.COLUMNS]).assign(**columns)


def test_front_is_of_means_over_seeds_and_knows_which_way_is_better():
    frame = frame_of([("a", 0, "psnr", 20.0, 1.0), ("a", 1, "psnr", 30.0, 3.0), ("b", 0, "psnr", 24.0, 2.5)])
    assert study_table._pareto(frame).tolist() == [True, True, False]
    assert study_table._pareto(frame.assign(metric="l2")).tolist() == [True, True, True]
    assert study_table._pareto(frame.assign(cpu_seconds=np.nan)).tolist() == [None, None, None]
    assert study_table._pareto(frame.assign(metric="coverage_95")).tolist() == [None, None, None]


def test_page_shows_both_and_the_paper():
    study = files.Study(
        title="T",
        scenes=["t"],
        seeds=[0, 1],
        variants={"a": files.Variant(label="first"), "b": files.Variant()},
        paper={"b": files.Paper(protocol="oracle_affine", values={"albedo/psnr": 30.794})},
        show=["albedo/psnr", "albedo/lpips_vgg"],
    )
    frame = frame_of([("a", 0, "psnr", 20.0, 1.0), ("a", 1, "psnr", 22.0, 3.0), ("b", 0, "psnr", 24.0, 2.0)])
    page = study_table.page(study, frame, {"u": "no data"})
    lines = [line for line in page.splitlines() if line.startswith("| first") or line.startswith("| b ")]
    assert "21.00 ± 1" in lines[0] and "24.00" in lines[1] and "30.79 (oracle)" in lines[1]
    assert "Left out: u. no data" in page and "weights of VGG16 are not there" in page
    empty = study_table.page(study, frame[:0], {"t": "no data"})
    assert "Nothing was scored." in empty


def test_table_on_disk_keeps_what_is_unknown_unknown(tmp_path):
    frame = frame_of([("a", 0, "psnr", 20.0, 1.0), ("a", 1, "psnr", np.nan, np.nan)], pareto=[True, None])
    study_table._write_table(frame, tmp_path / "x.parquet")
    back = pd.read_parquet(tmp_path / "x.parquet")
    assert list(back) == [name for name, _ in study_table.COLUMNS]
    assert back["value"].isna().tolist() == [False, True] and back["pareto"].tolist() == [True, None]
    assert back["paper"].isna().all() and back["seed"].tolist() == [0, 1]


def test_every_kind_of_picture_is_drawn(tmp_path):
    from lab.studies.plots import draw

    variants = {str(k): files.Variant(overrides={"base": {"sweeps": k, "variant": "full"}}) for k in (1, 2, 4)}
    paper = {"2": files.Paper(protocol="raw", values={"albedo/psnr": 21.0})}
    frame = frame_of([(name, s, "psnr", 20.0 + s + int(name), 1.0 * int(name)) for name in variants for s in (0, 1)])
    frame["pareto"] = study_table._pareto(frame)
    histories = {study_table.Cell("t", name, 0, ""): [{"entropy": 2.0}, {"entropy": 1.0}] for name in variants}
    for kind in ("bars", "line", "pareto", "history"):
        plot = files.Plot(kind=kind, x="base.sweeps", group=["base.variant"], log=True)
        study = files.Study(title="T", scenes=["t"], variants=variants, paper=paper, show=["albedo/psnr"], plot=plot)
        draw(study, frame, histories, tmp_path / f"{kind}.png")
        assert (tmp_path / f"{kind}.png").stat().st_size > 5000
        draw(study, frame[:0], {}, tmp_path / "empty.png")


def test_a_few_named_variants_have_a_colour_each_and_what_is_not_scored_no_panel(tmp_path, monkeypatch):
    from matplotlib import pyplot as plt

    from lab.studies.plots import draw

    variants = {name: files.Variant(label="same") for name in "abc"}
    frame = frame_of([(name, 0, "psnr", 20.0 + i, 1.0 + i) for i, name in enumerate(variants)])
    frame["pareto"] = study_table._pareto(frame)
    kinds = {"scenes": ["t"], "protocols": ["raw", "scaled"], "show": ["albedo/psnr"]}
    study = files.Study(title="T", variants=variants, plot=files.Plot(kind="pareto"), **kinds)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    draw(study, frame, {}, tmp_path / "t.png")
    scored, empty = figures[0].axes
    points = [c for c in scored.containers]
    assert len({c.lines[0].get_color() for c in points}) == 3 and len(points) == 3
    assert scored.axison and not empty.axison and not empty.get_title()


def test_share_of_errors_within_the_claimed_interval():
    rng = np.random.default_rng(0)
    n = 20_000
    truth, scale, beta = rng.uniform(0.2, 0.8, n), rng.uniform(0.005, 0.02, n), CALIBRATION["albedo"].beta(16)
    value = 0.1 + 0.6 * truth + scale * stats.gennorm.rvs(beta, size=n, random_state=rng) / stats.gennorm.std(beta)
    names = ["albedo_r", "albedo_g", "albedo_b", "roughness", "metallic"]
    cells = dict.fromkeys(names, value) | {f"uncertainty_{name}": scale for name in names}
    cells |= {"object_id": np.zeros(n, int), "coverage": np.where(np.arange(n) % 10 == 0, 0.0, 1.0)}
    column = truth[:, None].copy()
    column[:100] = np.nan
    truths = {"albedo": np.repeat(column, 3, 1), "roughness": column, "metallic": column * np.nan}
    out = dict(scores.interval_scores(cells, truths, 16))
    assert set(out) == {"albedo", "roughness", "metallic"}
    for quantity in ("albedo",):
        share = {(score.metric, score.protocol): score.value for score in out[quantity]}
        for level in (50, 80, 95):
            assert share[f"coverage_{level}", "oracle_affine"] == pytest.approx(level / 100, abs=0.015)
        assert share["coverage_50", "raw"] < 0.3
        assert share["psnr_3d", "oracle_affine"] == pytest.approx(-20 * np.log10(np.std(scale) + np.mean(scale) / 0.6), abs=3)
    assert {score.value for score in out["metallic"]} == {None}
