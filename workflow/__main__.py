"""`python -m workflow <stage> <scene>` runs one stage: the rules call it, and so does a person with a debugger.

`python -m workflow status [scene ...]` tells where scenes stand, `python -m workflow verify [scene ...]` checks files against
their manifests, `python -m workflow upgrade [scene ...]` brings manifests of an earlier version up to date, `python -m workflow
study <study>` and `python -m workflow batch` collect what jobs have left so far, `python -m workflow costs` fits the cost of
jobs again, `python -m workflow design <study>` chooses the runs of a screening, `python -m workflow points` takes points of
speed and accuracy from a study, `python -m workflow relit <scene>` copies pictures of relightings to relight/, `python -m
workflow bench <scene>` shows what three of them did in a room, `python -m workflow planned <scene>` what a room was found to
require, `python -m workflow claims` takes from the study `regret` what is expected of that, `python -m workflow compare <a> <b>`
puts two results side by side, `python -m workflow score <scene> <folder>` scores anyone's maps, `python -m workflow grid
<study>` draws a sheet of pictures, `python -m workflow relighting` keeps the rows of that study and makes its page, and `python
-m workflow lpips_vgg` fetches weights.
"""

from __future__ import annotations

import argparse
import errno
import logging
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from iif_core.errors import InputError
from workflow.registry import STAGES

if TYPE_CHECKING:
    from workflow.runtime.job_state import JobState

SCATTERED = ("prior",)
"""Stages whose views can be dealt out to several jobs."""
INTERRUPTED = "it was interrupted; the same command continues"


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
        if stage in SCATTERED:
            sub.add_argument("--part", help="only the views of this part, such as 3-of-8; the stage stays unfinished")
    study = commands.add_parser("study")
    study.add_argument("study")
    study.add_argument("--quality", default="draft")
    study.add_argument("--fingerprint", help="of the plan; recorded by Snakemake, not checked")
    study.add_argument("--keep", type=Path, help="CSV file to which the scores that are finished so far are added; nothing else")
    study.add_argument("--log", type=Path)
    design = commands.add_parser("design")
    design.add_argument("study", help="whose `design` has factors and a number of trajectories; its runs are printed")
    design.add_argument("--seed", type=int, default=0)
    points = commands.add_parser("points")
    points.add_argument("--log", type=Path)
    claims = commands.add_parser("claims")
    claims.add_argument("--log", type=Path)
    planned = commands.add_parser("planned")
    planned.add_argument("scene")
    planned.add_argument("--quality", default="draft")
    planned.add_argument("--log", type=Path)
    relit = commands.add_parser("relit")
    relit.add_argument("scene")
    relit.add_argument("--plan", default="", help="of config/relight/; without it, the relightings of the scene itself")
    relit.add_argument("--quality", default="draft")
    relit.add_argument("--log", type=Path)
    bench = commands.add_parser("bench")
    bench.add_argument("scene")
    bench.add_argument("--log", type=Path)
    compare = commands.add_parser("compare")
    compare.add_argument("a", help="a scene or a variant with a finished result")
    compare.add_argument("b")
    compare.add_argument("--quality", default="draft")
    compare.add_argument("--output", type=Path, help="folder; by default compare/<a>,<b>")
    compare.add_argument("--log", type=Path)
    score = commands.add_parser("score")
    score.add_argument("scene")
    score.add_argument("maps", type=Path, help="folder with albedo/<view>.exr or .png, roughness/, metallic/, emission/, rgb/")
    score.add_argument("--colour", default="auto", help="how albedo is decoded: srgb, linear, or auto (PNG as sRGB)")
    score.add_argument("--quality", default="draft")
    score.add_argument("--output", type=Path, help="folder; by default score/<scene>")
    score.add_argument("--log", type=Path)
    grid = commands.add_parser("grid")
    grid.add_argument("study")
    grid.add_argument("--quality", default="draft")
    grid.add_argument("--log", type=Path)
    relighting = commands.add_parser("relighting")
    relighting.add_argument("--quality", default="draft")
    relighting.add_argument("--log", type=Path)
    lpips = commands.add_parser("lpips_vgg")
    lpips.add_argument("--log", type=Path)
    batch = commands.add_parser("batch")
    batch.add_argument("--quality", default="draft")
    batch.add_argument("--fingerprint", help="of the plan whose jobs are all done; without it the summary is a partial one")
    batch.add_argument("--refused", action="store_true", help="only say which scenes cannot be run, and fail")
    batch.add_argument("--log", type=Path)
    stability = commands.add_parser("stability")
    stability.add_argument("part", nargs="?", help="part that is measured; without it, the parts are collected")
    stability.add_argument("--keep", action="store_true", help="copy the collected table to docs/results/ and make its page")
    stability.add_argument("--fingerprint", help="of the code; recorded by Snakemake, not checked")
    stability.add_argument("--log", type=Path)
    costs = commands.add_parser("costs")
    costs.add_argument("--log", type=Path)
    costs.add_argument("--sizes", action="store_true", help="the jobs ran beside others: take memory and disk, but no times")
    costs.add_argument("results", nargs="*", type=Path, help="folders like results/ whose finished jobs are added to the table")
    status = commands.add_parser("status")
    status.add_argument("scenes", nargs="*")
    status.add_argument("--quality", default="draft")
    status.add_argument("--json", action="store_true", help="one JSON object for each scene, each on a line")
    verify = commands.add_parser("verify")
    verify.add_argument("scenes", nargs="*")
    upgrade = commands.add_parser("upgrade")
    upgrade.add_argument("scenes", nargs="*")
    return parser.parse_args()


def _not_here(scenes: list[str], what: str) -> bool:
    """Say of a scene that nothing of it is here, and return whether there is one."""
    from workflow.artifacts.verify import with_artefacts
    from workflow.settings.names import did_you_mean

    known = with_artefacts()
    for scene in scenes:
        if scene not in known:
            print(
                f"error: {scene}: neither results/{scene} nor scenes/{scene} holds anything to {what}."
                f"{did_you_mean(scene, known)} What is here: {', '.join(known) or 'nothing'}.",
                file=sys.stderr,
            )
            return True
    return False


def _upgrade(scenes: list[str]) -> int:
    from workflow.artifacts.upgrade import upgrade

    if _not_here(scenes, "upgrade"):
        return 1
    done = []
    for upgraded, line in upgrade(Path("results"), scenes or None):
        done.append(upgraded)
        print(line, flush=True)
    print(f"{sum(done)} manifests upgraded, {len(done) - sum(done)} left as they are" if done else "nothing to upgrade")
    return 0 if all(done) else 1


def _verify(scenes: list[str]) -> int:
    from workflow.artifacts.verify import damaged, with_artefacts
    from workflow.runtime.attempts import written_out

    if _not_here(scenes, "verify"):
        return 1
    problems = list(damaged(Path("."), scenes or None))
    for line in problems:
        print(written_out(line))
    nothing = "nothing to compare: no artefacts below results/ and scenes/"
    sound = "all artefacts are as they were written" if with_artefacts() else nothing
    print(f"{len(problems)} damaged" if problems else sound)
    return 1 if problems else 0


def _unknown_quality(quality: str) -> int:
    """Refuse it once, before it is refused of every scene of a batch and a summary of that takes the place of a good one."""
    from workflow.settings.loading import photographs

    return _guarded("quality", lambda: photographs(quality))


def _status(scenes: list[str], quality: str, as_json: bool) -> int:
    from workflow.status.standing import quality_of
    from workflow.status.table import tell

    return tell(scenes, partial(quality_of, quality=quality), as_json)


CAUSES = {
    errno.ENOSPC: "the disk is full; make room (results/ of scenes that are no longer needed), then run the same command again",
    errno.EDQUOT: "your quota of the disk is used up; make room, then run the same command again",
    errno.EIO: "the disk reports an error; look at the system's log, and check with `snakemake verify` when it is repaired",
    errno.EROFS: "the disk is mounted read-only; remount it, or work in a folder on another disk",
    errno.EACCES: "not allowed for you; give yourself the right to write there",
    errno.EPERM: "not allowed for you; give yourself the right to write there",
    errno.EMFILE: "too many open files; raise the limit (`ulimit -n 4096`), then run the same command again",
    errno.ESTALE: "the network disk lost the file; run the same command again",
    errno.EINTR: "a call was interrupted; run the same command again",
    errno.EFBIG: "the file would be larger than is allowed; raise the limit (`ulimit -f unlimited`), or use another disk",
    errno.ENOMEM: "not enough memory; end other programs or give the job more, then run the same command again",
    errno.ENOTDIR: "a file is in the place of a folder; move it away, then run the same command again",
    errno.EEXIST: "a file is in the place of a folder; move it away, then run the same command again",
    errno.EISDIR: "a folder is in the place of a file; move it away, then run the same command again",
    errno.ENAMETOOLONG: "the name is too long for this disk; give the scene or its views shorter names",
}
"""What to do about errors of the machine, which no code of ours can mend."""


def _of_the_machine(error: OSError) -> str:
    """Return a sentence on an error of the operating system: the file, what is wrong, and what to do."""
    from workflow.runtime.attempts import written_out

    name = error.filename2 or error.filename  # of a renaming, what was to be replaced: the other is a name of ours
    place = f"{name}: " if name else ""
    known = CAUSES.get(error.errno or 0)
    words = known or f"{error.strerror or error} (if the file should be there, please report it with the log)"
    return written_out(f"{place}{words}")


def _guarded(what: str, run: Callable[[], object], state: JobState | None = None) -> int:
    """Call `run`; log an error, record it in `state`, and return the exit code."""
    code = 1
    try:
        if state:
            state.started()
        run()
        if state:
            state.done()
    except InputError as error:
        logging.getLogger("error").error("%s", error)
        reason = str(error)
    except OSError as error:
        reason = _of_the_machine(error)
        logging.getLogger("error").error("%s", reason, exc_info=error.errno not in CAUSES)
    except MemoryError as error:
        reason = f"{what}: {CAUSES[errno.ENOMEM]}{f' ({error})' if str(error) else ''}"
        logging.getLogger("error").error("%s", reason)
    except Exception as error:
        logging.getLogger("error").exception("%s stopped on an unexpected error (a bug: please report it with this log)", what)
        reason = f"{type(error).__name__}: {error} (a bug: please report it with the log)"
    except KeyboardInterrupt:
        logging.getLogger("error").error("%s was interrupted", what)
        reason, code = INTERRUPTED, 128 + signal.SIGINT
    else:
        return 0
    if state:
        with suppress(OSError):  # a full disk has been told of
            state.failed(reason)
    return code


def _run_stage(arguments: argparse.Namespace) -> int:
    from workflow.artifacts import locks
    from workflow.artifacts.files import write_atomically
    from workflow.runtime.job import configure_logging, read_part, run_stage
    from workflow.runtime.job_state import JobState
    from workflow.scene.named import check_overrides
    from workflow.settings import scene_origin

    stage, scene = arguments.command, arguments.scene
    try:
        part = read_part(arguments.part) if getattr(arguments, "part", None) else None
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    name = f"{stage}.{part}" if part else stage
    what, state = f"{name} of {scene}", JobState(scene, name, arguments.fingerprint)
    if _guarded(what, lambda: scene_origin(scene)):
        return 1  # no folder is made for a scene that does not exist

    def run() -> None:
        note = Path("results") / scene / "benchmarks" / f"{name}.threads"
        write_atomically(note, lambda path: path.write_text(f"{arguments.threads}\n"))
        check_overrides(stage, scene, arguments.quality)
        run_stage(stage, scene, arguments.quality, arguments.threads, arguments.fingerprint, part)

    with ExitStack() as held:
        # Without `state`: until the lock is held, that file and the log are those of another process.
        if _guarded(what, lambda: held.enter_context(locks.alone(Path("results"), scene, name))):
            return 1
        return _guarded(what, lambda: configure_logging(arguments.log)) or _guarded(what, run, state)


def _batch(arguments: argparse.Namespace) -> int:
    from workflow.artifacts import links
    from workflow.batch import summary

    if _guarded("batch", lambda: links.refuse(Path("results"), summary.FOLDER.name)):
        return 1
    if arguments.refused:
        return _guarded("batch", lambda: summary.refuse(arguments.quality))
    return _guarded("batch", lambda: summary.write_summary(arguments.quality, arguments.fingerprint))


def _design(name: str, seed: int) -> None:
    """Print the runs of a screening, as lines for the file of the study."""
    from workflow.settings.study_files import load_study
    from workflow.studies.screening import trajectories

    design = load_study(name).design
    if design is None or not design.trajectories:
        raise InputError(f"config/studies/{name}.yaml: no `design` with `trajectories`, as tradeoff_screening.yaml has")
    for run in trajectories(list(design.factors), design.trajectories, seed):
        print(f'    - "{run}"')


def _planned(scene: str, quality: str) -> None:
    """Write plan/<scene>/plan.yaml: the decisions of stage `plan`, and what is expected of them."""
    from workflow.artifacts import StageReader, links
    from workflow.artifacts.files import write_atomically
    from workflow.decisions.expected import whole, with_expectation
    from workflow.decisions.record import plan_text

    links.check_folder(f"plan/{scene}")
    plan = StageReader(Path("results") / scene / "plan", "plan", scene).json("plan.json")["plan"]
    cost = whole(scene, quality)
    text = plan_text(scene, quality, [with_expectation(item, cost) for item in plan])
    write_atomically(Path("plan") / scene / "plan.yaml", lambda path: path.write_text(text))
    print(text)


def _into(arguments: argparse.Namespace, place: Path, work: Callable[[], None]) -> Callable[[], None]:
    """Return `work` with a check before it: where the user names no place, a stranger's results may have put a link there."""

    def checked() -> None:
        from workflow.artifacts import links

        if not arguments.output:
            links.check_folder(str(place))
        work()

    return checked


def main() -> int:
    """Run the command; the exit code is 0, or 1 with one message on stderr."""
    arguments = _arguments()
    if arguments.command in ("batch", "status") and _unknown_quality(arguments.quality):
        return 1
    if arguments.command == "status":
        return _status(arguments.scenes, arguments.quality, arguments.json)
    if arguments.command == "verify":
        return _verify(arguments.scenes)
    if arguments.command == "upgrade":
        return _upgrade(arguments.scenes)
    from workflow.runtime import native

    try:  # before NumPy is imported: a BLAS that has started keeps its threads
        native.prepare()
        native.limit_threads(getattr(arguments, "threads", 1))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    from workflow.runtime.job import configure_logging
    from workflow.runtime.job_state import JobState

    log = None if arguments.command in STAGES else arguments.log  # that of a stage belongs to the process that makes it
    if _guarded("the log", lambda: configure_logging(log)):
        return 1
    if arguments.command in STAGES:
        return _run_stage(arguments)
    if arguments.command == "study":
        from workflow.studies.table import keep_rows, write_study

        name, quality, kept = arguments.study, arguments.quality, arguments.keep
        work = partial(keep_rows, name, quality, kept) if kept else partial(write_study, name, quality)
        return _guarded(f"study {name}", work, JobState("studies", name))
    if arguments.command == "points":
        from workflow.trade.front import write_points

        return _guarded("points", lambda: print("\n".join(write_points())))
    if arguments.command == "claims":
        from workflow.decisions.expected import SHIPPED
        from workflow.settings.study_files import load_study
        from workflow.studies.regret import TABLE, write_claims

        return _guarded("claims", lambda: write_claims(load_study("regret"), TABLE, SHIPPED))
    if arguments.command == "planned":
        return _guarded("planned", partial(_planned, arguments.scene, arguments.quality))
    if arguments.command == "relit":
        from workflow.studies.relit import deliver

        return _guarded("relit", partial(deliver, arguments.scene, arguments.plan, arguments.quality))
    if arguments.command == "bench":
        from workflow.trade.bench import write_bench

        return _guarded("bench", partial(write_bench, arguments.scene))
    if arguments.command == "compare":
        from workflow.comparison.pair import write_comparison

        pair = (arguments.a, arguments.b)
        place = arguments.output or Path("compare") / ",".join(pair)
        work = partial(write_comparison, *pair, arguments.quality, place)
        return _guarded("compare", _into(arguments, place, work), JobState("studies", "compare"))
    if arguments.command == "score":
        from workflow.comparison.maps import write_scores

        place = arguments.output or Path("score") / arguments.scene
        work = partial(write_scores, arguments.scene, arguments.maps, arguments.quality, arguments.colour, place)
        return _guarded(f"score {arguments.scene}", _into(arguments, place, work), JobState("studies", "score"))
    if arguments.command == "grid":
        from workflow.studies.grid import write_grid

        work = partial(write_grid, arguments.study, arguments.quality)
        return _guarded(f"grid {arguments.study}", work, JobState("studies", f"{arguments.study}.grid"))
    if arguments.command == "relighting":
        from workflow.studies.relighting import keep

        return _guarded("relighting", partial(keep, arguments.quality))
    if arguments.command == "design":
        return _guarded("design", lambda: _design(arguments.study, arguments.seed))
    if arguments.command == "lpips_vgg":
        from workflow.models.lpips import fetch_vgg

        return _guarded("fetching VGG16", fetch_vgg, JobState("weights", "lpips_vgg"))
    if arguments.command == "stability":
        from workflow.stability import record

        part = arguments.part
        work = partial(record.write_part, part) if part else record.keep if arguments.keep else record.collect
        return _guarded(f"stability {part or ''}".strip(), work)
    if arguments.command == "batch":
        return _batch(arguments)
    if arguments.command == "costs":
        from workflow.costs.refit import refit

        return _guarded("costs", lambda: print("\n".join(refit(arguments.results, sizes=arguments.sizes))))
    raise AssertionError(f"command {arguments.command} is not written")


if __name__ == "__main__":
    sys.exit(main())
