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
from typing import Any, NamedTuple

from iif_core.errors import InputError
from workflow.registry import STAGES
from workflow.runtime.ending import guarded


class Command(NamedTuple):
    """A command.

    Attributes:
        run: does it and returns the exit code, or raises `InputError`. It imports what it needs, so that no command waits for the
            libraries of another.
        words: its arguments and options, keys of `WORDS`.
        computes: whether it needs native libraries, and logs.
    """

    run: Callable[[argparse.Namespace], int]
    words: str
    computes: bool = True


WORDS: dict[str, dict[str, Any]] = {
    "scene": {},
    "scenes": {"nargs": "*"},
    "a": {"help": "a scene or a variant with a finished result"},
    "b": {},
    "maps": {"type": Path, "help": "folder with albedo/<view>.exr or .png, roughness/, metallic/, emission/, rgb/"},
    "--quality": {"default": "draft"},
    "--threads": {"type": int, "default": 2},
    "--fingerprint": {"help": "of the plan: a stage refuses to run when it differs; without it, a summary is a partial one"},
    "--part": {"help": "only the views of this part, such as 3-of-8; the stage stays unfinished"},
    "--plan": {"default": "", "help": "of config/relight/; without it, the relightings of the scene itself"},
    "--colour": {"default": "auto", "help": "how albedo is decoded: srgb, linear, or auto (PNG as sRGB)"},
    "--output": {"type": Path, "help": "folder; by default compare/<a>,<b> or score/<scene>"},
    "--over": {"action": "store_true", "help": "the run is over: what has not ended by now was killed"},
    "--refused": {"action": "store_true", "help": "only say which scenes cannot be run, and fail"},
    "--json": {"action": "store_true", "help": "one JSON object for each scene, each on a line"},
    "--log": {"type": Path},
}
"""Arguments and options, each with the keywords of `argparse`."""
SCATTERED = ("prior",)
"""Stages whose views can be dealt out to several jobs."""


def _status(arguments: argparse.Namespace) -> int:
    from workflow.batch.status import tell
    from workflow.trade import choose

    request = choose.read({"quality": arguments.quality}, None)
    return tell(arguments.scenes, lambda scene: choose.choice(request, scene).quality, arguments.json)


def _verify(arguments: argparse.Namespace) -> int:
    from workflow.artifacts.verify import damaged, with_artefacts
    from workflow.runtime.fingerprint import REPOSITORY
    from workflow.runtime.input_digests import changed
    from workflow.runtime.job_state import written_out
    from workflow.settings.names import did_you_mean

    scenes, known = arguments.scenes, with_artefacts()
    if absent := next((scene for scene in scenes if scene not in known), None):
        raise InputError(
            f"{absent}: neither results/{absent} nor scenes/{absent} holds anything to verify."
            f"{did_you_mean(absent, known)} What is here: {', '.join(known) or 'nothing'}."
        )
    problems = [*damaged(Path("."), scenes or None), *changed(scenes or known, REPOSITORY)]
    for line in problems:
        print(written_out(line))
    nothing = "nothing to compare: no artefacts below results/ and scenes/"
    sound = "all artefacts are as they were written" if known else nothing
    print(f"{len(problems)} damaged" if problems else sound)
    return 1 if problems else 0


def _stage(arguments: argparse.Namespace) -> int:
    from workflow.artifacts import locks
    from workflow.runtime.job import configure_logging, read_part, run_stage
    from workflow.runtime.job_state import JobState
    from workflow.scene.named import check_overrides
    from workflow.settings import scene_origin

    stage, scene = arguments.command, arguments.scene
    part = read_part(arguments.part) if getattr(arguments, "part", None) else None
    name = f"{stage}.{part}" if part else stage
    what, state = f"{name} of {scene}", JobState(scene, name, arguments.fingerprint)
    if guarded(what, lambda: scene_origin(scene)):
        return 1  # no folder is made for a scene that does not exist

    def run() -> None:
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


def _planned(arguments: argparse.Namespace) -> int:
    return guarded("planned", partial(_write_plan, arguments.scene, arguments.quality))


def _write_plan(scene: str, quality: str) -> None:
    """Write plan/<scene>/plan.yaml: the decisions of stage `plan`, and what is expected of them."""
    from workflow.artifacts import StageReader, links
    from workflow.artifacts.files import write_atomically
    from workflow.decisions.expected import STAGES as COSTLY
    from workflow.decisions.expected import with_expectation
    from workflow.decisions.record import plan_sentences, plan_text
    from workflow.report.evidence import of_geometry
    from workflow.report.verdict import Evidence, foreseen
    from workflow.runtime import forecast

    links.check_folder(f"plan/{scene}")
    document = StageReader(Path("results") / scene / "plan", "plan", scene).json("plan.json")
    plan, probes = document["plan"], document.get("probes") or {}
    cost = forecast.together(COSTLY, scene, quality)
    text = plan_text(scene, quality, [with_expectation(item, cost) for item in plan])
    write_atomically(Path("plan") / scene / "plan.yaml", lambda path: path.write_text(text))
    capture = StageReader(Path("results") / scene / "capture", "capture", scene)
    tests = int((capture.table("cameras.parquet")["split"] == "test").sum())
    kept = f", {tests} of them kept for testing" if tests else ""
    counts = f"{capture.rows('cameras.parquet')} photographs{kept}; {capture.rows('faces.parquet')} faces"
    facts, found = capture.json("capture.json"), Path("results") / scene / "reconstruction"
    alone = StageReader(found, "reconstruction", scene).json("reconstruction.json") if facts["source"] == "photographs" else {}
    known = of_geometry(
        facts, capture.rows("cameras.parquet"), alone, probes.get("escape_share") or {}, probes.get("photographed_share")
    )
    told = (
        ("what was read", [counts, *facts["notes"]]),
        (f"what {scene} requires", plan_sentences(plan)),
        ("what the report will say of photographs and mesh", foreseen(Evidence(**known))),
    )
    for title, lines in told:
        print("\n".join([f"{title}:", *(f"  {line}" for line in lines)]))
    print(f"all of it, with numbers and what is expected: plan/{scene}/plan.yaml")


def _relit(arguments: argparse.Namespace) -> int:
    from workflow.relighting.copies import deliver

    return guarded("relit", partial(deliver, arguments.scene, arguments.plan, arguments.quality))


def _bench(arguments: argparse.Namespace) -> int:
    from workflow.trade.bench import write_bench

    return guarded("bench", partial(write_bench, arguments.scene))


def _compare(arguments: argparse.Namespace) -> int:
    from workflow.comparison.pair import write_comparison

    pair = (arguments.a, arguments.b)
    place = arguments.output or Path("compare") / ",".join(pair)
    return _page("compare", arguments, place, partial(write_comparison, *pair, arguments.quality, place))


def _score(arguments: argparse.Namespace) -> int:
    from workflow.comparison.maps import write_scores

    place = arguments.output or Path("score") / arguments.scene
    work = partial(write_scores, arguments.scene, arguments.maps, arguments.quality, arguments.colour, place)
    return _page(f"score {arguments.scene}", arguments, place, work)


def _page(what: str, arguments: argparse.Namespace, place: Path, work: Callable[[], None]) -> int:
    """Do `work`, which writes to a folder. Where the user names no place, a stranger's results may have put a link there."""
    from workflow.artifacts import links
    from workflow.runtime.job_state import JobState

    def checked() -> None:
        if not arguments.output:
            links.check_folder(str(place))
        work()

    return guarded(what, checked, JobState("studies", arguments.command))


def _lpips_vgg(arguments: argparse.Namespace) -> int:
    from workflow.models.lpips import fetch_vgg
    from workflow.runtime.job_state import JobState

    return guarded("fetching VGG16", fetch_vgg, JobState("weights", "lpips_vgg"))


_OF_STAGE = "scene --quality --threads --fingerprint --log"
COMMANDS = {
    **{stage: Command(_stage, _OF_STAGE + " --part" * (stage in SCATTERED)) for stage in STAGES},
    "planned": Command(_planned, "scene --quality --log"),
    "relit": Command(_relit, "scene --plan --quality --log"),
    "bench": Command(_bench, "scene --log"),
    "compare": Command(_compare, "a b --quality --output --log"),
    "score": Command(_score, "scene maps --colour --quality --output --log"),
    "lpips_vgg": Command(_lpips_vgg, "--log"),
    "batch": Command(_batch, "--quality --fingerprint --over --refused --log"),
    "status": Command(_status, "scenes --quality --json", computes=False),
    "verify": Command(_verify, "scenes", computes=False),
}
"""Command -> what it does and takes."""


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m workflow", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, command in COMMANDS.items():
        sub = commands.add_parser(name)
        for word in command.words.split():
            sub.add_argument(word, **WORDS[word])
    return parser.parse_args()


def main() -> int:
    """Run the command; the exit code is 0, or 1 with one message on stderr."""
    arguments = _arguments()
    command = COMMANDS[arguments.command]
    try:
        if command.computes and _prepare(arguments):
            return 1
        return command.run(arguments)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _prepare(arguments: argparse.Namespace) -> int:
    """Make native libraries and the log ready; return the exit code."""
    from workflow.runtime import native

    native.prepare()  # before NumPy is imported: a BLAS that has started keeps its threads
    native.limit_threads(getattr(arguments, "threads", 1))
    from workflow.runtime.job import configure_logging

    log = None if arguments.command in STAGES else arguments.log  # the log of a stage belongs to the process that makes it
    return guarded("the log", lambda: configure_logging(log))


if __name__ == "__main__":
    sys.exit(main())
