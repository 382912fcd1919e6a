"""`python -m lab.prior <command>`: the laboratory of the learned prior (docs/development/prior.md)."""

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
    _add_rooms(commands)
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
