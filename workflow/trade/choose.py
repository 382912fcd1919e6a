"""Which quality a run gets: named, or chosen for a number of seconds or for a score."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iif_core.errors import InputError
from workflow.artifacts.files import facts_in, write_json
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fingerprints
from workflow.runtime import forecast
from workflow.settings import derived
from workflow.settings.loading import canonical, overridden, photographs, scene_origin
from workflow.settings.names import DEFAULT, did_you_mean, quality_names
from workflow.trade import bench
from workflow.trade.points import SCORES, SHIPPED, Point, measured_scores, point_of, points

KEYS = ("quality", "replace", "maps", "colour")
"""Keys of `--config`; `replace` lets a cheaper result take the place of a finished one, the last two are what `score/<scene>`
reads."""
YES, NO = ("yes", "true"), ("no", "false")
"""Values of `replace`; YAML makes truth values of the words."""
RENAMED = {
    "point": "write --config quality={}",
    "budget": "write --config quality={}s",
    "target": "write --config quality={}",
    "events": "ask `python -m workflow status --json`, or Snakemake with --logger",
}
"""Keys of earlier versions -> what took their place."""
LABORATORY = "with simulated predictions and given objects (from photographs alone, expect several dB less)"
"""How the qualities were measured. It stands next to every number that comes from them."""


class Request(NamedTuple):
    """What `--config quality=...` asks for, checked as far as no scene is needed.

    Attributes:
        value: as given.
        quality: by name. If each scene is to choose its own, this is the quality of all that is not a scene.
        cores: that Snakemake may use.
        seconds: of wall time that a scene may take; 0 = not asked for.
        score, wanted: name of the score that a scene is to reach, and how many dB; empty and 0 = not asked for.
    """

    value: str
    quality: str
    cores: int
    seconds: float = 0.0
    score: str = ""
    wanted: float = 0.0

    @property
    def chooses(self) -> bool:
        """Whether each scene chooses its own quality."""
        return bool(self.seconds or self.score)


class Choice(NamedTuple):
    """The quality of a scene, and the line that explains it to a person."""

    quality: str
    line: str = ""


def read(config: Mapping[str, Any], cores: int | None) -> Request:
    """Return what `--config` asks for.

    Args:
        config: all keys, with their defaults.
        cores: that Snakemake may use; None on a cluster, where jobs are expected to take two.

    Raises:
        InputError: unknown keys or values.
    """
    for key in sorted(set(config) - set(KEYS)):
        if key in RENAMED:
            raise InputError(f"--config {key}={config[key]}: there is no `{key}` any more; {RENAMED[key].format(config[key])}")
        raise InputError(
            f"--config {key}: unknown key.{did_you_mean(key, KEYS)} Allowed: {', '.join(KEYS)}."
            " Everything else belongs in config/scenes/<scene>.yaml (docs/reference/settings.md)."
        )
    if str(config.get("replace", "no")).lower() not in (*YES, *NO):
        raise InputError(f"--config replace={config['replace']}: allowed are yes and no")
    value, known = str(config.get("quality", DEFAULT)), quality_names()
    if value in known:
        return Request(value, value, cores or 1)
    score, _, number = value.partition(":")
    if re.fullmatch(r"\d{1,8}(\.\d+)?s", value) and float(value[:-1]) > 0:
        return Request(value, DEFAULT, cores or 2, seconds=float(value[:-1]))
    if score in SCORES and re.fullmatch(r"\d{1,3}(\.\d+)?", number) and float(number) > 0:
        return Request(value, DEFAULT, cores or 2, score=score, wanted=float(number))
    raise InputError(
        f"--config quality={value}: unknown quality.{did_you_mean(value, known)} Allowed: {', '.join(known)}; seconds of wall"
        f" time, such as 120s; a score in dB, such as {' or '.join(f'{name}:24' for name in SCORES)}"
    )


def refuse_cheaper(scene: str, quality: str, config: Mapping[str, Any]) -> None:
    """Refuse a run whose result would silently take the place of a finished one that was made from more pixels.

    Raises:
        InputError: `scenes/<scene>` has another quality, with more photographs, pixels or predictions, and `--config replace=yes`
            was not given.
    """
    made = facts_in(Path("scenes") / scene / "manifest.json")
    before, work = str(made.get("quality", "")), _work(made.get("settings"))
    if not work or before not in quality_names() or canonical(before) == canonical(quality) or _is_yes(config.get("replace")):
        return
    if _work(json.loads(fingerprints.resolved(scene, quality))) < work:
        raise InputError(
            f"scenes/{scene}: holds a result of quality {before}, which the cheaper quality {quality} would replace."
            f" Add --config quality={before} to keep it up to date, or --config quality={quality} replace=yes"
        )


def _work(settings: Any) -> int:
    """Return how many pixels are predicted under the settings of a scene, in the unit of one prediction; 0 = not known."""
    try:
        capture = settings["capture"]
        return int(capture["views"] * capture["width"] * capture["height"] * settings["prior"].get("samples", 1))
    except (AttributeError, KeyError, TypeError):
        return 0


def _is_yes(value: Any) -> bool:
    return str(value).lower() in YES


def choice(request: Request, scene: str) -> Choice:
    """Return the quality of a scene. Variants of studies keep theirs; variants of `bench` have the quality in their name.

    A choice that was made before is kept as long as request, points and settings are what they were (`keep`), although by now the
    machine is known better: an interrupted run continues, and a finished one is not repeated.

    Raises:
        InputError: settings of the scene that cannot be used, seconds that no point keeps to, a score that none reaches.
    """
    parts = derived.derived(scene)
    if parts or not request.chooses:
        return Choice(canonical(parts.variant if parts and parts.study == derived.BENCH else request.quality))
    return _kept(request, scene) or (_in_time if request.seconds else _to_score)(request, scene)


def keep(request: Request, chosen: Mapping[str, Choice]) -> None:
    """Write down what was chosen for each scene, when the jobs begin."""
    for scene, made in chosen.items():
        if request.chooses and made.line:
            write_json(_file(scene), {**_marks(request, scene, made.quality), **made._asdict()})


def _kept(request: Request, scene: str) -> Choice | None:
    document = facts_in(_file(scene))
    made = Choice(str(document.get("quality", "")), str(document.get("line", "")))
    try:
        return made if _marks(request, scene, made.quality).items() <= document.items() else None
    except InputError:  # there is no such quality any more
        return None


def _file(scene: str) -> Path:
    return Path("results") / scene / "choice.json"


def _marks(request: Request, scene: str, quality: str) -> dict[str, str]:
    """What a choice depends on, in addition to the speed of the machine."""
    table = hashlib.sha256(SHIPPED.read_bytes()).hexdigest()[:16]
    settings = hashlib.sha256(fingerprints.resolved(scene, quality).encode()).hexdigest()[:16]
    return {"request": request.value, "points": table, "settings": settings}


def fits(stage: str, scene: str) -> bool:
    """Return whether a job makes materials of a scene, whose scores depend on its quality, and no variant of a study."""
    return not STAGES[stage].on_demand and not derived.derived(scene)


def told(request: Request, chosen: Mapping[str, Choice]) -> list[str]:
    """Return what is said about the qualities of a run, `chosen` for each scene."""
    point = None if request.chooses else point_of(request.quality)
    if not point:
        return [choice.line for choice in chosen.values() if choice.line]
    scenes = {scene: overridden(scene, request.quality) for scene in chosen if not derived.derived(scene)}
    own = [f"{scene_origin(scene)} sets {', '.join(changed)} itself" for scene, changed in scenes.items() if changed]
    return [
        _expectation(request.quality, point, chosen),
        *own[:5],
        *([f"and {len(own) - 5} more scenes do"] if len(own) > 5 else []),
    ]


def reached(request: Request, scenes: Iterable[str]) -> list[str]:
    """Return what is said after the run about the score that was asked for."""
    lines = []
    for scene in scenes if request.score else ():
        folder = Path(f"results/{scene}/metrics")
        try:
            mark = json.loads((folder / "manifest.json").read_text())["fingerprint"]
            if derived.derived(scene) or mark != fingerprints.fingerprint("metrics", scene, choice(request, scene).quality):
                continue
            found = measured_scores(json.loads((folder / "summary.json").read_text())).get(request.score)
        except (OSError, ValueError, KeyError, TypeError):
            continue
        said = "it has no such score" + _missing(request.score)
        if found is not None:
            advice = f"; `snakemake --cores 2 bench/{scene}` measures what this room can reach, and the next choice follows it"
            said = f"{'reached' if found >= request.wanted else 'missed'}, {found:.2f} dB"
            said += advice if found < request.wanted else ""
        lines.append(f"{scene}: {request.value}: {said}")
    return lines


def _in_time(request: Request, scene: str) -> Choice:
    """The best point among those that are expected to take no longer than asked; points whose settings do not go with the scene
    are left out."""
    fingerprints.fingerprint("capture", scene, next(iter(points())))  # says what is wrong with the data of the scene
    costs, problems = {}, []
    for name in points():
        try:
            costs[name] = forecast.wall(scene, name, request.cores)
        except InputError as problem:
            problems.append(problem)
    if not costs:
        raise problems[0]
    kept = [name for name, cost in costs.items() if cost.seconds.middle <= request.seconds]
    if not kept:
        cheapest = min(costs, key=lambda name: costs[name].seconds.middle)
        raise InputError(
            f"--config quality={request.value}: {scene} is expected to take longer on this machine, at the least:"
            f" {_about(scene, cheapest, costs[cheapest])}. Ask for more, or run it with --config quality={cheapest}"
        )
    name = max(kept, key=lambda name: (points()[name].expected("albedo").mean, -costs[name].seconds.middle))
    line = f"{scene}, {request.value}: {_about(scene, name, costs[name])}; {_expectation(name, points()[name], [scene])}"
    return Choice(canonical(name), line)


def _to_score(request: Request, scene: str) -> Choice:
    """The cheapest point that is expected to reach a score, by what was measured in this room where `bench` ran."""
    score = request.score
    if score == "held_out" and not json.loads(fingerprints.resolved(scene, DEFAULT))["capture"]["test_every"]:
        raise InputError(
            f"--config quality={request.value}: {scene} holds no photograph out; set `capture: {{test_every: 8}}` in its file"
        )
    shift, basis = _shift(scene, score)
    expected = {name: point.expected(score).mean + shift for name, point in points().items()}
    name = next((name for name in points() if expected[name] >= request.wanted), "")
    if not name:
        best = max(expected, key=lambda name: expected[name])
        raise InputError(
            f"--config quality={request.value}: the best of the measured qualities, {best}, is expected to reach {score}"
            f" {expected[best]:.1f} dB in {scene} ({basis}). Ask for less, or take it with --config quality={best}"
        )
    try:
        about = _about(scene, name, forecast.wall(scene, name, request.cores))
    except InputError:  # of a kind of work of which the model has no row
        about = f"quality {name}; what it takes was never measured for such a scene"
    return Choice(canonical(name), f"{scene}, {request.value}: {expected[name]:.1f} dB expected ({basis}); {about}")


def _shift(scene: str, score: str) -> tuple[float, str]:
    """How much better a score is in this room than in the rooms of the table, in the mean of the qualities that `bench` ran, and
    on what that is based."""
    found = bench.measured(scene, score)
    if found is None:
        rooms = sorted({room for point in points().values() for room in point.rooms})
        said = f"the mean of {', '.join(rooms)}, {LABORATORY}; `snakemake --cores 2 bench/{scene}` measures it in this room"
        return 0.0, said
    better = [value - points()[name].expected(score).mean for name, value in found.items() if name in points()]
    if not better:
        raise InputError(
            f"--config quality={score}: {scene} has no such score{_missing(score)}, or its bench is of other settings"
        )
    return sum(better) / len(better), f"from {bench.FOLDER / scene / 'bench.json'}"


def _missing(score: str) -> str:
    why = "its source has no ground truth" if score == "albedo" else "no photograph was held out; set `capture.test_every`"
    return f": {why}"


def _about(scene: str, name: str, cost: forecast.Wall) -> str:
    changed, also = overridden(scene, name), canonical(name)
    over = f". {scene_origin(scene)} sets {', '.join(changed)} itself" if changed else ""
    named = name if also == name else f"{name} ({also})"
    return f"quality {named}, about {cost.seconds.middle:.0f} s ({forecast.span(cost.seconds)}){cost.beside}{over}"


def _expectation(quality: str, point: Point, scenes: Iterable[str]) -> str:
    """Return what a quality is, and the scores that were measured of it where the scenes are like those that were measured."""
    what, kinds = f"quality {quality}, {photographs(quality)}", set()
    for scene in scenes:
        kinds.add(json.loads(fingerprints.resolved(scene, quality)).get("prior", {}).get("kind"))
    if kinds != {"simulated"}:
        return f"{what}; how accurate the result of photographs is: docs/guide/accuracy.md"
    parts = []
    for score in SCORES:
        expected = point.expected(score)
        words = "held-out photographs, re-rendered" if score == "held_out" else f"{score} up to scale"
        parts.append(f"{words} {expected.mean:.1f} dB ({expected.low:.1f} to {expected.high:.1f})")
    return f"{what}: PSNR in {len(point.rooms)} rooms {LABORATORY}: {', '.join(parts)}"
