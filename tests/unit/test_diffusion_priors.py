"""Priors rgbx and marigold on random checkpoints of 1 MB: loading, sampling, resuming, refusing; without a network."""

import json
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from iif_core.errors import InputError
from iif_core.numerics.color import key_exposure, linear_from_srgb, luminance, srgb_from_linear
from lab import plugins
from tests.errors import named, refused
from tests.unit import tiny_diffusion
from workflow import settings as settings_module
from workflow.artifacts import StageReader, StageWriter
from workflow.models import checkpoint
from workflow.priors import diffusion, marigold, rgbx
from workflow.scene.normal_form import View
from workflow.scene.photograph import picture_for_model
from workflow.scene.predictions import StoredPredictions
from workflow.stages import prior as stage

MODULES = {"rgbx": rgbx, "marigold": marigold}
HEIGHT, WIDTH = 40, 56
DEVICE = os.environ.get("IIF_TEST_DEVICE", "cpu")
EXACT = {"samples": 4, "longest_side": 64, "steps": 3, "device": DEVICE, "precision": "float32"}


pytestmark = pytest.mark.usefixtures("offline")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """kind -> folder of a random checkpoint; not to be changed."""
    root = tmp_path_factory.mktemp("checkpoints")
    return {kind: tiny_diffusion.make(root / kind, kind) for kind in MODULES}


@pytest.fixture
def copied(made, tmp_path):
    """kind -> a copy that a test may spoil."""
    return {kind: Path(shutil.copytree(folder, tmp_path / kind)) for kind, folder in made.items()}


def section(kind, folder, **keys):
    """Settings of a prior as plain values, checked by the schema."""
    document = {"kind": kind, "checkpoint": str(folder), "accept_license": True, **EXACT, **keys}
    model = settings_module.UNIONS["prior"][kind]
    return model.model_validate(document).model_dump(mode="json")


def namespace(kind, folder, **keys):
    return SimpleNamespace(prior=SimpleNamespace(**section(kind, folder, **keys)))


class Capture:
    """Photographs alone, one a view, drawn from its number."""

    def __init__(self, views=1, is_hdr=False):
        self.is_hdr = is_hdr
        self.views = [View(i, f"v{i}", WIDTH, HEIGHT, 50.0, 50.0, 28.0, 20.0, np.eye(4)) for i in range(views)]

    @property
    def used(self):
        return self.views

    def faces(self):
        return {"face_id": np.arange(2, dtype=np.int32)}

    def gbuffer(self, view):
        return np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.int32)

    def photo(self, view):
        rng = np.random.default_rng(view.view_id)
        picture = np.kron(rng.random((5, 7, 3)), np.ones((8, 8, 1))).astype(np.float32)
        valid = np.ones((HEIGHT, WIDTH), bool)
        valid[:2] = False
        return picture * (20 if self.is_hdr else 1), valid


def sampled(kind, folder, view=0, capture=None, seed=0, **keys):
    capture = capture or Capture(view + 1)
    return MODULES[kind].predict(capture.views[view], namespace(kind, folder, **keys), capture, seed)


# --------------------------------------------------------------------------------------------------------------- sampling


@pytest.mark.long
@pytest.mark.parametrize("kind", MODULES)
def test_a_batch_is_what_its_samples_are_alone(made, kind):
    together = sampled(kind, made[kind], batch=4)
    assert together.shape == (4, HEIGHT, WIDTH, 5) and together.dtype == np.float32
    assert together.min() >= 0 and together.max() <= 1
    assert together.std(0).mean() > 0.01  # seeds differ
    np.testing.assert_allclose(sampled(kind, made[kind], batch=1), together, atol=1e-5)
    alone = sampled(kind, made[kind], samples=1, seed=2)  # sample k has seed + k
    np.testing.assert_allclose(alone[0], together[2], atol=1e-5)


def test_bytes_do_not_depend_on_threads(made):
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            diffusion.load_model.cache_clear()
            torch.set_num_threads(threads)
            found.append(sampled("rgbx", made["rgbx"], samples=3, steps=1).tobytes())
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
        diffusion.load_model.cache_clear()
    assert len(set(found)) == 1


@pytest.mark.parametrize("kind", MODULES)
def test_a_photograph_is_encoded_once(made, kind, monkeypatch):
    few = {"samples": 2, "steps": 1}
    keys = namespace(kind, made[kind], **few)
    model = diffusion.load_model(MODULES[kind].RECIPE, json.dumps(vars(keys.prior), sort_keys=True))
    shapes, encode = [], model.vae.encode
    monkeypatch.setattr(model.vae, "encode", lambda x: (shapes.append(tuple(x.shape)), encode(x))[1])
    for view in range(2):
        sampled(kind, made[kind], view, **few)
    assert shapes == [(1, 3, 64, 64)] * 2


def test_rgbx_is_ddim_by_hand(made):
    """Compare with a plain float64 version: the paper's DDIM with zero terminal SNR, no scheduler class, no batches."""
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer

    folder, steps, seed = made["rgbx"], 5, 7
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    root = (1 - betas).cumprod(0).sqrt()
    root = (root - root[-1]) * root[0] / (root[0] - root[-1])  # Lin et al. 2024, algorithm 1
    unet = UNet2DConditionModel.from_pretrained(folder / "unet").double()
    vae = AutoencoderKL.from_pretrained(folder / "vae").double()
    text = CLIPTextModel.from_pretrained(folder / "text_encoder").double()
    tokens = CLIPTokenizer.from_pretrained(folder / "tokenizer")
    photo = picture_for_model(Capture().views[0], Capture(), linear=True)
    wide = diffusion.resize(photo[None], 64, 46)[0]
    image = np.concatenate([wide, wide[:-19:-1]])  # 64 x 64, continued by reflection
    with torch.no_grad():
        condition = vae.encode(torch.from_numpy(image.transpose(2, 0, 1).copy())[None].double() * 2 - 1).latent_dist.mode()
        ids = tokens("Roughness", padding="max_length", max_length=77, return_tensors="pt").input_ids
        assert ids.shape == (1, 77)
        prompt = text(ids)[0]
        x = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(seed)).double()
        times = [999, 799, 599, 399, 199]  # trailing
        for t, after in zip(times, [*times[1:], -1], strict=True):
            a, s = root[t], (1 - root[t] ** 2).sqrt()
            b = root[after] if after >= 0 else root[0]  # the checkpoint says set_alpha_to_one: false
            v = unet(torch.cat([x, condition * 0.18215], 1), t, encoder_hidden_states=prompt).sample
            x = b * (a * x - s * v) + (1 - b**2).sqrt() * (a * v + s * x)
        decoded = (vae.decode(x / 0.18215).sample[0].numpy().transpose(1, 2, 0) / 2 + 0.5).clip(0, 1)[:46]
    expected = diffusion.resize(decoded[None].astype(np.float32), WIDTH, HEIGHT)[0, ..., 0]
    found = sampled("rgbx", folder, seed=seed, steps=steps, samples=1)[0, ..., 3]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.long
def test_marigold_is_the_pipeline_of_diffusers(made):
    """Compare with diffusers' own pipeline on the same noise."""
    from diffusers import MarigoldIntrinsicsPipeline

    pipeline = MarigoldIntrinsicsPipeline.from_pretrained(made["marigold"])
    pipeline.set_progress_bar_config(disable=True)
    picture = picture_for_model(Capture().views[0], Capture(), linear=False)[:, :40]
    noise = torch.cat([torch.randn(1, 8, 8, 8, generator=torch.Generator().manual_seed(5 + k)) for k in range(2)])
    image = torch.from_numpy(picture.transpose(2, 0, 1).copy())[None].expand(2, -1, -1, -1)
    expected = pipeline(image, latents=noise, batch_size=2, output_type="pt").prediction  # 40 -> 64 -> 40
    keys = namespace("marigold", made["marigold"], samples=2, steps=None, longest_side=None)
    found = diffusion.predict_maps(marigold.RECIPE, keys.prior, picture, 64, 3, 5)
    size = (2, 2, 40, 40, 3)
    small = diffusion.resize(diffusion.resize(picture[None], 64, 64), 40, 40)
    assert found.shape == size and abs(small - picture).max() > 0.01
    # The same noise, network and size; diffusers scales the answer back without a low-pass filter, so it is compared before.
    whole = pipeline(image, latents=noise, batch_size=2, output_type="pt", match_input_resolution=False).prediction
    whole = whole.numpy().transpose(0, 2, 3, 1)
    np.testing.assert_allclose(found.reshape(4, 40, 40, 3), diffusion.resize(whole, 40, 40), atol=1e-5)
    assert abs(expected.numpy().transpose(0, 2, 3, 1) - found.reshape(4, 40, 40, 3)).mean() < 0.05


def test_marigold_says_what_its_channels_are(made):
    keys = namespace("marigold", made["marigold"], samples=2, steps=1)
    raw = diffusion.predict_maps(marigold.RECIPE, keys.prior, picture_for_model(Capture().views[0], Capture(), False), 64, 1, 0)
    found = sampled("marigold", made["marigold"], samples=2, steps=1)
    np.testing.assert_allclose(found[..., :3], linear_from_srgb(raw[:, 0]), atol=1e-6)
    np.testing.assert_array_equal(found[..., 3:], raw[:, 1, ..., :2])
    turned = json.loads(json.dumps(tiny_diffusion.TARGETS))
    turned["target_names"] = ["material", "albedo"]
    turned["material"]["sub_target_names"] = ["metallicity", None, "roughness"]
    turned["albedo"]["prediction_space"] = "linear"
    expected = {"albedo": (1, [0, 1, 2], "linear"), "roughness": (0, [2], "linear"), "metallicity": (0, [0], "linear")}
    assert marigold.layout({"target_properties": turned}) == expected


@pytest.mark.long
def test_every_size_and_tiles(made):
    rng = np.random.default_rng(0)
    for height, width, longest in ((3, 50, 100), (1, 1, 64), (130, 70, 70)):
        keys = namespace("marigold", made["marigold"], samples=1)
        found = diffusion.predict_maps(marigold.RECIPE, keys.prior, rng.random((height, width, 3), np.float32), longest, 1, 0)
        assert found.shape == (1, 2, height, width, 3) and np.isfinite(found).all()
    whole = sampled("rgbx", made["rgbx"], samples=1, longest_side=192, steps=1, tile=192)
    tiled = sampled("rgbx", made["rgbx"], samples=1, longest_side=192, steps=1, tile=64)
    assert np.isfinite(tiled).all() and 0 < abs(tiled - whole).mean() < 0.1
    np.testing.assert_array_equal(sampled("rgbx", made["rgbx"], samples=1, longest_side=192, steps=1, tile=1024), whole)


@pytest.mark.parametrize("length", [5, 16, 17, 23, 28, 29, 100])
def test_tiles_cover_and_weights_sum_to_one(length):
    starts = diffusion.tile_starts(length, 16)
    covered = np.zeros(length, int)
    for start in starts:
        assert 0 <= start and min(16, length) + start <= length
        covered[start : start + 16] += 1
    assert covered.min() >= 1 and all(b - a <= 12 for a, b in zip(starts, starts[1:], strict=False))
    picture = torch.rand(2, length, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = diffusion.blend_tiles(lambda rows, columns: picture[:, rows, columns] ** 2, length, 20, 16)
    np.testing.assert_allclose(found, picture**2, rtol=1e-6)  # a function of single pixels does not depend on the tiles


def test_resizing_and_padding():
    assert diffusion.working_size(640, 480, 1024) == (1024, 768) and diffusion.working_size(3, 3000, 100) == (1, 100)
    picture = np.arange(24, dtype=np.float32).reshape(4, 2, 3)
    wide = diffusion.pad(picture, 8)
    assert wide.shape == (8, 8, 3)
    np.testing.assert_array_equal(wide[:4, :2], picture)
    np.testing.assert_array_equal(wide[4:, :2], picture[::-1])
    plane = np.mgrid[:20, :30][0][None, ..., None].astype(np.float32) + 0.5
    np.testing.assert_allclose(diffusion.resize(plane, 15, 10)[0, 2:-2, 3, 0], 2 * np.arange(10)[2:-2] + 1, rtol=1e-5)


def test_bfloat16_is_float32_roughly_and_the_half_files_are_read(made, copied):
    few = {"samples": 2, "steps": 2}
    exact = sampled("rgbx", made["rgbx"], **few)
    rough = sampled("rgbx", made["rgbx"], precision="bfloat16", **few)
    assert 0 < abs(rough - exact).mean() < 0.05
    for path in copied["rgbx"].rglob("*.safetensors"):
        path.rename(path.with_suffix(".fp16.safetensors"))
    np.testing.assert_array_equal(sampled("rgbx", copied["rgbx"], **few), exact)


# ------------------------------------------------------------------------------------------------------------- photographs


def test_what_the_models_see():
    view = Capture().views[0]
    stored, valid = Capture().photo(view)
    linear, shown = (picture_for_model(view, Capture(), linear) for linear in (True, False))
    np.testing.assert_allclose(shown[valid], stored[valid], atol=1e-7)
    np.testing.assert_allclose(linear[valid], stored[valid] ** 2.2, atol=1e-6)
    np.testing.assert_array_equal(shown[0], stored[2])  # two rows do not count and take the next
    bright = Capture(is_hdr=True)
    linear, shown = (picture_for_model(view, bright, linear) for linear in (True, False))
    np.testing.assert_allclose(shown, srgb_from_linear(linear), atol=1e-6)
    scale = key_exposure(bright.photo(view)[0], valid)
    assert np.exp(np.log(luminance(bright.photo(view)[0] * scale))[valid].mean()) == pytest.approx(0.18, rel=1e-5)
    np.testing.assert_allclose(linear[valid], np.clip(scale * bright.photo(view)[0], 0, 1)[valid], rtol=1e-5)


def test_key_exposure_at_its_ends():
    assert key_exposure(np.zeros((2, 2, 3))) == 1.0
    assert key_exposure(np.full((2, 2, 3), 0.09)) == pytest.approx(2.0)
    half = np.ones((2, 1, 3))
    half[0] = 0
    assert key_exposure(half) == pytest.approx(0.18 / np.sqrt(0.5e-6), rel=1e-6)


# ------------------------------------------------------------------------------------------------------------------- stage


@pytest.fixture
def run(made, tmp_path, monkeypatch):
    """run(folder, views) -> (reader, names of the views that the model was asked for); `fail` kills it after so many."""

    def go(folder="prior", views=3, fail=None, fingerprint="0123", **keys):
        asked, predict = [], rgbx.predict

        def counted(view, *rest):
            if len(asked) == fail:
                raise KeyboardInterrupt
            asked.append(view.name)
            return predict(view, *rest)

        settings = namespace("rgbx", made["rgbx"], **{"samples": 2, "steps": 1} | keys)
        writer = StageWriter(tmp_path / folder, {"stage": "prior", "scene": "tiny", "fingerprint": fingerprint})
        with monkeypatch.context() as patch:
            patch.setattr(rgbx, "predict", counted)
            if fail is not None:
                with pytest.raises(KeyboardInterrupt):
                    stage.write(writer, Capture(views), settings, 0)
                return None, asked
            stage.write(writer, Capture(views), settings, 0)
            writer.finish()
        return StageReader(tmp_path / folder, "prior", "tiny"), asked

    return go


def content(reader):
    return {str(path.relative_to(reader.directory)): path.read_bytes() for path in reader.directory.rglob("*") if path.is_file()}


def test_a_killed_job_goes_on_where_it_was(run, tmp_path):
    expected, asked = run("whole")
    assert asked == ["v0", "v1", "v2"]
    _, asked = run(fail=2)
    assert asked == ["v0", "v1"] and not (tmp_path / "prior/manifest.json").exists()
    found, asked = run()
    assert asked == ["v2"]
    assert content(found) == content(expected) and sorted(content(found)) == [
        "faces.parquet", "manifest.json", "maps/v0.exr", "maps/v1.exr", "maps/v2.exr", "model.json", "predictions.parquet",
    ]  # fmt: skip
    assert run()[1] == ["v0", "v1", "v2"]  # finished and forced again: nothing is taken over


def test_what_was_made_otherwise_or_damaged_is_made_again(run, tmp_path):
    run(fail=2, fingerprint="other")
    assert run(fail=2)[1] == ["v0", "v1"]
    (tmp_path / "prior/maps/v0.exr").write_bytes(b"cut")
    (tmp_path / "prior/unfinished/v1.json").write_text("{")
    assert run()[1] == ["v0", "v1", "v2"]


def test_failed_samples_are_dropped_and_recorded(run, monkeypatch):
    decode = diffusion.Model._decode

    def spoilt(self, latent):
        maps = decode(self, latent)
        maps[1] = np.nan  # what half precision does when it overflows
        maps[3] = 0.5
        maps[2, :, 5, 5] = np.nan
        return maps

    monkeypatch.setattr(diffusion.Model, "_decode", spoilt)
    diffusion.load_model.cache_clear()
    reader, _ = run(views=2, batch=4, samples=4)
    diffusion.load_model.cache_clear()
    table = reader.table("predictions.parquet")
    assert table["used"].tolist() == [True, False, True, False] * 2
    assert "not finite" in table["reason"][1] and "constant" in table["reason"][3] and "filled" in table["reason"][2]
    layers = {name.split(".")[1] for name in reader.exr("maps/v0.exr")}
    assert layers == {"000", "002"}
    read = StoredPredictions(reader).maps(Capture().views[0], 4)  # the next stage
    assert np.isnan(read[[1, 3]]).all() and np.isfinite(read[[0, 2]]).all()


def test_the_result_says_what_made_it(run):
    made_by = run(views=1)[0].json("model.json")
    assert made_by["published_as"] == "zheng95z/rgb-to-x" and "Adobe" in made_by["licence"]
    assert made_by["precision"] == {"unet": "float32", "vae": "float32"} and (made_by["device"] == "cpu") == (DEVICE == "cpu")


# ------------------------------------------------------------------------------------------------------------------ refused


def refusal(kind, folder, **keys):
    with pytest.raises(InputError) as caught:
        MODULES[kind].raw_inputs({"prior": section(kind, folder, **keys)})
    assert "\n" not in str(caught.value)
    return str(caught.value)


def changed(path, **keys):
    path.write_text(json.dumps({k: v for k, v in (json.loads(path.read_text()) | keys).items() if v is not None}))


def test_good_checkpoints_are_their_files(made):
    for kind, module in MODULES.items():
        files = module.raw_inputs({"prior": section(kind, made[kind])})
        assert sorted(files) == sorted(path for path in made[kind].rglob("*") if path.is_file())


def test_the_licence_is_asked_for_and_shown(copied):
    said = refusal("rgbx", copied["rgbx"], accept_license=False)
    named(said, "prior.accept_license", "Adobe Research License", "prior: {accept_license: true}")
    (copied["rgbx"] / "LICENSE").write_text("")
    named(refusal("rgbx", copied["rgbx"], accept_license=False), copied["rgbx"] / "LICENSE")
    (copied["marigold"] / "README.md").write_text("---\nlicense: openrail++\n---\n")
    named(refusal("marigold", copied["marigold"], accept_license=False), "`openrail++`")


def test_another_model_is_refused(copied):
    found, needed = "StableDiffusionAOVMatEstPipeline", "MarigoldIntrinsicsPipeline"
    named(refusal("marigold", copied["rgbx"]), "rgbx/model_index.json", "_class_name", found, needed)
    named(refusal("rgbx", copied["marigold"]), "marigold/model_index.json", "_class_name", found, needed)
    index = copied["marigold"] / "model_index.json"
    lighting = {"target_names": ["albedo", "shading"], "albedo": {"prediction_space": "linear"}}
    changed(index, target_properties=lighting)
    named(refusal("marigold", copied["marigold"]), "model_index.json", "albedo, shading", "albedo, roughness, metallicity")
    changed(index, target_properties=tiny_diffusion.TARGETS | {"albedo": {"prediction_space": "lab"}})
    named(refusal("marigold", copied["marigold"]), "target_properties.albedo", "prediction_space lab")


SPOILT = {
    "unet/config.json": ({"in_channels": 9}, ("in_channels", 9, 8)),
    "vae/config.json": ({"latent_channels": 16}, ("latent_channels", 16, 4)),
    "scheduler/scheduler_config.json": ({"prediction_type": "epsilon"}, ("prediction_type", "epsilon", "v_prediction")),
    "model_index.json": (
        {"unet": ["diffusers", "FluxTransformer2DModel"]},
        ("unet", "FluxTransformer2DModel"),
    ),
}


@pytest.mark.parametrize("name", SPOILT)
def test_other_architectures_are_refused(copied, name):
    keys, names = SPOILT[name]
    changed(copied["rgbx"] / name, **keys)
    named(refusal("rgbx", copied["rgbx"]), copied["rgbx"] / name, *names)


def test_damaged_files_are_refused(copied):
    folder = copied["rgbx"]
    weights = folder / "unet/diffusion_pytorch_model.safetensors"
    good = weights.read_bytes()
    weights.write_bytes(good[:-100])
    named(refusal("rgbx", folder), weights, len(good) - 100, len(good))
    weights.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 3460000000\n")
    named(refusal("rgbx", folder), weights, "git lfs pull")
    weights.rename(weights.with_suffix(".bin"))
    named(refusal("rgbx", folder), weights.name, weights.with_suffix(".bin").name)
    shutil.copy(copied["marigold"] / "unet/diffusion_pytorch_model.safetensors", weights)
    named(refusal("rgbx", folder), folder / "unet", "config.json", 12, 8)
    weights.write_bytes(good)
    (folder / "vae/config.json").write_text("{")
    named(refusal("rgbx", folder), "vae/config.json", "JSON")
    (folder / "vae/config.json").unlink()
    named(refusal("rgbx", folder), "vae/config.json", "prior.checkpoint", "docs/guide/priors.md")
    shutil.rmtree(folder / "tokenizer")
    named(refusal("rgbx", folder), folder / "tokenizer")


def test_missing_weights_are_not_drawn_at_random(copied):
    from safetensors.torch import load_file, save_file

    path = copied["rgbx"] / "unet/diffusion_pytorch_model.safetensors"
    tensors = load_file(path)
    save_file({name: tensor for name, tensor in tensors.items() if name != "conv_out.bias"}, path)
    with refused("rgbx/unet", 1, "conv_out.bias"):
        sampled("rgbx", copied["rgbx"])
    save_file(tensors | {"conv_out.bias": torch.zeros(5)}, path)
    with refused("rgbx/unet", "UNet2DConditionModel"):
        sampled("rgbx", copied["rgbx"])


def test_where_it_is_looked_for(copied, tmp_path, monkeypatch):
    said = refusal("rgbx", tmp_path / "nowhere")
    named(said, tmp_path / "nowhere", "prior.checkpoint", "hf download zheng95z/rgb-to-x", "Adobe Research License")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    name, wanted = "zheng95z/rgb-to-x", settings_module.UNIONS["prior"]["rgbx"].model_fields["revision"].default
    named(refusal("rgbx", name), "prior.checkpoint", name, tmp_path / "hub", f"--revision {wanted}")
    snapshots = tmp_path / "hub/models--zheng95z--rgb-to-x/snapshots"
    shutil.copytree(copied["rgbx"], snapshots / ("0" * 40))
    named(refusal("rgbx", name), "prior.checkpoint", wanted, "0" * 40)
    named(refusal("rgbx", name, revision=None), "prior.revision", name, "0" * 40)
    shutil.copytree(copied["rgbx"], snapshots / wanted)
    for revision in (wanted, wanted[:7]):
        assert checkpoint.check(section("rgbx", name, revision=revision), rgbx.RECIPE).folder == snapshots / wanted
    beside = copied["rgbx"] / ".cache/huggingface/download/model_index.json.metadata"
    beside.parent.mkdir(parents=True)
    beside.write_text("1" * 40 + "\netag\n")
    named(refusal("rgbx", copied["rgbx"]), copied["rgbx"], "1" * 40, wanted, "prior.revision")
    assert checkpoint.check(section("rgbx", copied["rgbx"], revision="1" * 40), rgbx.RECIPE).revision == "1" * 40


def test_packages_and_devices(made, monkeypatch):
    if not torch.cuda.is_available():
        with refused("prior.device", "cuda"):
            sampled("rgbx", made["rgbx"], device="cuda")
    with refused("prior.precision", "float16", "precision: auto"):
        sampled("rgbx", made["rgbx"], device="cpu", precision="float16")
    monkeypatch.setattr(checkpoint.importlib.metadata, "version", lambda _: "2.13.0+cpu")
    named(refusal("rgbx", made["rgbx"], device="cuda"), "prior.device", "cuda", "2.13.0+cpu", "envs/README.md")
    monkeypatch.setattr(checkpoint, "find_spec", lambda name: None if name == "diffusers" else True)
    named(refusal("rgbx", made["rgbx"]), "prior: {kind: rgbx}", "diffusers", "bash envs/setup.sh")


def test_the_examples_of_the_page_are_scene_files():
    page = (Path(__file__).resolve().parents[2] / "docs/guide/priors.md").read_text()
    examples = [yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)]
    kinds = [settings_module.SceneSettings.model_validate(example).prior.kind for example in examples]
    assert set(kinds) == set(settings_module.UNIONS["prior"]) - set(plugins.KINDS["prior"])
