"""SAM 2 behind segmentation `masks`, on a random checkpoint of its architecture: nothing is downloaded."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from iif_core.errors import InputError
from iif_core.objects.mask_proposals import point_grid, suppress_overlaps, threshold_stability
from tests.errors import misset, named, refused
from tests.unit import own_scene as own
from tests.unit import tiny_sam2
from workflow import settings as settings_module
from workflow.artifacts import StageReader
from workflow.models import checkpoint
from workflow.segmentations import masks, sam2

THRESHOLDS = {"points_per_side": 6, "confidence": 0.3, "stability": 0.2, "overlap": 0.5}


pytestmark = pytest.mark.usefixtures("offline")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a random checkpoint; not to be changed."""
    return tiny_sam2.make(tmp_path_factory.mktemp("sam2") / "tiny")


@pytest.fixture
def copied(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "sam2"))


def section(folder, **keys):
    """The settings' section as plain values, checked by the schema."""
    document = {"kind": "masks", "sam2": {"checkpoint": str(folder), "accept_license": True, **THRESHOLDS, **keys}}
    return settings_module.UNIONS["segmentation"]["masks"].model_validate(document).model_dump(mode="json")["sam2"]


def generator(folder, **keys):
    return sam2.Generator(SimpleNamespace(**section(folder, **keys)))


def picture(seed=0, shape=(5, 7)):
    return np.kron(np.random.default_rng(seed).random((*shape, 3)), np.ones((8, 8, 1))).astype(np.float32)


# ------------------------------------------------------------------------------------------------------------- the choice


def test_points_lie_in_the_middle_of_cells():
    np.testing.assert_allclose(point_grid(2), [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])


def test_stability_of_known_borders():
    """A ramp of 1 a pixel over 20 pixels, one of 4 a pixel, and nothing."""
    x = np.arange(20) - 10.5
    logits = np.stack([np.tile(slope * x, (3, 1)) for slope in (1, 4)] + [np.full((3, 20), -5.0)])
    np.testing.assert_allclose(threshold_stability(logits), [8 / 10, 1, 0])  # above 1: 8 columns; above -1: 10


def test_suppression_by_hand_and_by_loops():
    rows = np.zeros((4, 10, 13), bool)
    rows[0, :8], rows[1, :9], rows[2, 5:], rows[3, 6:] = True, True, True, True
    # 0 in 1: 8/9; 2 and 1: 4/10; 3 in 2: 4/5.
    np.testing.assert_array_equal(suppress_overlaps(rows, [0.5, 0.9, 0.7, 0.7], 0.75), [1, 2])
    np.testing.assert_array_equal(suppress_overlaps(rows, [0.5, 0.9, 0.7, 0.7], 0.85), [1, 2, 3])
    np.testing.assert_array_equal(suppress_overlaps(rows, [0.5, 0.5, 0.5, 0.5], 0.75), [0, 2])
    assert len(suppress_overlaps(rows[:0], [], 0.5)) == 0
    rng = np.random.default_rng(1)
    many, score = rng.random((60, 9, 9)) < rng.uniform(0.3, 0.95, (60, 1, 1)), rng.integers(0, 20, 60)
    kept = []
    for i in sorted(range(60), key=lambda i: (-score[i], i)):
        if all((many[i] & many[j]).sum() <= 0.5 * (many[i] | many[j]).sum() for j in kept):
            kept.append(i)
    assert 5 < len(kept) < 60
    np.testing.assert_array_equal(suppress_overlaps(many, score, 0.5), kept)


# --------------------------------------------------------------------------------------------------------------- the model


def test_proposals_are_those_of_the_model_asked_point_by_point(made):
    """One point at a time, from pixels, against the batches over one embedding; thresholds by hand."""
    image = picture()
    made_by = generator(made)
    found, score, lost = made_by.proposals(image)
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    square = torch.nn.functional.interpolate(planes, (64, 64), mode="bilinear", antialias=True)
    normal = (square - torch.tensor(sam2.MEAN)[:, None, None]) / torch.tensor(sam2.DEVIATION)[:, None, None]
    masks_expected, score_expected = [], []
    for x, y in point_grid(6).tolist():
        with torch.inference_mode():
            answer = made_by.model(
                pixel_values=normal,
                input_points=torch.tensor([[[[64 * x, 64 * y]]]]),
                input_labels=torch.ones((1, 1, 1), dtype=torch.int),
            )
        large = torch.nn.functional.interpolate(answer.pred_masks[0], image.shape[:2], mode="bilinear")[0].numpy()
        for logits, sure in zip(large, answer.iou_scores[0, 0].tolist(), strict=True):
            if sure > 0.3 and (logits > 0).any() and (logits > 1).sum() >= 0.2 * (logits > -1).sum():
                masks_expected.append(logits > 0)
                score_expected.append(sure)
    assert lost == 0 and 20 < len(found) == len(masks_expected) < 108
    np.testing.assert_allclose(score, score_expected, atol=1e-5)
    assert (found != np.array(masks_expected)).mean() < 1e-3  # rounding at logit 0
    labels, count, wrong = made_by.labels(image)
    assert count == len(found) and wrong == "" and labels.max() >= 2 and labels.shape == image.shape[:2]


def test_bytes_do_not_depend_on_threads_and_batches(made, monkeypatch):
    image, threads = picture(3, (6, 4)), torch.get_num_threads()
    made_by = generator(made)
    expected = made_by.labels(image)[0]
    try:
        torch.set_num_threads(3)
        np.testing.assert_array_equal(made_by.labels(image)[0], expected)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    monkeypatch.setattr(sam2, "MASKS_AT_ONCE", 3)
    np.testing.assert_array_equal(made_by.labels(image)[0], expected)


def test_the_published_checkpoints_hold_a_model_for_videos(tmp_path):
    folder = tiny_sam2.make(tmp_path / "video", video=True)
    assert json.loads((folder / "config.json").read_text())["model_type"] == "sam2_video"
    assert generator(folder).labels(picture())[0].max() >= 1


def test_answers_that_are_not_finite_and_views_without_masks(made, monkeypatch):
    made_by = generator(made, points_per_side=2)
    whole = made_by.proposals(picture())
    ask = made_by.model.forward

    def spoilt(**inputs):
        answer = ask(**inputs)
        answer.pred_masks[0, 0, 1, 2, 3] = torch.nan
        answer.iou_scores[0, 3] = torch.inf
        return answer

    monkeypatch.setattr(made_by.model, "forward", spoilt)
    found, _, lost = made_by.proposals(picture())
    assert lost == 4 and len(found) < len(whole[0])
    assert made_by.labels(picture())[2] == "4 answers are not finite"
    labels, count, wrong = generator(made, confidence=1.0).labels(picture())
    assert not labels.any() and count == 0 and "no mask passed" in wrong


def test_only_what_is_more_confident_than_the_limit_is_a_mask(made):
    scores = generator(made, confidence=0.0, stability=0.0).proposals(picture())[1]
    limit = float(np.sort(scores)[len(scores) // 2])
    found = generator(made, confidence=limit, stability=0.0).proposals(picture())[1]
    np.testing.assert_array_equal(found, scores[scores > limit])


# --------------------------------------------------------------------------------------------------------------- the stage


def scene(root, folder, **keys):
    """Four photographs of the room, captured."""
    sizes = {"points_per_side": 4, "confidence": 0.0, "stability": 0.0}
    chosen = {"kind": "masks", "colour": 0.0, "sam2": {"checkpoint": str(folder), "accept_license": True} | sizes | keys}
    own.photographed(own.project(root, segmentation=chosen), 4, depth=False)
    return own.run(root, "capture")


def content(root):
    folder = root / "results/own/segmentation"
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_killed_stage_goes_on_where_it_was(made, tmp_path, monkeypatch):
    capture = scene(tmp_path, made)
    asked, kill, labels = [], [2], sam2.Generator.labels

    def counted(self, image):
        if len(asked) in kill:
            kill.clear()
            raise KeyboardInterrupt
        asked.append(image)
        found, count, wrong = labels(self, image)
        return (0 * found, 0, "no mask passed") if len(asked) % 4 == 1 else (found, count, wrong)  # the first view fails

    monkeypatch.setattr(sam2.Generator, "labels", counted)
    with pytest.raises(KeyboardInterrupt):
        own.run(tmp_path, "segmentation")
    own.run(tmp_path, "segmentation")
    assert len(asked) == 4  # two of four views were done
    resumed = content(tmp_path)
    own.run(tmp_path, "segmentation")
    assert len(asked) == 8 and content(tmp_path) == resumed
    reader = StageReader(tmp_path / "results/own/segmentation", "segmentation", "own")
    table, document = reader.table("masks.parquet"), reader.json("segmentation.json")
    assert table["reason"].tolist() == ["no mask passed", "", "", ""] and table["masks"][0] == 0
    assert table["masks"][1:].min() >= 1 and (table["proposals"] >= table["masks"]).all()
    assert document["masks"] > 0 and reader.json("model.json")["published_as"] == "facebook/sam2.1-hiera-large"
    # The label maps are in the form that `masks` reads.
    from workflow.segmentations.mask_files import mask_files

    stored = tmp_path / "results/own/segmentation/masks"
    settings = own.settings_of(tmp_path / "data/own")
    files = mask_files({"path": str(stored)}, settings["source"], settings["capture"])
    for view in capture:
        np.testing.assert_array_equal(files.labels(view), reader.exr(f"masks/{view.name}.exr")["mask.id"])


def test_no_mask_in_any_view_is_refused(made, tmp_path):
    scene(tmp_path, made, confidence=1.0)
    with refused("SAM 2", 4, "checkpoint", "segmentation"):
        own.run(tmp_path, "segmentation")


# ----------------------------------------------------------------------------------------------------------------- refused


def refusal(folder, **keys):
    with pytest.raises(InputError) as error:
        masks.raw_inputs({"segmentation": {"sam2": section(folder, **keys)}})
    return str(error.value)


def test_a_good_checkpoint_is_its_files(made):
    assert [path.name for path in masks.raw_inputs({"segmentation": {"sam2": section(made)}})] == [
        "config.json",
        "model.safetensors",
    ]


def test_what_is_refused(copied, tmp_path, monkeypatch):
    model, licence = "facebook/sam2.1-hiera-large", "Apache License 2.0"
    agree = "segmentation: {sam2: {accept_license: true}}"
    named(refusal(copied, accept_license=False), "segmentation.sam2.accept_license", model, licence, agree)
    named(refusal(tmp_path / "nowhere"), tmp_path / "nowhere", "segmentation.sam2.checkpoint", f"hf download {model}", licence)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    named(refusal(model), "segmentation.sam2.checkpoint", tmp_path / "hub", f"hf download {model}", licence)
    monkeypatch.setattr(checkpoint.importlib.metadata, "version", lambda _: "2.13.0+cpu")
    named(refusal(copied, device="cuda"), "segmentation.sam2.device", "cuda", "2.13.0+cpu", "envs/README.md")
    config = json.loads((copied / "config.json").read_text())
    (copied / "config.json").write_text(json.dumps({**config, "model_type": "sam"}))
    named(refusal(copied), copied / "config.json", "`model_type`", "sam", "sam2 or sam2_video")
    (copied / "config.json").unlink()
    named(refusal(copied), copied / "config.json", "segmentation.sam2.checkpoint", "docs/guide/segmentation.md")


def test_damaged_weights_are_refused(copied):
    from safetensors.torch import load_file, save_file

    stored = copied / "model.safetensors"
    tensors = load_file(stored)
    tensors.pop("mask_decoder.iou_token.weight")
    save_file(tensors, stored, {"format": "pt"})
    with refused(copied, 1, "mask_decoder.iou_token.weight", "config.json"):
        generator(copied)
    whole = stored.read_bytes()
    stored.write_bytes(whole[:-100])
    named(refusal(copied), stored, len(whole) - 100, len(whole))
    stored.rename(copied / "model.bin")
    named(refusal(copied), copied, "model.safetensors", "model.bin")


def test_masks_come_from_one_place():
    with misset("", "value_error", "path", "sam2"):
        settings_module.UNIONS["segmentation"]["masks"].model_validate({"kind": "masks", "path": "x", "sam2": {}})
