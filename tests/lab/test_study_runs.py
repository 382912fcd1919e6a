"""A study of a tiny scene through Snakemake: its table, what its variants share, what a second run does, what stops it."""

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image
from support import planned

from tests.errors import missing, named

TINY = """\
source: {kind: builtin, scene: tiny}
capture: {dynamic_range: hdr, samples: 16}
prior: {kind: simulated}
segmentation: {kind: given}
"""
SCENES = """\
tiny:
  capture: {views: 3, width: 64, height: 64}
  prior: {samples: 2, strength: 0.7}
elsewhere:
"""
STUDY = """\
title: Two ways
scenes: [tiny, elsewhere]
seeds: [0, 1]
variants:
  mean: {label: mean of an object, overrides: {base: {variant: object_mean}}}
  plain: {overrides: {}}
paper:
  mean: {protocol: raw, values: {albedo/psnr: 13.21}}
show: [albedo/psnr, albedo/lpips, albedo/lpips_vgg, roughness/l2]
"""


pytestmark = pytest.mark.long


class Study:
    """A folder with a study in it, and Snakemake run there."""

    def __init__(self, repository, folder):
        self.repository, self.folder = repository, folder
        self.write("config/scenes/tiny.yaml", TINY)
        self.write("config/scenes/elsewhere.yaml", "source: {kind: mitsuba, path: no/such.xml}\nprior: {kind: simulated}\n")
        self.write("lab/config/studies/scenes.yaml", SCENES)
        self.write("lab/config/studies/two.yaml", STUDY)

    def write(self, name, text):
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def run(self, *arguments):
        snakemake = Path(sys.executable).with_name("snakemake")
        command = [str(snakemake), "-s", str(self.repository / "lab/Snakefile"), "-d", str(self.folder), "--cores", "2"]
        return subprocess.run([*command, *arguments], capture_output=True, text=True)


@pytest.fixture(scope="module")
def study(repository, tmp_path_factory):
    study = Study(repository, tmp_path_factory.mktemp("study"))
    result = study.run("results/studies/two.parquet")
    assert result.returncode == 0, result.stderr[-4000:]
    study.said = result.stderr
    return study


def test_the_table_has_every_cell(study):
    frame = pd.read_parquet(study.folder / "results/studies/two.parquet")
    done = frame[frame["status"] == "ok"]
    assert set(zip(done["variant"], done["seed"], strict=True)) == {(v, s) for v in ("mean", "plain") for s in (0, 1)}
    raw = done[(done["quantity"] == "albedo") & (done["metric"] == "psnr") & (done["protocol"] == "raw")]
    assert len(raw) == 4 and (raw["value"] > 5).all() and (raw["views"] == 3).all()
    assert raw.set_index("variant")["paper"].dropna().unique().tolist() == [13.21]
    assert done[done["protocol"] == "oracle_affine"]["paper"].isna().all()
    assert {"lpips", "flip", "ssim", "l2", "psnr"} <= set(done["metric"]) and "lpips_vgg" not in set(done["metric"])
    assert (done["seconds"] > 0).all() and (done["cpu_seconds"] > 0).all() and (done["max_rss_mb"] > 50).all()
    assert json.loads(done[done["variant"] == "mean"]["settings"].iloc[0]) == {"base": {"variant": "object_mean"}}
    assert raw["pareto"].notna().all() and raw["pareto"].astype(bool).any()


def test_seeds_differ_and_variants_differ(study):
    frame = pd.read_parquet(study.folder / "results/studies/two.parquet")
    raw = frame[(frame["quantity"] == "albedo") & (frame["metric"] == "l2") & (frame["protocol"] == "raw")]
    assert raw["value"].nunique() == 4


def test_a_scene_without_data_is_left_out_with_the_reason(study):
    frame = pd.read_parquet(study.folder / "results/studies/two.parquet")
    skipped = frame[frame["status"] == "skipped"]
    assert skipped["scene"].tolist() == ["elsewhere"] and "no/such.xml" in skipped["reason"].iloc[0]
    assert skipped["value"].isna().all()


def test_page_log_and_picture(study):
    page = (study.folder / "results/studies/two.md").read_text()
    assert "mean of an object" in page and "13.21 (raw)" in page and "Left out: elsewhere" in page and "oracle" in page
    assert "weights of VGG16 are not there" in page
    assert "mean of an object" in study.said
    assert (study.folder / "results/studies/two.png").read_bytes()[:4] == b"\x89PNG"


def test_a_sheet_shows_the_finished_variants_beside_the_truth(study):
    result = study.run("results/studies/two.grid.pdf")
    assert result.returncode == 0, result.stderr[-3000:]
    folder = study.folder / "results/studies"
    assert (folder / "two.grid.pdf").read_bytes()[:5] == b"%PDF-"
    with Image.open(folder / "two.grid.png") as sheet:
        # Truth and two variants in columns; albedo, roughness and metallic of one room in rows.
        left = 0.065 * len("roughness") + 0.12
        assert abs(sheet.width / sheet.height - (left + 3 * 1.38) / (0.3 + 3 * 1.38)) < 0.02
    assert "Nothing to be done" in study.run("results/studies/two.grid.png").stderr
    study.write("lab/config/studies/never.yaml", STUDY.replace("variant: object_mean", "ridge: 0.7"))
    never = study.run("results/studies/never.grid.pdf", "-n")
    assert missing(never.stderr, "results/studies/never.grid")  # `plain` is shared with the other study
    study.write("lab/config/studies/never.yaml", STUDY.replace("seeds: [0, 1]", "seeds: [7]"))
    never = study.run("results/studies/never.grid.pdf", "-n")
    assert never.returncode != 0 and not missing(never.stderr, "results/studies/never.grid")


def test_photographs_are_made_once_and_predictions_once_a_seed(study):
    made = sorted(
        str(path.parent.relative_to(study.folder / "results")) for path in study.folder.glob("results/*/*/manifest.json")
    )
    # `plain` changes nothing, so it lies where all studies share.
    assert made == [
        *("tiny--s0/base", "tiny--s0/base_scores", "tiny--s0/capture", "tiny--s0/prior", "tiny--s0/segmentation"),
        *("tiny--s1/base", "tiny--s1/base_scores", "tiny--s1/prior", "tiny--s1/segmentation"),
        *("tiny--two-mean-s0/base", "tiny--two-mean-s0/base_scores", "tiny--two-mean-s1/base", "tiny--two-mean-s1/base_scores"),
    ]


def test_second_run_does_nothing_and_all_is_verified(study):
    assert "Nothing to be done" in study.run("results/studies/two.parquet").stderr
    assert study.run("verify").returncode == 0


def test_a_second_study_shares_and_a_label_reruns_the_table_alone(study):
    study.write("lab/config/studies/other.yaml", STUDY.replace("title: Two ways", "title: Another").replace("mean:", "average:"))
    assert planned(study.run("-n", "results/studies/other.parquet")) == {"base", "base_scores", "study"}
    before = (study.folder / "lab/config/studies/two.yaml").read_text()
    study.write("lab/config/studies/two.yaml", before.replace("mean of an object", "object mean"))
    rules = planned(study.run("-n", "results/studies/two.parquet"))
    study.write("lab/config/studies/two.yaml", before)
    assert rules == {"study"}


SHARED = """\
title: Sizes
scenes: [tiny]
seeds: [0]
scores: common_scores
costs: [emission, metrics]
protocols: [raw, scaled]
common: {render: {samples: 2}, emission: {rows: 2000, samples: 4}, shading: {samples: 4, levels: 4}}
design:
  factors: {capture.views: [2, 3], capture.width + capture.height: [48, 64]}
  runs: ["00", "11"]
show: [albedo/psnr, rgb/psnr]
plot: {kind: pareto}
"""


def test_variants_of_other_photographs_are_planned_with_what_they_share(study):
    study.write("lab/config/studies/sizes.yaml", SHARED)
    rules = planned(study.run("-n", "results/studies/sizes.parquet"))
    assert rules >= {"capture", "affines", "metrics", "common_scores", "study"}


def test_variants_of_other_photographs_are_scored_at_the_views_that_they_share(study):
    study.write("lab/config/studies/sizes.yaml", SHARED)
    result = study.run("results/studies/sizes.parquet")
    assert result.returncode == 0, result.stderr[-4000:]
    frame = pd.read_parquet(study.folder / "results/studies/sizes.parquet")
    raw = frame[(frame["quantity"] == "albedo") & (frame["metric"] == "psnr") & (frame["protocol"] == "raw")].set_index("variant")
    assert raw["views"].tolist() == [3, 3] and raw.loc["00", "value"] != raw.loc["11", "value"]
    assert (raw["disk_mb"] > 0).all() and raw["cpu_seconds"].notna().all()
    assert (frame[frame["quantity"] == "rgb"]["value"] > 0).all() and set(frame["quantity"]) >= {"rgb", "emission", "metallic"}
    results = study.folder / "results"
    manifest = json.loads((results / "tiny--sizes-00-s0/common_scores/manifest.json").read_text())
    shared = json.loads((results / "tiny--s0/capture/manifest.json").read_text())
    assert manifest["inputs"]["shared_capture"]["fingerprint"] == shared["fingerprint"]
    assert manifest["inputs"]["capture"]["fingerprint"] != shared["fingerprint"]
    # The variant whose photographs are the shared ones has the scores that stage metrics finds in its own maps.
    own = pd.read_parquet(results / "tiny--sizes-11-s0/metrics/metrics.parquet")
    common = pd.read_parquet(results / "tiny--sizes-11-s0/common_scores/scores.parquet")
    keys, chosen = ["view", "quantity", "metric", "protocol"], ["albedo", "roughness", "metallic"]
    both = common[common["quantity"].isin(chosen)].merge(own, on=keys)
    both = both[both["metric"].isin(["psnr", "ssim"])]
    assert len(both) >= 3 * 8 and (abs(both["value_x"] - both["value_y"]) < 0.02).all()


@pytest.mark.parametrize(
    ("target", "text", "words"),
    [
        ("nothing", None, ["lab/config/studies/nothing.yaml", "two"]),
        ("bad", STUDY + "sedes: [3]\n", ["lab/config/studies/bad.yaml", "sedes", "seeds"]),
        ("bad", STUDY.replace("variant:", "varint:"), ["bad.yaml, variant mean", "base.varint", "variant"]),
        ("bad", STUDY.replace("plain:", "pl.ain:"), ["bad.yaml", "variants", "'pl.ain'"]),
        ("bad", SHARED.replace('"11"', '"12"'), ["design.runs", "'12'"]),
        ("bad", SHARED.replace("capture.views:", "views:"), ["design.factors", "views", "<section>.<key>"]),
        ("bad", SHARED.replace("  runs", "  trajectories: 2\n  runs"), ["capture.views", "trajectories", 4]),
        ("bad", STUDY.replace("[tiny, else", "[tinny, else"), ["scenes", "tinny", "tiny"]),
    ],
)
def test_mistakes_stop_before_any_job(study, target, text, words):
    if text:
        study.write("lab/config/studies/bad.yaml", text)
    result = study.run(f"results/studies/{target}.parquet")
    assert result.returncode != 0 and "Traceback" not in result.stderr and "Select jobs" not in result.stderr
    named(result.stderr, *words)
