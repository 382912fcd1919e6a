"""`python -m lab <command>`: what the rules of the laboratory call, and tables that are kept in the repository.

`study <study>` collects the scores of a study, `grid <study>` draws a sheet of its pictures, `design <study>` chooses the runs
of a screening, `relighting` keeps the rows of that study and makes its page, `stability` measures numerical errors or collects
them, `points` takes points of speed and accuracy from a study, `claims` takes from the study `regret` what is expected of
decisions, `costs` fits the cost of jobs again, and `pack <capture> <folder>` makes a folder scene of a capture. `python -m
lab.prior`, `python -m lab.freeze` and `python -m lab.mutants` have their own commands.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from iif_core.errors import InputError
from workflow.runtime.ending import guarded


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    out = argparse.ArgumentParser(prog="python -m lab", description=__doc__)
    commands = out.add_subparsers(dest="command", required=True)

    def command(name: str, *, quality: bool = False) -> argparse.ArgumentParser:
        own = commands.add_parser(name)
        own.add_argument("--log", type=Path)
        if quality:
            own.add_argument("--quality", default="draft")
        return own

    study = command("study", quality=True)
    study.add_argument("study")
    study.add_argument("--fingerprint", help="of the plan; recorded by Snakemake, not checked")
    study.add_argument("--keep", type=Path, help="CSV file to which the scores that are finished so far are added; nothing else")
    grid = command("grid", quality=True)
    grid.add_argument("study")
    design = command("design")
    design.add_argument("study", help="whose `design` has factors and a number of trajectories; its runs are printed")
    design.add_argument("--seed", type=int, default=0)
    command("relighting", quality=True)
    stability = command("stability")
    stability.add_argument("part", nargs="?", help="part that is measured; without it, the parts are collected")
    stability.add_argument("--keep", action="store_true", help="copy the collected table to lab/notebook/ and make its page")
    stability.add_argument("--fingerprint", help="of the code; recorded by Snakemake, not checked")
    command("points")
    command("claims")
    pack = command("pack")
    pack.add_argument("capture", type=Path, help="folder of a finished stage `capture`, such as results/kitchen/capture")
    pack.add_argument("folder", type=Path, help="where the scene goes; new or empty")
    costs = command("costs")
    costs.add_argument("--sizes", action="store_true", help="the jobs ran next to others: take memory and disk, but no times")
    costs.add_argument("results", nargs="*", type=Path, help="folders like results/ whose finished jobs are added to the table")
    return out


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code is 0, or 1 with one message on stderr."""
    options = parser().parse_args(arguments)
    from workflow.runtime import native

    try:  # before NumPy is imported: a BLAS that has started keeps its threads
        native.prepare()
        native.limit_threads(1)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    from workflow.runtime.job import configure_logging

    if guarded("the log", lambda: configure_logging(options.log)):
        return 1
    return globals()[f"_{options.command}"](options)


def _study(options: argparse.Namespace) -> int:
    from lab.studies.table import keep_rows, write_study
    from workflow.runtime.job_state import JobState

    name, quality, kept = options.study, options.quality, options.keep
    work = partial(keep_rows, name, quality, kept) if kept else partial(write_study, name, quality)
    return guarded(f"study {name}", work, JobState("studies", name))


def _grid(options: argparse.Namespace) -> int:
    from lab.studies.grid import write_grid
    from workflow.runtime.job_state import JobState

    work = partial(write_grid, options.study, options.quality)
    return guarded(f"grid {options.study}", work, JobState("studies", f"{options.study}.grid"))


def _design(options: argparse.Namespace) -> int:
    from lab.studies.screening import runs

    return guarded("design", lambda: print("\n".join(f'    - "{run}"' for run in runs(options.study, options.seed))))


def _relighting(options: argparse.Namespace) -> int:
    from lab.studies.relighting import keep

    return guarded("relighting", partial(keep, options.quality))


def _stability(options: argparse.Namespace) -> int:
    from lab.stability import record

    part = options.part
    work = partial(record.write_part, part) if part else record.keep if options.keep else record.collect
    return guarded(f"stability {part or ''}".strip(), work)


def _points(options: argparse.Namespace) -> int:
    from lab.points.front import write_points

    return guarded("points", lambda: print("\n".join(write_points())))


def _claims(options: argparse.Namespace) -> int:
    from lab.studies.files import load_study
    from lab.studies.regret import TABLE, write_claims
    from workflow.decisions.expected import SHIPPED

    return guarded("claims", lambda: write_claims(load_study("regret"), TABLE, SHIPPED))


def _costs(options: argparse.Namespace) -> int:
    from lab.costs.refit import refit

    return guarded("costs", lambda: print("\n".join(refit(options.results, sizes=options.sizes))))


def _pack(options: argparse.Namespace) -> int:
    from lab.packing import pack

    return guarded("pack", lambda: print("\n".join(pack(options.capture, options.folder))))


if __name__ == "__main__":
    sys.exit(main())
