"""Settings: defaults, precedence, and errors that name file, key, what was found and what is allowed."""

import pytest

from iif_core.errors import InputError
from workflow import settings
from workflow.registry import STAGES

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


def test_scene_over_preset_over_default(scene):
    root = scene(GOOD + "shading: {samples: 7}\n", "shading: {samples: 5, levels: 4}\n")
    got = settings.load("x", "draft", root)
    assert (got.shading.samples, got.shading.levels, got.shading.max_bounces) == (7, 4, 6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "capture: {veiws: 3}\n", ["x.yaml", "capture.veiws", "unknown key", "Did you mean `views`?", "Allowed here"]),
        (GOOD + "colour: 3\n", ["colour", "unknown key", "capture"]),
        (GOOD + "capture: {views: 0}\n", ["capture.views", "found 0", "greater than or equal to 1"]),
        (GOOD + "capture: {dynamic_range: mdr}\n", ["capture.dynamic_range", "'mdr'", "'ldr' or 'hdr'"]),
        ("source: {kind: builtin}\nprior: {kind: simulated, samples: 0}\n", ["prior.samples", "found 0"]),
        ("source: {kind: buildin}\nprior: {kind: simulated}\n", ["source.kind", "'buildin'", "builtin, mitsuba, folder"]),
        ("source: {kind: builtin}\nprior: {samples: 3}\n", ["prior.kind", "missing. Add it", "simulated, files"]),
        ("source: {kind: mitsuba}\nprior: {kind: simulated}\n", ["source.path", "missing"]),
        (GOOD + "affines: {scale: {kind: prior}}\n", ["`affines.scale.kind`: unknown key", "lamp, mean_albedo, white_patch"]),
        (GOOD + "affines: {scale: x}\n", ["`affines.scale`: found 'x'", "'found' or 'prior'; it may also be `key: value` pairs"]),
        (GOOD + "affines: {scale: {mean_albedo: 3}}\n", ["`affines.scale.mean_albedo`: found 3", "less than or equal to 1"]),
        ("source: {kind: mitsuba, path: 3}\nprior: {kind: simulated}\n", ["source.path", "found 3"]),
        ("prior: {kind: simulated}\n", ["`source`: missing"]),
        ("source: {kind: builtin\n", ["x.yaml", "line", "not valid YAML"]),
        ("- a\n- b\n", ["found list", "key: value"]),
        (GOOD + "capture: {views: 3, views: 5}\n", ["x.yaml, line 3", "`views` stands twice"]),
        ("source: builtin\nprior: {kind: simulated}\n", ["`source`", "'builtin'", "{kind: ...}"]),
        (GOOD + "base: {iterations: 100}\n", ["base", "`iterations`", "`solver: sgd` alone", "remove it"]),
        (GOOD + "base: {solver: sgd, sweeps: 3}\n", ["base", "`sweeps`", "`solver: direct` alone"]),
        (GOOD + "base: {predictions: 99}\n", ["`base: predictions` is 99", "`prior: samples` makes"]),
        (GOOD + "capture: {test_every: 1}\n", ["capture.test_every", "found 1", "2 and more"]),
    ],
)
def test_errors_tell_what_to_do(scene, text, words):
    root = scene(text)
    with pytest.raises(InputError) as caught:
        settings.load("x", "draft", root)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(("name", "words"), [("Küche 1", ["'Küche 1'", "letters from a to z"]), ("studies", ["results/ uses"])])
def test_scene_file_with_a_name_that_cannot_be(scene, name, words):
    root = scene(GOOD)
    (root / "config/scenes" / f"{name}.yaml").write_text(GOOD)
    with pytest.raises(InputError) as caught:
        settings.load(name, "draft", root)
    for word in [f"config/scenes/{name}.yaml", *words, "rename the file"]:
        assert word.lower() in str(caught.value).lower()


def test_scene_file_that_is_not_utf8(scene):
    root = scene(GOOD)
    (root / "config/scenes/x.yaml").write_bytes(GOOD.encode("utf-16"))
    with pytest.raises(InputError, match="x.yaml: not UTF-8 text"):
        settings.load("x", "draft", root)


def test_unknown_scene_suggests(scene):
    root = scene(GOOD)
    with pytest.raises(InputError, match="Did you mean scenes/x"):
        settings.load("xx", "draft", root)


def test_shipped_scenes_load_at_every_quality(repository):
    for name in settings.scene_names(repository):
        for quality in settings.QUALITIES:
            settings.load(name, quality, repository)


def test_generated_files_are_current(repository):
    assert (repository / "config/scene.schema.json").read_text() == settings.schema_json()
    assert (repository / "docs/settings.md").read_text() == settings.reference_markdown()


def test_bounds_are_words():
    text = settings.reference_markdown()
    assert "(at least 1, at most 64)" in text and "Ge(" not in text


def test_registry_is_ordered_and_its_settings_exist(repository):
    names = list(STAGES)
    assert all(names.index(needed) < names.index(stage.name) for stage in STAGES.values() for needed in stage.upstream)
    document = settings.dump(settings.load("kitchen", "draft", repository))
    for stage in STAGES.values():
        settings.select(document, stage.settings)
