"""Training, evaluation, export and packing in the laboratory, on crops that are made up."""

from __future__ import annotations

import json
import struct
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from iif_core.priors.features import CHANNELS
from lab.prior import __main__ as command
from lab.prior import evaluation, export, losses, network, pack, shards, training
from lab.prior.inputs import Crops
from tests.errors import missing, refused
from workflow.priors.network import PriorNetwork

torch.set_num_threads(1)  # these networks are small
EDGE, SMALL = 16, {"batch": 4, "capacity": 24, "widths": (8, 16), "heads": 2, "edge": 16, "rate": 3e-3}


def crops_of(seed: int, count: int = 6) -> Crops:
    """Crops whose albedo is e^(y + 0.5): the network has to add 0.5 to its first inputs."""
    rng = np.random.default_rng(seed)
    inputs = np.zeros((count, len(CHANNELS), EDGE, EDGE), np.float16)
    inputs[:, :3] = rng.uniform(-3, -0.8, (count, 3, 1, 1))
    truth = np.concatenate([np.exp(inputs[:, :3].astype(float) + 0.5), np.full((count, 2, EDGE, EDGE), 0.5)], 1)
    group = np.zeros((count, EDGE, EDGE), np.uint8)
    return Crops(inputs, truth.astype(np.float16), group == 0, group, np.arange(count, dtype=np.int16))


@pytest.fixture
def folder(tmp_path) -> Path:
    """Four rooms of crops, of which the one of seed 3 is kept back."""
    own = shards.Folder(tmp_path / "data")
    for seed in (1, 2, 3, 4):
        shards.save_crops(own.crops(seed), crops_of(seed), "code")
        own.note({"seed": seed, "generator": 2})
    return own.path


@pytest.mark.long
def test_training_learns_what_there_is_to_learn(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "WARM_UP", 5)
    plan = training.Plan(folder, tmp_path / "out", steps=70, **(SMALL | {"rate": 1e-2}))
    trainer = training.Trainer(plan)
    trainer.load_new(10)
    before = dict(zip(losses.LOGGED, trainer.evaluate(), strict=True))
    done = trainer.train()
    after = dict(zip(losses.LOGGED, trainer.evaluate(), strict=True))
    # The steps are large, and the last bits of a convolution, which depend on the threads, lead to other weights.
    assert after["log_albedo_best"] < 0.5 * before["log_albedo_best"]
    assert (done.rooms, trainer.held_out.rooms, done.generators) == (3, 1, [2])
    recipe = json.loads((tmp_path / "out/recipe.json").read_text())
    assert recipe["outputs"] == list(network.HEAD) and recipe["channels"] == list(CHANNELS) and recipe["training"]["steps"] == 70
    assert recipe["training"]["room_seeds"] == [1, 4]
    assert "init" in recipe["training"]["plan"] and str(tmp_path) not in json.dumps(recipe)
    line = json.loads((tmp_path / "out/curve.jsonl").read_text().splitlines()[-1])
    assert line["steps"] == 70 and set(line["train"]) == set(losses.LOGGED)


def test_a_run_that_was_cut_off_ends_as_if_it_had_not_been(folder, tmp_path):
    whole = training.Trainer(training.Plan(folder, tmp_path / "whole", steps=8, **SMALL))
    whole.train()
    part = training.Trainer(training.Plan(folder, tmp_path / "part", steps=8, **SMALL))
    part._wait_for_rooms([])
    for _ in range(3):
        part.step()
    part.save()
    again = training.Trainer(training.Plan(folder, tmp_path / "part", steps=8, **SMALL))
    assert again.progress.steps == 3
    again.train()
    one, two = (load_file(tmp_path / name / "weights.safetensors") for name in ("whole", "part"))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_weights_of_an_earlier_training_start_a_new_one(folder, tmp_path):
    old = PriorNetwork(len(CHANNELS), (8, 16), 2)
    save_file({name: array.half() for name, array in old.state_dict().items()}, tmp_path / "old.safetensors")
    trainer = training.Trainer(training.Plan(folder, tmp_path / "out", steps=1, init=tmp_path / "old.safetensors", **SMALL))
    assert torch.allclose(trainer.model.out.weight, old.out.weight, atol=1e-4)
    (folder / "crops/3.npz").unlink()
    assert trainer.train().steps == 1, "without a room that is kept back"
    with refused("--steps", "--seconds"):
        training.Plan(folder, tmp_path)
    with refused(tmp_path / "nothing", "crops"):
        training.Trainer(training.Plan(tmp_path / "nothing", tmp_path / "out2", steps=1, **SMALL)).train()


def test_a_wider_network_starts_where_the_narrower_one_ended():
    torch.manual_seed(1)
    narrow = PriorNetwork(len(CHANNELS), (16, 24, 32), 3).eval()
    wide = PriorNetwork(len(CHANNELS), (16, 40, 64), 3).eval()
    for parameter in narrow.parameters():  # as far from the start as training takes it
        parameter.data += 0.05 * torch.randn_like(parameter)
    network.load_weights(wide, narrow.state_dict())
    x = torch.randn(2, len(CHANNELS), 32, 32)
    with torch.no_grad():
        expected, found = narrow(x), wide(x)
    assert (found - expected).square().mean() < 0.02 * expected.var()
    assert not torch.equal(found, expected)  # copies that stayed equal would never learn anything different
    with pytest.raises(ValueError):
        network.load_weights(narrow, wide.state_dict())


def test_a_pool_forgets_its_oldest_crops():
    pool = training.Pool(8, EDGE, "cpu")
    first, second = crops_of(1), crops_of(2)
    pool.add(first)
    pool.add(second)
    assert len(pool) == 8 and pool.seen == 12 and pool.rooms == 2
    assert torch.equal(pool.inputs[:4], torch.as_tensor(second.inputs[2:])), "the places of the oldest four"
    assert torch.equal(pool.inputs[4:6], torch.as_tensor(first.inputs[4:]))


def test_augmentation_mirrors_and_permutes_inputs_with_the_truth(monkeypatch):
    monkeypatch.setattr(training, "PERMUTED", 1.0)
    pool = training.Pool(64, EDGE, "cpu")
    made = crops_of(5, 64)
    made.inputs[:, CHANNELS.index("n_x")] = 0.5
    made.inputs[..., : EDGE // 2] += 0.25
    pool.add(made)
    batch = pool.batch(torch.arange(64))
    changed = training.augmented(batch, torch.Generator().manual_seed(0))
    assert torch.allclose(
        torch.log(changed.truth[:, :3]) - 0.5, changed.inputs[:, :3] - 0.25 * (changed.inputs[:, 10:11] > 0.1), atol=0.02
    )
    flipped = changed.inputs[:, CHANNELS.index("n_x"), 0, 0] < 0
    assert 10 < int(flipped.sum()) < 54
    assert bool((changed.inputs[flipped][:, 10, 0, -1] > 0.2).all()) and bool((changed.inputs[~flipped][:, 10, 0, 0] > 0.2).all())
    same = (changed.inputs[:, :3] == batch.inputs[:, :3]).all((1, 2, 3)).sum()
    assert same < 40, "colours are permuted"
    assert len(training.TRIPLES) == 7


def test_evaluation_counts_what_it_says(capture):
    case = next(evaluation.cases(capture, None, True, most=1))
    truth = case.truth
    heads = np.zeros((2, *truth["roughness"].shape, 8), np.float32)
    heads[..., :3] = np.log(np.maximum(truth["albedo"], 0.01))
    heads[..., 3] = truth["roughness"] + np.where(truth["roughness"] > 0.5, -0.1, 0.1)
    heads[..., 4] = truth["metallic"]
    heads[1, ..., :3] -= 1
    heads[..., 5:8] = np.log([0.05, 0.1, 0.1])
    heads[1, ..., 5] = np.log(5.0)  # the second head knows that it is wrong
    scores = evaluation.Scores()
    scores.add(case, heads, (1.0, 1.0, 1.0))
    report = scores.report()
    assert report["network, one answer"]["albedo, dB"] > report["network"]["albedo, dB"] > 30
    assert report["network"]["roughness, L2"] == pytest.approx(0.01, rel=1e-3)
    assert report["coverage"]["roughness"] == 1 and report["scale_factor"]["roughness"] == pytest.approx(
        1 / evaluation.WIDTH, rel=1e-2
    )
    assert report["best_head"] == [1, 0]
    if report["metal"]["pixels"]:
        assert report["metal"]["found"] == report["metal"]["precision"] == 1
    assert "albedo, dB" in evaluation.table(report)


def test_weights_are_exported_with_their_calibration(folder, tmp_path, capsys):
    training.Trainer(training.Plan(folder, tmp_path / "out", steps=2, **SMALL)).train()
    report = {"scale_factor": {"albedo": 2.0, "roughness": 1.5, "metallic": 3.0}, "mean_ratio": {"metallic": 0.7}}
    report["object_errors"] = {"level": 0.1, "brightness": 0.2, "roughness": [0.5, 0.5, 0.2, 0.1], "metal": [3.0, 1.0]}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert command.main(["export", str(tmp_path / "out"), str(tmp_path / "made"), "--report", str(tmp_path / "report.json")]) == 0
    recipe = json.loads((tmp_path / "made/recipe.json").read_text())
    assert recipe["scale_calibration"] == [2.0, 1.5, 0.7] and recipe["held_out"] == report and len(recipe["sha256"]) == 64
    assert evaluation.Weights.load(tmp_path / "made").recipe["heads"] == 2
    assert recipe["object_errors"] == report["object_errors"]
    with refused("object_errors"):
        export.export(tmp_path / "out", tmp_path / "made", {k: v for k, v in report.items() if k != "object_errors"})
    arrays = load_file(tmp_path / "out/weights.safetensors")
    save_file({**arrays, "out.bias": torch.full_like(arrays["out.bias"], torch.nan)}, tmp_path / "out/weights.safetensors")
    with refused("out.bias", "weights.safetensors"):
        export.export(tmp_path / "out", tmp_path / "made", report)


def test_commands_refuse_what_is_not_there(tmp_path, capsys):
    (tmp_path / "rooms").mkdir()
    (tmp_path / "w").mkdir()
    assert command.main(["evaluate", str(tmp_path / "w"), "--rooms", str(tmp_path)]) == 1
    assert not missing(capsys.readouterr().err, "recipe.json")
    with pytest.raises(SystemExit):
        command.main(["train", "a", "b", "--widths", "7"])
    assert not missing(capsys.readouterr().err, "--widths", 8)


def test_only_what_cuda_loads_is_packed(tmp_path):
    kept = [
        "mitsuba/__init__.py",
        "mitsuba/cuda_ad_rgb.so",
        "mitsuba/plugins/diffuse.so",
        "drjit/libdrjit.so",
        "mitsuba/libmitsuba.so",
    ]
    left = [
        "mitsuba/llvm_ad_rgb.so",
        "mitsuba/plugins/hair.so",
        "drjit/include/a.h",
        "drjit/auto/",  # some wheels list their folders
        "mitsuba/x.pyi",
        "mitsuba-1.dist-info/METADATA",
    ]
    with zipfile.ZipFile(tmp_path / "a.whl", "w") as wheel:
        for name in kept + left:
            wheel.writestr(name, name)
    with tarfile.open(tmp_path / "a.tar", "w") as tar:
        pack._add_wheel(tar, tmp_path / "a.whl")
    with tarfile.open(tmp_path / "a.tar") as tar:
        assert sorted(tar.getnames()) == sorted(kept) and tar.extractfile(kept[0]).read() == kept[0].encode()
    with refused(tmp_path, "mitsuba", "drjit"):
        pack.pack(tmp_path / "target", tmp_path, None, None)


def test_unused_weights_of_the_denoiser_are_blanked():
    """A library of 64 bits with three symbols: 8 bytes of weights that are used, 8 that are not, and 8 of something else."""
    names = b"\0N5blobs7weights16rt_hdr_calb_cnrmE\0N5blobs7weights7rt_ldrE\0other\0"
    starts = [names.index(b"N5"), names.index(b"N5", 5), names.index(b"other")]
    data, header = bytes(range(1, 25)), 64
    symbols = b"".join(struct.pack("<IBBHQQ", name, 0, 0, 1, 0x1000 + 8 * i, 8) for i, name in enumerate(starts))
    table = header + len(data) + len(names) + len(symbols)
    elf = bytearray(header)
    struct.pack_into("<Q", elf, 0x28, table)
    struct.pack_into("<H", elf, 0x3C, 4)
    sections = [(0, 0, 0, 0, 0), (1, 0x1000, header, len(data), 0), (2, 0, header + len(data) + len(names), len(symbols), 3)]
    sections.append((3, 0, header + len(data), len(names), 0))
    body = b"".join(
        struct.pack("<I", 0) + struct.pack("<IQQQQI", k, 0, a, o, n, link) + bytes(20) for k, a, o, n, link in sections
    )
    made = pack.without_other_weights(bytes(elf) + data + names + symbols + body)
    assert made[header : header + 24] == data[:8] + bytes(8) + data[16:]
    with refused("rt_hdr_calb_cnrm"):
        pack.without_other_weights(bytes(elf) + data + names.replace(b"calb", b"cal_") + symbols + body)
