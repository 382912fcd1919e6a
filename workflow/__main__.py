"""`python -m workflow <stage> <scene>`: what the rules call, and what a person calls in a debugger.

Also `python -m workflow verify [scene ...]`, `python -m workflow study <study>` and `python -m workflow batch` (collect what
their jobs left, at any time) and `python -m workflow lpips_vgg` (fetches weights).
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable
from pathlib import Path

from iif_core.errors import InputError
from workflow.registry import STAGES


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m workflow", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for stage in STAGES:
        sub = commands.add_parser(stage)
        sub.add_argument("scene")
        sub.add_argument("--quality", default="draft")
        sub.add_argument("--threads", type=int, default=2)
        sub.add_argument("--fingerprint", help="refuse to run when it differs")
        sub.add_argument("--log", type=Path)
    study = commands.add_parser("study")
    study.add_argument("study")
    study.add_argument("--quality", default="draft")
    study.add_argument("--fingerprint", help="of the plan; recorded by Snakemake, not checked")
    study.add_argument("--log", type=Path)
    lpips = commands.add_parser("lpips_vgg")
    lpips.add_argument("--log", type=Path)
    batch = commands.add_parser("batch")
    batch.add_argument("--quality", default="draft")
    batch.add_argument("--fingerprint", help="of the plan whose jobs are all done; without it the summary is a partial one")
    batch.add_argument("--refused", action="store_true", help="only say which scenes cannot be run, and fail")
    batch.add_argument("--log", type=Path)
    verify = commands.add_parser("verify")
    verify.add_argument("scenes", nargs="*")
    return parser.parse_args()


def _verify(scenes: list[str]) -> int:
    from workflow.artifacts.verify import damaged

    problems = list(damaged(Path("."), scenes or None))
    for line in problems:
        print(line)
    print(f"{len(problems)} damaged" if problems else "all artefacts are as they were written")
    return 1 if problems else 0


def _guarded(what: str, run: Callable[[], None], failed: Callable[[str], None] = lambda reason: None) -> int:
    try:
        run()
    except InputError as error:
        logging.getLogger("error").error("%s", error)
        failed(str(error))
        return 1
    except Exception as error:
        logging.getLogger("error").exception("%s stopped on an unexpected error (a bug: please report it with this log)", what)
        failed(f"{type(error).__name__}: {error} (a bug: please report it with the log)")
        return 1
    return 0


def _run_stage(arguments: argparse.Namespace) -> int:
    from workflow.runtime.job import run_stage
    from workflow.runtime.job_state import Outcome

    note = Path("results") / arguments.scene / "benchmarks" / f"{arguments.command}.threads"
    note.parent.mkdir(parents=True, exist_ok=True)
    note.write_text(f"{arguments.threads}\n")
    outcome = Outcome(arguments.scene, arguments.command, arguments.fingerprint)
    outcome.started()
    code = _guarded(
        f"{arguments.command} of {arguments.scene}",
        lambda: run_stage(arguments.command, arguments.scene, arguments.quality, arguments.threads, arguments.fingerprint),
        outcome.failed,
    )
    if code == 0:
        outcome.done()
    return code


def _batch(arguments: argparse.Namespace) -> int:
    from workflow.batch import summary

    if arguments.refused:
        return _guarded("batch", lambda: summary.refuse(arguments.quality))
    return _guarded("batch", lambda: summary.write_summary(arguments.quality, arguments.fingerprint))


def main() -> int:
    """Exit code 0, or 1 with one line on stderr."""
    arguments = _arguments()
    if arguments.command == "verify":
        return _verify(arguments.scenes)
    from workflow.runtime import native

    try:  # before NumPy is imported: a BLAS that has started keeps its threads
        native.prepare()
        native.limit_threads(getattr(arguments, "threads", 1))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    from workflow.runtime.job import configure_logging

    configure_logging(arguments.log)
    if arguments.command == "study":
        from workflow.studies.table import write_study

        return _guarded(f"study {arguments.study}", lambda: write_study(arguments.study, arguments.quality))
    if arguments.command == "lpips_vgg":
        from workflow.models.lpips import fetch_vgg

        return _guarded("fetching VGG16", fetch_vgg)
    if arguments.command == "batch":
        return _batch(arguments)
    return _run_stage(arguments)


if __name__ == "__main__":
    sys.exit(main())
