"""Training: crops from a folder, perhaps while workers fill it, by the clock or by steps; it continues from its last saved state.

state.pt     network, its average, optimiser, random numbers, steps and seconds so far
curve.jsonl  a line at every evaluation: losses on crops that are trained on and that are kept back
weights.safetensors, recipe.json    what `export` and `evaluate` read: the average, and how it was made
"""

from __future__ import annotations

import copy
import json
import logging
import math
import os
import time
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from iif_core.errors import InputError
from iif_core.priors.features import CHANNELS
from lab.prior import losses, network, rooms, shards
from lab.prior.inputs import EDGE, Crops
from lab.prior.losses import Batch
from workflow.priors.network import PriorNetwork

TRIPLES = tuple(i for i, name in enumerate(CHANNELS) if name.endswith("_r") and CHANNELS[i + 1 : i + 2] == (name[:-1] + "g",))
"""First channels of the colours among the inputs."""
PERMUTED = 0.1
"""Share of the crops whose colour channels are permuted. More would teach that large surfaces have any colour."""
WARM_UP = 200  # steps
AVERAGE = 0.999
"""Share of the average of weights that a step keeps."""
GROUPS = 256  # objects of a crop at most
EVALUATE_EVERY, SAVE_EVERY = 20.0, 120.0  # seconds
EVALUATION_SHARE = 0.05
"""Largest share of the time that evaluations take; on a CPU they are then rarer than `EVALUATE_EVERY`."""
_LOG = logging.getLogger("training")


@dataclass(frozen=True)
class Plan:
    """How to train.

    Attributes:
        crops: folder that `shards.Folder` describes; out: where results go.
        steps: number of steps; 0 = by the clock. seconds: of training and waiting, over all runs; inf = by steps.
        start: seconds to wait for rooms before the first step, from the start of the process.
        batch: crops of a step. capacity: crops in memory, at most; later rooms replace earlier ones.
        rate: highest step size. heat: temperature of the shares at the start (`losses.temperature`).
        widths, heads: of the network.
        init: weights to start from, or None. seed: of the network, the batches and the order of the crops.
        state: file that a run continues from; None = state.pt in `out`.
        consume: delete a file of crops once it is read. compile: torch.compile. device: cpu or cuda. edge: pixels along a crop.
    """

    crops: Path
    out: Path
    steps: int = 0
    seconds: float = math.inf
    start: float = 0.0
    batch: int = 48
    capacity: int = 2000
    rate: float = 1.2e-3
    heat: float = losses.TEMPERATURE[0]
    widths: tuple[int, ...] = (40, 80, 128, 192, 224)
    heads: int = 8
    init: Path | None = None
    state: Path | None = None
    seed: int = 0
    consume: bool = False
    compile: bool = False
    device: str = "cpu"
    edge: int = EDGE

    def __post_init__(self) -> None:
        if not self.steps and not math.isfinite(self.seconds):
            raise InputError("train: neither --steps nor --seconds is given; one of them must say when to end")

    def facts(self) -> dict[str, Any]:
        """Return what recipe.json records; folders are left out, because they are of one machine."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("crops", "out", "init", "state")} | {
            "init": self.init is not None
        }


class Pool:
    """Crops on the device.

    Args:
        capacity: number of crops; once it is reached, new ones take the places of the oldest.
        edge: pixels along a crop.
        device: of torch.
    """

    def __init__(self, capacity: int, edge: int, device: str):
        self.inputs = torch.empty((capacity, len(CHANNELS), edge, edge), dtype=torch.float16, device=device)
        self.truth = torch.empty((capacity, 5, edge, edge), dtype=torch.float16, device=device)
        self.counts = torch.empty((capacity, edge, edge), dtype=torch.bool, device=device)
        self.group = torch.empty((capacity, edge, edge), dtype=torch.uint8, device=device)
        self.capacity, self.seen, self.rooms = capacity, 0, 0

    def __len__(self) -> int:
        return min(self.seen, self.capacity)

    def add(self, crops: Crops) -> None:
        """Add the crops of a room."""
        place = torch.arange(self.seen, self.seen + len(crops), device=self.inputs.device) % self.capacity
        for name in ("inputs", "truth", "counts", "group"):
            own = getattr(self, name)
            own[place] = torch.as_tensor(getattr(crops, name)).to(own.device, own.dtype)
        self.seen += len(crops)
        self.rooms += 1

    def batch(self, index: torch.Tensor) -> Batch:
        """Return the crops of an index (B,) as float32."""
        inputs = self.inputs[index].float()
        group = self.group[index].long() + GROUPS * torch.arange(len(index), device=index.device)[:, None, None]
        border = inputs[:, CHANNELS.index("border"), None]
        return Batch(inputs, self.truth[index].float(), self.counts[index].float()[:, None], group, border, GROUPS * len(index))


def augmented(batch: Batch, generator: torch.Generator) -> Batch:
    """Mirror half of the crops, and permute the colour channels of a share PERMUTED."""
    count, device = len(batch.inputs), batch.inputs.device
    flip = torch.rand(count, generator=generator, device=device) < 0.5
    mirrored = lambda q: torch.where(flip.reshape(-1, *[1] * (q.ndim - 1)), q.flip(-1), q)  # noqa: E731
    inputs, truth = mirrored(batch.inputs), mirrored(batch.truth)
    inputs[flip, CHANNELS.index("n_x")] *= -1
    some = torch.rand(count, generator=generator, device=device) < PERMUTED
    order = torch.rand(count, 3, generator=generator, device=device).argsort(1)
    order = torch.where(some[:, None], order, torch.arange(3, device=device))
    inputs_order = torch.arange(len(CHANNELS), device=device).repeat(count, 1)
    for first in TRIPLES:
        inputs_order[:, first : first + 3] = first + order
    truth_order = torch.cat([order, torch.arange(3, 5, device=device).repeat(count, 1)], 1)
    taken = lambda q, o: torch.gather(q, 1, o[..., None, None].expand(-1, -1, *q.shape[2:]))  # noqa: E731
    others = (mirrored(q) for q in (batch.counts, batch.group, batch.border))
    return Batch(taken(inputs, inputs_order), taken(truth, truth_order), *others, batch.groups)


@dataclass
class Progress:
    """What a run has done so far, over all its processes."""

    steps: int = 0
    seconds: float = 0.0
    training_seconds: float = 0.0
    rooms: int = 0
    crops: int = 0
    generators: list[int] = field(default_factory=list)


class Trainer:
    """A run of training.

    Args:
        plan: how to train. Where `plan.out` has a state of the same network, the run continues from it.
    """

    def __init__(self, plan: Plan):
        self.plan, self.progress = plan, Progress()
        torch.manual_seed(plan.seed)
        self.model = PriorNetwork(len(CHANNELS), plan.widths, plan.heads).to(plan.device)
        if plan.init:
            network.load_weights(self.model, load_file(plan.init))
            _LOG.info("starts from %s", plan.init)
        self.average = copy.deepcopy(self.model).eval().requires_grad_(False)
        settings = {"lr": plan.rate, "weight_decay": 0.01, "betas": (0.9, 0.98), "fused": plan.device == "cuda"}
        self.optimiser = torch.optim.AdamW(self.model.parameters(), **settings)
        self.generator = torch.Generator(plan.device).manual_seed(plan.seed + 1)
        self.pool = Pool(plan.capacity, plan.edge, plan.device)
        self.held_out = Pool(max(plan.batch, min(plan.capacity // 10, 480)), plan.edge, plan.device)
        self.read: set[int] = set()
        self.born = time.time()
        plan.out.mkdir(parents=True, exist_ok=True)
        self.state = plan.state or plan.out / "state.pt"
        if self.state.exists():
            self._restore()
        self.run = self._compiled() if plan.compile else self.model

    def _compiled(self) -> torch.nn.Module:
        """Compile the network now, while workers make the first rooms; what cannot be compiled runs as it is."""
        torch._dynamo.config.suppress_errors = True
        run = torch.compile(self.model)
        shape = (self.plan.batch, len(CHANNELS), self.plan.edge, self.plan.edge)
        nothing = Batch(torch.zeros(shape, device=self.plan.device), *[torch.zeros(0)] * 4, 0)
        self._predict(run, nothing).sum().backward()
        self.optimiser.zero_grad(set_to_none=True)
        _LOG.info("compiled after %.0f s", time.time() - self.born)
        return run

    # ------------------------------------------------------------------------------------------------------------- data

    def load_new(self, most: int) -> int:
        """Read up to `most` rooms that have not been read; return their number."""
        files = [item for item in shards.crop_files(self.plan.crops) if item[0] not in self.read]
        # Shuffled, so that a pool smaller than the folder holds rooms of all kinds.
        order = np.random.default_rng([self.plan.seed, len(self.read)]).permutation(len(files))[:most]
        for seed, path in (files[i] for i in order):
            crops = shards.load_crops(path)
            self.read.add(seed)
            if shards.is_held_out(seed):
                if self.held_out.seen < self.held_out.capacity:
                    self.held_out.add(crops)
            elif len(crops):
                self.pool.add(crops)
            if self.plan.consume:
                path.unlink()
        self.progress.rooms, self.progress.crops = self.pool.rooms, self.pool.seen
        return len(order)

    # ------------------------------------------------------------------------------------------------------------ steps

    def fraction(self) -> float:
        """Return how far training has come, from 0 to 1."""
        if self.plan.steps:
            return min(self.progress.steps / self.plan.steps, 1.0)
        left = max(self.plan.seconds - (self.progress.seconds - self.progress.training_seconds), 1e-6)
        return min(self.progress.training_seconds / left, 1.0)

    def step(self) -> torch.Tensor:
        """Make one step; return the numbers `losses.LOGGED`."""
        plan, part = self.plan, self.fraction()
        rate = plan.rate * min(1.0, (self.progress.steps + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * part))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        index = torch.randint(len(self.pool), (plan.batch,), generator=self.generator, device=plan.device)
        batch = augmented(self.pool.batch(index), self.generator)
        loss, numbers = losses.loss_of(self._predict(self.run, batch), batch, losses.temperature(part, plan.heat))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.optimiser.step()
        self.progress.steps += 1
        keep = min(AVERAGE, self.progress.steps / (self.progress.steps + 20))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.model.parameters()), 1 - keep)
        return numbers

    def _predict(self, model: torch.nn.Module, batch: Batch) -> torch.Tensor:
        inputs = batch.inputs.contiguous(memory_format=torch.channels_last)
        if self.plan.device != "cuda":
            return model(inputs)
        with torch.autocast("cuda", torch.bfloat16):
            return model(inputs)

    @torch.no_grad()
    def evaluate(self) -> list[float]:
        """Return the numbers `losses.LOGGED` of the average network on the rooms that are kept back; empty without any."""
        if not len(self.held_out):
            return []
        total, count = torch.zeros(len(losses.LOGGED), device=self.plan.device), 0
        for index in torch.arange(len(self.held_out), device=self.plan.device).split(self.plan.batch):
            batch = self.held_out.batch(index)
            total += len(index) * losses.loss_of(self._predict(self.average, batch), batch, losses.TEMPERATURE[1])[1]
            count += len(index)
        return (total / count).tolist()

    # ------------------------------------------------------------------------------------------------------------- files

    def save(self) -> None:
        """Write state, weights and recipe; each file appears when it is complete."""
        out = self.plan.out
        state = {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "random": self.generator.get_state(),
            "progress": asdict(self.progress),
        }
        _replace(self.state, lambda path: torch.save(state, path))
        half = {name: array.half().contiguous().cpu() for name, array in self.average.state_dict().items()}
        _replace(out / "weights.safetensors", lambda path: save_file(half, path))
        recipe = {
            "channels": list(CHANNELS),
            "widths": list(self.plan.widths),
            "heads": self.plan.heads,
            "outputs": list(network.HEAD),
            "parameters": sum(p.numel() for p in self.average.parameters()),
            "training": {
                **{name: round(value, 1) if isinstance(value, float) else value for name, value in asdict(self.progress).items()},
                "room_seeds": [min(self.read), max(self.read)] if self.read else [],
                "plan": self.plan.facts(),
                "device": torch.cuda.get_device_name() if self.plan.device == "cuda" else "cpu",
                "torch": torch.__version__,
                "inputs": shards.inputs_digest(),
            },
        }
        _replace(out / "recipe.json", lambda path: Path(path).write_text(json.dumps(recipe, indent=1) + "\n"))

    def _restore(self) -> None:
        state = torch.load(self.state, map_location=self.plan.device, weights_only=True)
        try:
            self.model.load_state_dict(state["model"])
        except RuntimeError as error:
            raise InputError(
                f"train: {self.state} is of another network; name another --out or --state ({str(error)[:200]})"
            ) from None
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["random"].cpu())
        self.progress = Progress(**state["progress"])
        _LOG.info("continues after %d steps and %.0f s", self.progress.steps, self.progress.seconds)

    # --------------------------------------------------------------------------------------------------------------- run

    def train(self, busy: list[Any] | None = None) -> Progress:
        """Train to the end of the plan.

        Args:
            busy: processes that fill the folder (`poll()` is None while they run).

        Raises:
            InputError: no crops, and nobody makes any.
        """
        busy, before = busy or [], self.progress.seconds
        self._wait_for_rooms(busy)
        waited = time.time() - self.born
        ring, since = torch.zeros(len(losses.LOGGED), device=self.plan.device), 0
        trained, last_evaluated, last_saved = self.progress.training_seconds, time.time(), time.time()
        pause = EVALUATE_EVERY
        while self.fraction() < 1:
            self.load_new(2)
            ring += self.step()
            since += 1
            now = time.time()
            self.progress.seconds = before + now - self.born
            self.progress.training_seconds = trained + now - self.born - waited
            if now - last_evaluated > pause or self.fraction() >= 1:
                self._report((ring / since).tolist(), since / max(now - last_evaluated, 1e-6))
                ring.zero_()
                since, last_evaluated = 0, time.time()
                pause = max(EVALUATE_EVERY, (last_evaluated - now) / EVALUATION_SHARE)
            if now - last_saved > SAVE_EVERY:
                self.save()
                last_saved = time.time()
        lines = shards.Folder(self.plan.crops).manifest()
        self.progress.generators = sorted({line["generator"] for line in lines if line["seed"] in self.read}) or [rooms.VERSION]
        self.save()
        return self.progress

    def _wait_for_rooms(self, busy: list[Any]) -> None:
        """Read rooms until there is a batch of them and the start of training has come; all at once where nobody makes more."""
        while True:
            read = self.load_new(50)
            working = any(process.poll() is None for process in busy)
            enough = len(self.pool) >= (4 * self.plan.batch if working else 1)
            if enough and (not working or time.time() - self.born >= self.plan.start) and (working or not read):
                break
            if not working and not read:
                raise InputError(f"train: {self.plan.crops} has no crops to train on, and no worker makes any")
            if not read:
                time.sleep(0.1)
        _LOG.info("training starts with %d rooms, %d crops", self.pool.rooms, self.pool.seen)

    def _report(self, train: list[float], rate: float) -> None:
        held = self.evaluate()
        p = self.progress
        line = {"seconds": round(p.seconds, 1), "steps": p.steps, "rooms": self.pool.rooms, "crops": self.pool.seen}
        line |= {"steps_per_second": round(rate, 3), "held_out_rooms": self.held_out.rooms}
        for name, values in (("train", train), ("held_out", held)):
            line[name] = {key: round(value, 4) for key, value in zip(losses.LOGGED, values, strict=False)}
        with open(self.plan.out / "curve.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")
        both = f"train {train[0]:.3f}" + (f", held out {held[0]:.3f}" if held else "")
        _LOG.info("step %d (%.2f/s), %d rooms, %d crops: loss %s", p.steps, rate, self.pool.rooms, self.pool.seen, both)


def _replace(path: Path, write: Any) -> None:
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    write(unfinished)
    os.replace(unfinished, path)
