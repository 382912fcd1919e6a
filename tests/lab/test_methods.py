"""Settings that choose another method than ours: defaults, what must go together, which module runs, how presets are named."""

from dataclasses import fields

import pytest
from pydantic import ValidationError

from lab import methods
from lab.published.fitting.sgd import SgdOptions
from lab.published.fusion.direct import POLISH
from tests.errors import refused
from workflow import settings
from workflow.costs.model import predict
from workflow.costs.work import SceneSize, work_of
from workflow.runtime import fingerprint as fp

GOOD = {"source": {"kind": "builtin"}, "prior": {"kind": "simulated"}, "capture": {"dynamic_range": "ldr"}}
PUBLISHED = {"emission": {"solver": "published"}, "shading": {"method": "published"}}


def of(**sections):
    return settings.SceneSettings.model_validate({**GOOD, **sections})


def test_defaults_are_ours_and_those_of_the_solvers():
    plain = of()
    assert (plain.base.solver, plain.emission.solver, plain.shading.method) == ("direct", "direct", "shared_paths")
    assert (plain.base.variant, plain.affines.model, plain.affines.solver, plain.base.polish) == (
        "full",
        "objects",
        "direct",
        POLISH,
    )
    shared = set(type(plain.affines).model_fields) & {field.name for field in fields(SgdOptions)}
    assert shared == {"epochs", "batch", "rate", "steps"}
    assert all(getattr(plain.affines, name) == getattr(SgdOptions(), name) for name in shared)


@pytest.mark.parametrize(
    ("sections", "pixels", "noise"),
    [
        ({"affines": {"model": "object_mean"}}, 200_000, 0.2),
        ({"affines": {"model": "object_mean", "texture": "photographs"}}, 200_000, 0.2),
        ({"affines": {"model": "fipt"}}, "all", 0.1),
    ],
)
def test_free_cells_read_every_pixel(sections, pixels, noise):
    shading = settings.dump(of(**sections))["shading"]
    assert (shading["pixels"], shading["noise"]) == (pixels, noise)


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"shading": {"pixels": 1000}, "affines": {"model": "iris"}}, ["`shading: pixels` is 1000", "model: iris", "`all`"]),
        ({"base": {"solver": "sgd", "variant": "uniform"}}, ["`solver: sgd`", "`variant: full`"]),
        ({"base": {"objective": "distribution", "variant": "texel_mean"}}, ["makes none"]),
        ({"affines": {"model": "fipt", "solver": "sgd"}}, ["`solver: sgd` does not fit `model: fipt`", "adam"]),
        ({**PUBLISHED, "affines": {"response": {"file": "c.csv"}}}, ["no measured curve"]),
        ({**PUBLISHED, "capture": {"dynamic_range": "hdr"}}, ["8-bit photographs"]),
        ({**PUBLISHED, "components": {"specular": "off"}}, ["has no plan"]),
        ({"affines": {"model": "base"}, "components": {"metallic": "off"}}, ["needs `affines"]),
        ({"affines": {"solver": "adam"}, "materials": {"floor": {"roughness": 0.5}}}, ["given by hand"]),
    ],
)
def test_what_does_not_go_together_is_refused(sections, words):
    with pytest.raises(ValidationError) as caught:
        of(**sections)
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize(
    ("sections", "replaced"),
    [
        ({}, {}),
        (PUBLISHED, dict.fromkeys(("plan", "emission", "shading"), "lab.published.stages")),
        ({"base": {"solver": "sgd"}}, dict.fromkeys(("base", "second_look"), "lab.published.stages")),
        ({"base": {"variant": "raw"}}, dict.fromkeys(("base", "second_look"), "lab.published.stages")),
        ({"base": {"judge": True, "preset": "paper"}}, dict.fromkeys(("base", "second_look"), "lab.published.stages")),
        ({"affines": {"solver": "adam"}}, {"affines": "lab.published.stages"}),
        ({"affines": {"model": "iris", "solver": "adam"}}, {"affines": "lab.baselines"}),
        ({"base": {"hash_levels": 4}, "emission": {"iterations": 5}, "affines": {"epochs": 1}}, {}),
    ],
)
def test_settings_choose_the_modules_of_stages(sections, replaced):
    document = settings.dump(of(**sections))
    for stage in fp.NEEDED:
        module = fp.module_of(stage, document)
        assert module.startswith(replaced.get(stage, f"workflow.stages.{stage}")), stage


def test_nobody_has_measured_what_takes_the_place_of_a_stage():
    document = settings.dump(of(**PUBLISHED))
    work = work_of("shading", document, SceneSize(8, 1e6, 1e4))
    assert work.kind == "lab.published.stages.shading" and predict("shading", work).seconds is None
    assert work_of("base", document, SceneSize(8, 1e6, 1e4)).kind == "direct"


@pytest.fixture
def study(tmp_path):
    """`study(variant)`: the folder of a scene `t` and of a study `a` with one variant, `theirs`, as YAML."""
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "lab/config/studies").mkdir(parents=True)
    scene = "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\nbase: {solver: sgd, texture: cells, iterations: 5}\n"
    (tmp_path / "config/scenes/t.yaml").write_text(scene)
    (tmp_path / "lab/config/studies/scenes.yaml").write_text("t: {}\n")

    def write(variant):
        (tmp_path / "lab/config/studies/a.yaml").write_text(f"title: x\nscenes: [t]\nvariants:\n  theirs: {variant}\n")
        return tmp_path

    return write


def test_a_preset_lies_between_the_scene_and_the_variant(study):
    got = settings.load("t--a-theirs-s0", "draft", study("{preset: published, overrides: {emission: {iterations: 7}}}"))
    assert (got.base.solver, got.emission.solver, got.affines.solver) == ("sgd", "published", "published")
    assert (got.base.preset, got.base.texture, got.base.iterations) == ("paper", None, None)  # not those of the scene
    assert (got.emission.samples, got.emission.iterations, got.affines.pixels, got.shading.pixels) == (128, 7, "all", "all")
    repaired = settings.load("t--a-theirs-s0", "draft", study("{preset: published_repaired}"))
    assert (repaired.base.preset, repaired.base.texture, repaired.emission.solver) == ("safe", "hashgrid", "published_repaired")


def test_a_preset_that_is_not_there_is_refused_with_those_that_are(study):
    with refused("lab/config/studies/presets/publshed.yaml", "published", "published_repaired"):
        settings.load("t--a-theirs-s0", "draft", study("{preset: publshed}"))


def test_settings_without_the_laboratory_s_mean_the_product():
    """Manifests of stages that the product ran have none of them, and costs are gathered from manifests."""
    settings = {stage: {} for stage in ("base", "emission", "shading", "affines")}
    stages = methods.base, methods.emission, methods.shading, methods.second_look, methods.affines
    assert [stage(settings) for stage in stages] == [None] * 5
    assert methods.affines({**settings, "affines": {"solver": "adam"}}) and methods.base({**settings, "base": {"judge": True}})
