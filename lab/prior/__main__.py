"""`python -m lab.prior <command>`: the laboratory of the learned prior (lab/docs/prior.md)."""

from __future__ import annotations

import argparse
import logging
import os
import subprocess
import sys
import time
from pathlib import Path

from iif_core.errors import InputError

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    options = parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    try:
        options.run(options)
    except (InputError, FileNotFoundError) as error:
        print(f"lab.prior {options.command}: {error}", file=sys.stderr)
        return 1
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    out = argparse.ArgumentParser(prog="python -m lab.prior", description=__doc__)
    commands = out.add_subparsers(dest="command", required=True)
    for add in (_add_rooms, _add_train, _add_evaluate, _add_residuals, _add_export, _add_pack):
        add(commands)
    return out


def _add_rooms(commands: argparse._SubParsersAction) -> None:
    p = commands.add_parser("rooms", help="make random rooms, their photographs and crops", description=_rooms.__doc__)
    p.add_argument("folder", type=Path, help="where rooms/, crops/ and rooms.jsonl go; what is there is not made again")
    p.add_argument("--seeds", type=_range, default=(30_000, 31_000), metavar="FIRST:STOP", help="default 30000:31000")
    p.add_argument("--assets", type=Path, help="folder or file of textures and skies; without it there are none")
    p.add_argument("--samples", type=int, default=40, help="paths per pixel, default 40")
    p.add_argument("--size", type=int, default=0, help="pixels along every photograph; default: drawn from 128, 160, 192")
    p.add_argument("--views", type=int, default=0, help="photographs of a room; default: drawn from 8 to 24")
    p.add_argument("--crops-only", action="store_true", help="do not keep the captures (inputs cannot be computed again then)")
    p.add_argument("--no-denoiser", action="store_true", help="leave the noise of path tracing in the photographs")
    p.add_argument("--seconds", type=float, default=float("inf"), help="start no room after so many seconds")
    p.add_argument("--workers", type=int, default=1, help="processes, each with one thread; default 1")
    p.add_argument("--part", type=_part, default=(0, 1), metavar="I/N", help="only every N-th seed, from the I-th on")
    p.add_argument("--device", choices=("auto", "cpu", "cuda"), default="cpu", help="where rays are traced; default cpu")
    p.set_defaults(run=_rooms)


def _rooms(options: argparse.Namespace) -> None:
    """Make rooms from seeds: geometry, photographs through a random camera, inputs of the network, crops. It may be killed at any
    time; the same command continues. Several processes may fill one folder if their seeds differ (--part)."""
    if options.workers > 1:
        own = [a for a in sys.argv[1:] if not a.startswith("--workers=")]
        if "--workers" in own:
            at = own.index("--workers")
            del own[at : at + 2]
        environment = os.environ | dict.fromkeys(_ONE_THREAD, "1")
        command = [sys.executable, "-m", "lab.prior", *own]
        parts = [
            subprocess.Popen([*command, "--part", f"{i}/{options.workers}"], env=environment) for i in range(options.workers)
        ]
        if any([part.wait() for part in parts]):
            raise InputError("a worker failed; its messages stand above")
        return
    stop = time.time() + options.seconds
    from lab.prior import assets, machine, shards

    kind = machine.prepare(options.device, 1)
    denoise = None if options.no_denoiser else machine.denoiser(kind)
    folder = shards.Folder(options.folder, keep_rooms=not options.crops_only)
    maker = shards.Maker(folder, assets.load(options.assets), denoise, options.samples, options.size, options.views)
    (first, last), (i, n) = options.seeds, options.part
    made = maker.make_all(range(first + i, last, n), stop)
    print(f"{made} rooms made in {folder.path}")


def _add_train(commands: argparse._SubParsersAction) -> None:
    p = commands.add_parser("train", help="train the network on crops", description=_train.__doc__)
    p.add_argument("folder", type=Path, help="a folder that `rooms` fills, or has filled")
    p.add_argument("out", type=Path, help="where weights, recipe, curve and state go; a run continues from the state there")
    p.add_argument("--steps", type=int, default=0, help="steps in all; default: by --seconds")
    p.add_argument("--seconds", type=float, default=float("inf"), help="seconds in all, waiting for rooms included")
    p.add_argument("--start", type=float, default=0, help="make rooms for so many seconds before the first step")
    p.add_argument("--workers", type=int, default=0, help="processes that make rooms meanwhile; default none")
    p.add_argument("--generate", type=float, default=float("inf"), help="seconds after which the workers start no more rooms")
    p.add_argument("--seeds", default="30000:1000000000", metavar="FIRST:STOP", type=_range, help="of the workers' rooms")
    p.add_argument("--assets", type=Path, help="of the workers' rooms")
    p.add_argument("--samples", type=int, default=40, help="paths per pixel of the workers' rooms")
    p.add_argument("--consume", action="store_true", help="keep no captures, and delete crops once they are in memory")
    p.add_argument("--capacity", type=int, default=2000, help="crops in memory, 1.5 MB each; default 2000")
    p.add_argument("--batch", type=int, default=48, help="crops of a step, default 48")
    p.add_argument("--rate", type=float, default=1.2e-3, help="largest step size, default 0.0012")
    p.add_argument(
        "--heat", type=float, default=1.0, help="temperature at the start, default 1; lower keeps the heads of --init apart"
    )
    p.add_argument("--widths", type=_widths, default=(40, 80, 128, 192, 224), help="features by level, default 40,80,128,192,224")
    p.add_argument("--heads", type=int, default=8, help="hypotheses, default 8")
    p.add_argument("--init", type=Path, help="weights (.safetensors) to start from")
    p.add_argument("--state", type=Path, help="where the state goes that a run continues from; default: OUT/state.pt")
    p.add_argument("--edge", type=int, default=128, help="pixels along a crop, as the folder has them; default 128")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--compile", action="store_true", help="torch.compile")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.add_argument("--threads", type=int, default=2, help="of the trainer on a CPU, default 2")
    p.set_defaults(run=_train)


def _train(options: argparse.Namespace) -> None:
    """Train on the crops of a folder, by steps or by the clock, perhaps while workers fill it. It may be killed at any time; the
    same command continues from the last saved state."""
    import torch

    from lab.prior import training

    torch.set_num_threads(options.threads)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = torch.backends.cudnn.benchmark = True
    names = ("out", "steps", "seconds", "start", "batch", "capacity", "rate", "heat", "widths", "heads", "init", "state", "seed")
    names += ("consume", "compile", "device", "edge")
    own = {name: getattr(options, name) for name in names}
    plan = training.Plan(options.folder, **own)
    workers = [_worker(options, i) for i in range(options.workers)]
    try:
        done = training.Trainer(plan).train(workers)
    finally:
        for worker in workers:
            if worker.poll() is None:
                worker.terminate()
    print(f"{done.steps} steps on {done.rooms} rooms, {done.crops} crops, in {done.seconds:.0f} s: {options.out}")


def _worker(options: argparse.Namespace, number: int) -> subprocess.Popen:
    """Start a process that makes every `options.workers`-th room."""
    command = [sys.executable, "-m", "lab.prior", "rooms", str(options.folder), "--seeds", "{}:{}".format(*options.seeds)]
    command += ["--part", f"{number}/{options.workers}", "--device", options.device, "--samples", str(options.samples)]
    command += ["--seconds", str(options.generate)] + (["--crops-only"] if options.consume else [])
    command += ["--assets", str(options.assets)] if options.assets else []
    options.out.mkdir(parents=True, exist_ok=True)
    with open(options.out / "workers.log", "a") as log:
        return subprocess.Popen(command, env=os.environ | dict.fromkeys(_ONE_THREAD, "1"), stdout=log, stderr=log)


def _add_evaluate(commands: argparse._SubParsersAction) -> None:
    p = commands.add_parser("evaluate", help="measure errors and calibration of weights", description=_evaluate.__doc__)
    p.add_argument("weights", type=Path, help="folder with weights.safetensors and recipe.json")
    p.add_argument("--rooms", type=Path, help="folder that `rooms` filled: the rooms that are kept back from training")
    p.add_argument(
        "--captures", type=Path, nargs="*", default=[], help="folders of stage capture, results/<scene>/capture, with truth"
    )
    p.add_argument("--objects", choices=("given", "mesh"), default="mesh", help="of --captures; default mesh")
    p.add_argument("--all-rooms", action="store_true", help="all of --rooms, for weights that were trained on none of them")
    p.add_argument("--limit", type=int, default=0, help="rooms at most; default all")
    p.add_argument("--views", type=int, default=0, help="views of each capture at most; default all")
    p.add_argument("--retinex", action="store_true", help="score prior retinex as well")
    p.add_argument("--raw-scales", action="store_true", help="without the recipe's scale_calibration, as `export` wants it")
    p.add_argument("--report", type=Path, help="JSON file for all numbers")
    p.add_argument("--pictures", type=Path, help="PNG file: the first view of twelve captures")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> None:
    """Measure weights on generated rooms that were kept back, or on captures of the product with truth: scores of predictions,
    share of the errors inside of the stated 68 % intervals, metal found, and use of the heads."""
    import json

    from lab.prior import evaluation, machine

    machine.prepare(options.device, 2)
    weights = evaluation.Weights.load(options.weights, options.device)
    if options.captures:
        sources = evaluation.product_captures(
            options.captures, weights, options.objects == "given", options.views, options.retinex
        )
    elif options.rooms:
        kept = _kept_back(options.rooms, options.all_rooms)
        sources = evaluation.held_out_rooms(kept[: options.limit or None], weights, options.views, options.retinex)
    else:
        raise InputError("neither --rooms nor --captures is given; name what to measure on")
    report = evaluation.evaluate(weights, sources, options.pictures, not options.raw_scales)
    print(evaluation.table(report))
    if options.report:
        options.report.write_text(json.dumps(report, indent=1) + "\n")


def _add_residuals(commands: argparse._SubParsersAction) -> None:
    p = commands.add_parser("residuals", help="measure the errors that prior `simulated` draws", description=_residuals.__doc__)
    p.add_argument("weights", type=Path, help="folder with weights.safetensors and recipe.json")
    p.add_argument("rooms", type=Path, help="folder that `rooms` filled")
    p.add_argument("target", type=Path, help="file that is written, such as lab/simulated/measured_errors.npz")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.set_defaults(run=_residuals)


def _residuals(options: argparse.Namespace) -> None:
    """Measure the errors of weights on generated rooms that were kept back from training, and write what is needed to draw such
    errors for any scene."""
    from lab.prior import evaluation, machine, residuals

    machine.prepare(options.device, 1)
    files = _kept_back(options.rooms, False)
    bank = residuals.measure(files, evaluation.Weights.load(options.weights, options.device))
    bank.save(options.target)
    print(f"{options.target}: {bank.facts['pixels']} pixels of {len(bank.facts['rooms'])} rooms")


def _kept_back(folder: Path, every: bool) -> list[Path]:
    """List the files of the rooms of a folder that no training has seen, or of every room."""
    from lab.prior import shards

    files = sorted((folder / "rooms").glob("[0-9]*.npz"), key=lambda path: int(path.stem))
    kept = [path for path in files if every or shards.is_held_out(int(path.stem))]
    if not kept:
        raise InputError(f"{folder}: none of its {len(files)} rooms is one that is kept back (one in {shards.HELD_OUT[0]})")
    return kept


def _add_export(commands: argparse._SubParsersAction) -> None:
    p = commands.add_parser("export", help="write weights as the product reads them", description=_export.__doc__)
    p.add_argument("trained", type=Path, help="folder that `train` wrote")
    p.add_argument("target", type=Path, help="folder that is written: weights.safetensors, recipe.json")
    p.add_argument("--report", type=Path, required=True, help="what `evaluate --raw-scales --report` wrote")
    p.set_defaults(run=_export)


def _export(options: argparse.Namespace) -> None:
    """Write weights in half precision with their recipe: inputs, sizes, outputs, data, seconds, held-out scores, calibration of
    the scales, hash."""
    import json

    from lab.prior.export import export

    recipe = export(options.trained, options.target, json.loads(options.report.read_text()))
    print(f"{options.target}: {recipe['parameters']} parameters, sha256 {recipe['sha256'][:16]}...")


def _add_pack(commands: argparse._SubParsersAction) -> None:
    p = commands.add_parser("pack", help="pack everything for a GPU machine without a network", description=_pack.__doc__)
    p.add_argument("target", type=Path, help="folder that is written")
    p.add_argument("--wheels", type=Path, required=True, help="folder of wheels of mitsuba and drjit for that machine's Python")
    p.add_argument("--assets", type=Path, help="folder or file of textures and skies")
    p.add_argument("--init", type=Path, help="weights (.safetensors) to start from")
    p.set_defaults(run=_pack)


def _pack(options: argparse.Namespace) -> None:
    """Pack code, renderer, denoiser, assets and first weights into a folder of less than 64 MiB. There, `bash run.sh OUT` unpacks
    it and trains with workers on a CUDA device. The machine needs Python with torch, numpy, scipy, numba, Pillow, safetensors."""
    from lab.prior.pack import pack

    size = pack(options.target, options.wheels, options.assets, options.init)
    print(f"{options.target}: {size / 2**20:.1f} MiB")


def _widths(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if not all(part.isdigit() and int(part) % 8 == 0 and int(part) > 0 for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}; write multiples of 8 with commas, for example 40,80,128")
    return tuple(int(part) for part in parts)


def _range(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    if not (first.isdigit() and last.isdigit() and int(first) < int(last)):
        raise argparse.ArgumentTypeError(f"{text!r}; write FIRST:STOP, for example 30000:31000")
    return int(first), int(last)


def _part(text: str) -> tuple[int, int]:
    i, _, n = text.partition("/")
    if not (i.isdigit() and n.isdigit() and int(i) < int(n)):
        raise argparse.ArgumentTypeError(f"{text!r}; write I/N with I from 0 to N - 1, for example 0/2")
    return int(i), int(n)


if __name__ == "__main__":
    sys.exit(main())
