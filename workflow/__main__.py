"""`python -m workflow <stage> <scene>` runs one stage: the rules call it, and so does a person with a debugger.

`python -m workflow status [scene ...]` says where scenes stand, `verify [scene ...]` checks files against their manifests,
`batch` collects what jobs have left so far, `relit <scene>` copies pictures of relightings to relight/, `bench <scene>` shows
what three points of speed and accuracy did in a room, `planned <scene>` what a room was found to require, `compare <a> <b>` puts
two results side by side, `score <scene> <folder>` scores anyone's maps, and `lpips_vgg` fetches weights.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from iif_core.errors import InputError
from workflow.registry import STAGES
from workflow.runtime.ending import guarded

SCATTERED = ("prior",)
"""Stages whose views can be dealt out to several jobs."""


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
    lpips = commands.add_parser("lpips_vgg")
    lpips.add_argument("--log", type=Path)
    batch = commands.add_parser("batch")
    batch.add_argument("--quality", default="draft")
    batch.add_argument("--fingerprint", help="of the plan whose jobs are all done; without it the summary is a partial one")
    batch.add_argument("--over", action="store_true", help="the run is over: what has not ended by now was killed")
    batch.add_argument("--refused", action="store_true", help="only say which scenes cannot be run, and fail")
    batch.add_argument("--log", type=Path)
    status = commands.add_parser("status")
    status.add_argument("scenes", nargs="*")
    status.add_argument("--quality", default="draft")
    status.add_argument("--json", action="store_true", help="one JSON object for each scene, each on a line")
    verify = commands.add_parser("verify")
    verify.add_argument("scenes", nargs="*")
    return parser.parse_args()


def _verify(scenes: list[str]) -> int:
    from workflow.artifacts.verify import damaged, with_artefacts
    from workflow.runtime.job_state import written_out
    from workflow.settings.names import did_you_mean

    known = with_artefacts()
    if absent := next((scene for scene in scenes if scene not in known), None):
        print(
            f"error: {absent}: neither results/{absent} nor scenes/{absent} holds anything to verify."
            f"{did_you_mean(absent, known)} What is here: {', '.join(known) or 'nothing'}.",
            file=sys.stderr,
        )
        return 1
    problems = list(damaged(Path("."), scenes or None))
    for line in problems:
        print(written_out(line))
    nothing = "nothing to compare: no artefacts below results/ and scenes/"
    sound = "all artefacts are as they were written" if known else nothing
    print(f"{len(problems)} damaged" if problems else sound)
    return 1 if problems else 0


def _status(scenes: list[str], quality: str, as_json: bool) -> int:
    from workflow.batch.status import tell
    from workflow.trade import choose

    try:
        request = choose.read({"quality": quality}, None)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return tell(scenes, lambda scene: choose.choice(request, scene).quality, as_json)


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
    if guarded(what, lambda: scene_origin(scene)):
        return 1  # no folder is made for a scene that does not exist

    def run() -> None:
        note = Path("results") / scene / "benchmarks" / f"{name}.threads"
        write_atomically(note, lambda path: path.write_text(f"{arguments.threads}\n"))
        check_overrides(stage, scene, arguments.quality)
        run_stage(stage, scene, arguments.quality, arguments.threads, arguments.fingerprint, part)

    with ExitStack() as held:
        # Without `state`: until the lock is held, that file and the log are those of another process.
        if guarded(what, lambda: held.enter_context(locks.alone(Path("results"), scene, name))):
            return 1
        return guarded(what, lambda: configure_logging(arguments.log)) or guarded(what, run, state)


def _batch(arguments: argparse.Namespace) -> int:
    from workflow.artifacts import links
    from workflow.batch import summary
    from workflow.settings.loading import photographs

    if guarded("batch", lambda: links.refuse(Path("results"), summary.FOLDER.name)):
        return 1
    if guarded("quality", lambda: photographs(arguments.quality)):  # once, and not of every scene
        return 1
    if arguments.refused:
        return guarded("batch", lambda: summary.refuse(arguments.quality))
    return guarded("batch", lambda: summary.write_summary(arguments.quality, arguments.fingerprint, arguments.over))


def _planned(scene: str, quality: str) -> None:
    """Write plan/<scene>/plan.yaml: the decisions of stage `plan`, and what is expected of them."""
    from workflow.artifacts import StageReader, links
    from workflow.artifacts.files import write_atomically
    from workflow.decisions.expected import STAGES as COSTLY
    from workflow.decisions.expected import with_expectation
    from workflow.decisions.record import plan_text
    from workflow.runtime import forecast

    links.check_folder(f"plan/{scene}")
    plan = StageReader(Path("results") / scene / "plan", "plan", scene).json("plan.json")["plan"]
    cost = forecast.together(COSTLY, scene, quality)
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
    if arguments.command == "status":
        return _status(arguments.scenes, arguments.quality, arguments.json)
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
    from workflow.runtime.job_state import JobState

    log = None if arguments.command in STAGES else arguments.log  # the log of a stage belongs to the process that makes it
    if guarded("the log", lambda: configure_logging(log)):
        return 1
    if arguments.command in STAGES:
        return _run_stage(arguments)
    if arguments.command == "planned":
        return guarded("planned", partial(_planned, arguments.scene, arguments.quality))
    if arguments.command == "relit":
        from workflow.relighting.copies import deliver

        return guarded("relit", partial(deliver, arguments.scene, arguments.plan, arguments.quality))
    if arguments.command == "bench":
        from workflow.trade.bench import write_bench

        return guarded("bench", partial(write_bench, arguments.scene))
    if arguments.command == "compare":
        from workflow.comparison.pair import write_comparison

        pair = (arguments.a, arguments.b)
        place = arguments.output or Path("compare") / ",".join(pair)
        work = partial(write_comparison, *pair, arguments.quality, place)
        return guarded("compare", _into(arguments, place, work), JobState("studies", "compare"))
    if arguments.command == "score":
        from workflow.comparison.maps import write_scores

        place = arguments.output or Path("score") / arguments.scene
        work = partial(write_scores, arguments.scene, arguments.maps, arguments.quality, arguments.colour, place)
        return guarded(f"score {arguments.scene}", _into(arguments, place, work), JobState("studies", "score"))
    if arguments.command == "lpips_vgg":
        from workflow.models.lpips import fetch_vgg

        return guarded("fetching VGG16", fetch_vgg, JobState("weights", "lpips_vgg"))
    if arguments.command == "batch":
        return _batch(arguments)
    raise AssertionError(f"command {arguments.command} is not written")


if __name__ == "__main__":
    sys.exit(main())
