"""Settings: defaults, precedence, and errors that name file, key, what was found and what is allowed."""

import itertools
import runpy
from dataclasses import fields
from pathlib import Path

import pytest

from iif_core.errors import InputError
from iif_core.fusion.options import FusionOptions
from tests.errors import missing, refused
from workflow import settings
from workflow.registry import STAGES
from workflow.settings import batch_table, loading, yaml_file
from workflow.settings.names import did_you_mean_path

GOOD = "source: {kind: builtin}\nprior: {kind: simulated}\n"


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/quality").mkdir()

    def write(text, quality=""):
        (tmp_path / "config/scenes/x.yaml").write_text(text)
        (tmp_path / "config/quality/draft.yaml").write_text(quality)
        return tmp_path

    return write


@pytest.mark.parametrize(
    ("text", "pixels", "noise"),
    [
        ("affines: {pixels: 5000}", 5000, 0.2),
        ("affines: {texture: photographs}", "all", 0.1),
        ("shading: {pixels: all}", "all", 0.2),
        ("shading: {pixels: 300000}", 300_000, 0.2),
    ],
)
def test_what_is_read_decides_where_specular_light_is_traced_and_how_noisy_diffuse_light_may_be(scene, text, pixels, noise):
    shading = settings.dump(settings.load("x", "draft", scene(f"{GOOD}{text}\n")))["shading"]
    assert (shading["pixels"], shading["noise"]) == (pixels, noise)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("source: {kind: photographs, path: a, room_height: '2,6'}", ["source.room_height", "'2,6'", "2.6"]),
        ("source: {kind: photographs, path: a, room_height: 2,6}", ["2.6", "line 1"]),  # two entries to YAML
        ("source:\n  kind: photographs\n  path: a\n  room_height: 2,6", ["source.room_height", "'2,6'", "2.6"]),
        ("source: {kind: photographs, path: a, room_height: 2.6 m}", ["source.room_height", "'2.6 m'", "2.6"]),
        ("source: {kind: photographs, path: a, room_height: 260}", ["source.room_height", 260, "metres"]),
        ("source: {kind: folder, path: a, room_height: 2.6}", ["source.room_height", "`kind: photographs`"]),
        ("source:\n  kind: folder\n  path:a\n", ["line", "space"]),
        ("source: {kind:folder, path: a}", ["kind: folder", "space"]),
        ("source:\n  kind:folder\n", ["source", "kind: folder", "space"]),
        ("source:\n  kind:folder\n  path: a\n", ["line 3", "space"]),
        ("source: {kind: folder, path: a, unit: milimetre}", ["source.unit", "'milimetre'", "'mm'", "a number"]),
        ("source: {kind: folder, path: a, unit: Feet}", ["source.unit", "'ft'"]),
        ("source: {kind: folder, path: a}\ncapture: {exposure: automatic}", ["capture.exposure", "'automatic'", "'auto'"]),
    ],
)
def test_what_people_write_is_told_in_the_form_that_works(scene, text, names):
    with refused("config/scenes/x.yaml", *names):
        settings.load("x", "draft", scene(f"{text}\n"))


def test_noise_of_the_light_can_be_set(scene):
    for text in ("0.05", "5e-2", "'0.05'"):  # YAML reads a number without a dot and with an exponent as a word
        assert settings.load("x", "draft", scene(f"{GOOD}shading: {{noise: {text}}}\n")).shading.noise == 0.05
    for wrong in ("0", "-0.1", "some", "true"):
        with refused("config/scenes/x.yaml", "shading.noise", "'auto'", 0) as error:
            settings.load("x", "draft", scene(f"{GOOD}shading: {{noise: {wrong}}}\n"))
        assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("shading: {pixels: 1000}\naffines: {pixels: 5000}", ["shading: pixels", 1000, "affines: pixels", "`5000`"]),
        ("shading: {pixels: 1000}\naffines: {texture: photographs}", ["shading: pixels", 1000, "texture", "`all`"]),
        ("shading: {pixels: some}", ["shading.pixels", "'some'", "'auto', 'all'", 100]),
        ("shading: {pixels: 5}", ["shading.pixels", 5, "'auto', 'all'", 100]),
        ("shading: {pixels: true}", ["shading.pixels", True, "'auto', 'all'", 100]),
    ],
)
def test_pixels_of_specular_light_that_cannot_be(scene, text, names):
    with refused("config/scenes/x.yaml", *names) as caught:
        settings.load("x", "draft", scene(f"{GOOD}{text}\n"))
    assert "constrained" not in str(caught.value)


def test_scene_over_preset_over_default(scene):
    root = scene(GOOD + "shading: {samples: 7}\n", "shading: {samples: 5, levels: 4}\n")
    got = settings.load("x", "draft", root)
    assert (got.shading.samples, got.shading.levels, got.render.samples) == (7, 4, 16)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (GOOD + "capture: {veiws: 3}\n", ["capture.veiws", "`views`", "samples, test_every, views, width"]),
        (GOOD + "capture: {Views: 3}\n", ["capture.Views", "`views`"]),
        (GOOD + "affines: {VIEWS: 3}\n", ["affines.VIEWS", "batch, epochs, iterations"]),
        (GOOD + "colour: 3\n", ["colour", "affines, base, capture"]),
        (
            GOOD + "override: {components: {specular: off}}\n",
            ["override", "`components`"],
        ),
        (GOOD + "overrides: {window frame: {metallic: 0}}\n", ["overrides", "`materials`"]),
        (GOOD + "capture: {views: 0}\n", ["capture.views", 0, 1]),
        (GOOD + "capture: {dynamic_range: mdr}\n", ["capture.dynamic_range", "'mdr'", "'ldr' or 'hdr'"]),
        ("source: {kind: builtin}\nprior: {kind: simulated, samples: 0}\n", ["prior.samples", 0, 1]),
        (
            "source: {kind: buildin}\nprior: {kind: simulated}\n",
            ["source.kind", "'buildin'", "folder, photographs, scannetpp, fipt, builtin, drawn, mitsuba"],
        ),
        ("source: {kind: builtin}\nprior: {samples: 30}\n", ["prior.samples", 30, 16]),
        ("source: {kind: mitsuba}\nprior: {kind: simulated}\n", ["source.path", "config/scenes/kitchen.yaml"]),
        (GOOD + "affines: {scale: {kind: prior}}\n", ["affines.scale.kind", "lamp, mean_albedo, white_patch"]),
        (GOOD + "affines: {scale: x}\n", ["affines.scale", "'x'", "'found' or 'prior'", "key: value"]),
        (GOOD + "affines: {scale: {mean_albedo: 3}}\n", ["affines.scale.mean_albedo", 3, 1]),
        ("source: {kind: mitsuba, path: 3}\nprior: {kind: simulated}\n", ["source.path", 3]),
        ("source: {kind: builtn}\nprior: {kind: simulated}\n", ["source.kind", "'builtn'", "builtin"]),
        (f"{GOOD}affines: {{response: srg}}\n", ["affines.response", "'srg'", "srgb"]),
        (f"{GOOD}affines: {{pixels: some}}\n", ["affines.pixels", "'some'", "'all'", 100]),
        ("prior: {kind: simulated}\n", ["source", "config/scenes/kitchen.yaml"]),
        ("source: {kind: builtin\n", ["line 2", "YAML"]),
        (GOOD + "relight: [{name: off}]\n", ["relight.0.name", "False", "`off`", "quotes"]),
        ("- a\n- b\n", ["list", "key: value"]),
        (GOOD + "capture: {views: 3, views: 5}\n", ["line 3", "`views`"]),
        ("source: builtin\nprior: {kind: simulated}\n", ["source", "'builtin'", "source: {kind: ...}"]),
        (GOOD + "metrics: {views: 0}\n", ["metrics.views", 0, 1]),
        (GOOD + "affines: {ridge: 0.1}\n", ["affines.ridge"]),
        (GOOD + "base: {predictions: 99}\n", ["base: predictions", 99, "`prior`", 8]),
        (GOOD + "capture: {test_every: 1}\n", ["capture.test_every", 1, 0, 2]),
    ],
)
def test_errors_tell_what_to_do(scene, text, names):
    root = scene(text)
    with refused("config/scenes/x.yaml", *names):
        settings.load("x", "draft", root)


@pytest.mark.parametrize(("name", "names"), [("Küche 1", ["'Küche 1'", "a to z"]), ("studies", ["'studies'", "results/"])])
def test_scene_file_with_a_name_that_cannot_be(scene, name, names):
    root = scene(GOOD)
    (root / "config/scenes" / f"{name}.yaml").write_text(GOOD)
    with refused(f"config/scenes/{name}.yaml", *names):
        settings.load(name, "draft", root)


def test_scene_file_that_is_not_utf8(scene):
    root = scene(GOOD)
    (root / "config/scenes/x.yaml").write_bytes(GOOD.encode("utf-16"))
    with refused("x.yaml", "UTF-8"):
        settings.load("x", "draft", root)


def test_defaults_are_those_of_the_solvers(repository):
    from iif_core.fitting.problem import FitOptions

    tree = settings.SceneSettings(source={"kind": "builtin"}, prior={"kind": "simulated"})
    for section, options in (
        (tree.affines, FitOptions()),
        (tree.base, FusionOptions()),
    ):
        shared = set(type(section).model_fields) & {field.name for field in fields(options)}
        assert {name: getattr(section, name) for name in shared} == {name: getattr(options, name) for name in shared}


def test_a_folder_without_configuration_uses_that_of_the_repository(tmp_path, repository):
    assert settings.load("kitchen", "standard", tmp_path) == settings.load("kitchen", "standard", repository)
    assert batch_table.read_table(tmp_path) == batch_table.read_table(repository)


def test_a_folder_with_scenes_of_its_own_uses_these_alone_with_the_presets_of_the_repository(scene, repository):
    root = scene(GOOD)
    (root / "config/quality/draft.yaml").unlink()
    paper = settings.read_yaml(repository / "config/quality/paper.yaml")
    assert settings.load("x", "paper", root).capture.views == paper["capture"]["views"] != 16
    assert [line.name for line in batch_table.read_table(root)] == ["x"]
    with refused("config/scenes/kitchen.yaml", "x"):
        settings.load("kitchen", "draft", root)


def test_a_scene_file_with_the_other_suffix_is_named(scene):
    root = scene(GOOD)
    (root / "config/scenes/x.yaml").rename(root / "config/scenes/room.yml")
    with refused("config/scenes/room.yaml", "room.yml"):
        settings.load("room", "draft", root)


def test_a_path_with_a_similar_name_beside_it_is_suggested(tmp_path):
    (tmp_path / "data/office-3/images").mkdir(parents=True)
    assert did_you_mean_path(tmp_path / "data/ofice-3/images") == f" Did you mean {tmp_path}/data/office-3/images?"
    assert did_you_mean_path(tmp_path / "data/ofice-3/photos") == f" Did you mean {tmp_path}/data/office-3?"
    assert did_you_mean_path(Path("~/data")) == " `~` is not expanded here; write the whole path."
    assert did_you_mean_path(tmp_path / "dta/office-3") == f" Did you mean {tmp_path}/data/office-3?"
    assert did_you_mean_path(tmp_path / "data/kitchen") == did_you_mean_path(tmp_path / "data/office-3/images/0.png") == ""


def test_unknown_scene_suggests(scene):
    root = scene(GOOD)
    with refused("config/scenes/xx.yaml", "scenes/x"):
        settings.load("xx", "draft", root)


def test_shipped_scenes_load_at_every_quality(repository):
    for quality, name in itertools.product(settings.QUALITIES, settings.scene_names(repository)):
        settings.load(name, quality, repository)


def test_the_kitchen_can_be_relit_as_it_is_shipped(repository):
    plan = settings.active_plan("kitchen", repository)
    document = settings.dump(settings.load(f"kitchen--relight-{plan}-s0", "draft", repository))
    names = [entry["name"] for entry in settings.require_relighting(document, "kitchen")]
    assert plan == "kitchen" and {"dimmed", "evening", "vase", "lamp"} <= set(names)


def test_the_page_has_ranges_and_each_line_once(repository):
    text = runpy.run_path(str(repository / "docs/site/settings_page.py"))["reference_markdown"]()
    assert "(1 to 64)" in text and "(> 0)" in text and "Ge(" not in text
    lines = [line for line in text.splitlines() if line.startswith("| `")]
    assert len(lines) == len(set(lines)) and "Also of `learned`: `seed`." in text


def test_registry_is_ordered_and_its_settings_exist(repository):
    names = list(STAGES)
    assert all(names.index(needed) < names.index(stage.name) for stage in STAGES.values() for needed in stage.upstream)
    document = settings.dump(settings.load("kitchen", "draft", repository))
    for stage in STAGES.values():
        settings.select(document, stage.settings)


def test_yaml_is_read_alike_with_and_without_libyaml(tmp_path, monkeypatch):
    """An anchor is written out, a key that stands twice or merges another mapping is refused, and what is wrong is named."""
    path, found = tmp_path / "x.yaml", []
    for loader in (yaml_file._FastLoader, yaml_file._StrictLoader):
        monkeypatch.setattr(yaml_file, "_FastLoader", loader)
        path.write_text("a: &a {x: 1, y: 2}\nb: *a\n")
        found.append([yaml_file.read_yaml(path)])
        for wrong in ("a: 1\nb: {x: 1,\n  x: 2}\n", "a: *nobody\n", "a: [1\nb: 2\n", "a: %x\n", "a: &a {x: 1}\nb: {<<: *a}\n"):
            path.write_text(wrong)
            with pytest.raises(InputError) as error:
                yaml_file.read_yaml(path)
            found[-1].append(str(error.value))
    assert found[0] == found[1]
    assert found[0][0]["b"] == {"x": 1, "y": 2} and "`<<`" in found[0][5]
    assert not missing(found[0][1], "line 3", "`x`") and "nobody" in found[0][2]


@pytest.mark.parametrize(
    ("words", "section", "key", "value"),
    [
        ("environment: off", "emission", "environment", "off"),
        ("environment: on", "emission", "environment", "on"),
        ("radiance_cache: off", "shading", "indirect", "path"),
        ("radiance_cache: on", "shading", "indirect", "cache"),
        ("denoiser: off", "render", "denoise", False),
        ("denoiser: off", "room", "denoise", False),
        ("environment: on", "render", "denoise", True),
        ("specular: off", "emission", "environment", "auto"),
    ],
)
def test_stages_read_a_forced_component(scene, words, section, key, value):
    found = settings.dump(settings.load("x", "draft", scene(f"{GOOD}components: {{{words}}}\n")))
    assert found[section][key] == value


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("emission: {environment: on}", ["emission.environment", "`components.environment`"]),
        ("render: {denoise: false}", ["render.denoise", "`components.denoiser`"]),
        ("shading: {indirect: path}", ["shading.indirect", "`components.radiance_cache`"]),
        ("components: {metallic: on}", ["components.metallic", "'on'", "'auto' or 'off'"]),
        ("components: {gloss: off}", ["components.gloss", "specular"]),
        ("components: {specular: maybe}", ["components.specular", "'maybe'", "'auto', 'on' or 'off'"]),
    ],
)
def test_an_override_that_cannot_be(scene, text, names):
    with refused("config/scenes/x.yaml", *names):
        settings.load("x", "draft", scene(f"{GOOD}{text}\n"))


def test_limits_of_a_scene_hold_for_every_quality_and_raise_nothing(repository, tmp_path, monkeypatch):
    (tmp_path / "config/scenes").mkdir(parents=True)
    text = "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\nlimits: {views: 20, width: 200, predictions: 6}\n"
    (tmp_path / "config/scenes/t.yaml").write_text(text)
    draft, paper = (settings.load("t", quality, tmp_path) for quality in ("draft", "paper"))
    assert (paper.capture.views, paper.capture.width, paper.capture.height, paper.prior.samples) == (20, 200, 200, 6)
    assert draft.capture.views <= 20 and draft.capture.width <= 200 and draft.prior.samples <= 6
    (tmp_path / "config/scenes/t.yaml").write_text(text + "capture: {views: 30}\n")  # what the scene sets itself, holds
    assert settings.load("t", "paper", tmp_path).capture.views == 30
    (tmp_path / "config/scenes/t.yaml").write_text(text.replace("width: 200", "width: 320, height: 240"))
    wide = settings.load("t", "paper", tmp_path).capture  # a photograph of 320 x 240 stays as it is
    assert (wide.width, wide.height) == (320, 240)
    (tmp_path / "config/scenes/t.yaml").write_text(text.replace("views: 20", "views: 0"))
    with refused("config/scenes/t.yaml", "limits.views", 0, 1):
        settings.load("t", "draft", tmp_path)


@pytest.mark.parametrize(
    ("draft", "names"),
    [
        ("quality: draft\n", ["quality", "'draft'", "p01"]),
        ("quality: nowhere\n", ["quality", "'nowhere'", "p01"]),
        ("quality: [p01]\n", ["quality", "['p01']"]),
        ("capture: {veiws: 3}\n", ["capture.veiws", "`views`"]),
        ("quality: p01\nmetrics: {veiws: 3}\n", ["metrics.veiws", "`views`"]),
    ],
)
def test_mistakes_in_a_quality_are_blamed_on_its_file(tmp_path, draft, names):
    for part in ("scenes", "quality"):
        (tmp_path / "config" / part).mkdir(parents=True)
    (tmp_path / "config/scenes/t.yaml").write_text("source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\n")
    (tmp_path / "config/quality/draft.yaml").write_text(draft)
    with refused("config/quality/draft.yaml", *names):
        settings.load("t", "draft", tmp_path)


def test_a_quality_may_be_a_point_with_a_change_and_a_point_alone_is_known_by_its_name(tmp_path):
    for part in ("scenes", "quality"):
        (tmp_path / "config" / part).mkdir(parents=True)
    (tmp_path / "config/scenes/t.yaml").write_text("source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\n")
    (tmp_path / "config/quality/p91.yaml").write_text("capture: {views: 9, width: 90}\nprior: {samples: 3}\n")
    (tmp_path / "config/quality/draft.yaml").write_text("quality: p91\ncapture: {views: 7}\n")
    found = settings.load("t", "draft", tmp_path)
    assert (found.capture.views, found.capture.width, found.prior.samples) == (7, 90, 3)
    assert loading.canonical("p91", tmp_path) == "p91"
    (tmp_path / "config/quality/draft.yaml").write_text("quality: p91\n")
    assert loading.canonical("p91", tmp_path) == "draft" and loading.canonical("paper", tmp_path) == "paper"
    assert loading.overridden("t", "p91", tmp_path) == []
    (tmp_path / "config/scenes/t.yaml").write_text("source: {kind: builtin, scene: tiny}\nprior: {kind: simulated, samples: 5}\n")
    assert loading.overridden("t", "draft", tmp_path) == ["prior.samples"]
    (tmp_path / "config/scenes/t.yaml").write_text(
        "source: {kind: builtin, scene: tiny}\nprior: {kind: simulated}\nlimits: {views: 8, width: 200}\n"
    )
    assert loading.overridden("t", "draft", tmp_path) == ["capture.views"]


def test_a_bench_of_a_scene_that_is_not_there_says_so(tmp_path):
    (tmp_path / "config/scenes").mkdir(parents=True)
    with refused("config/scenes/typo.yaml"):
        settings.load("typo--bench-p01-s0", "draft", tmp_path)


def test_a_comparison_needs_two_names(repository):
    with refused("compare/kitchen", "compare/kitchen,country-kitchen"):
        settings.refuse_target("compare/kitchen", [], repository)


def test_a_name_that_no_scene_can_have_is_not_proposed(scene):
    root = scene("source: {kind: folder, path: a}\n")
    (root / "config/scenes/x.yaml").rename(root / "config/scenes/my room.yaml")
    with refused("plan/my room", "config/scenes/my room.yaml"):
        settings.refuse_target("plan/my room", [], root)


def test_the_profiles_of_slurm_know_every_stage(repository):
    """A stage that no group names would be a job by itself between those of its scene."""
    from workflow.registry import STAGES

    stages = {name for name, stage in STAGES.items() if not stage.on_demand} - {"publish"}
    whole = yaml_file.read_yaml(repository / "workflow/profiles/slurm-scenes/config.yaml")
    assert {group.partition("=")[0] for group in whole["groups"]} == stages
    single = yaml_file.read_yaml(repository / "workflow/profiles/slurm/config.yaml")
    assert set(single["set-threads"]) - {"prior_part"} == stages - {"plan"}
