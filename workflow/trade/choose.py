"""Which quality a run gets: named, or chosen for a number of seconds or for a score."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iif_core.errors import InputError
from workflow.artifacts.files import write_json
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fingerprints
from workflow.runtime import forecast
from workflow.settings import study_files
from workflow.settings.loading import canonical, overridden, photographs, scene_origin
from workflow.settings.names import DEFAULT, did_you_mean, quality_names
from workflow.trade import bench
from workflow.trade.points import SCORES, SHIPPED, Point, measured_scores, named, point_of, points, unknown

CHOOSES = ("quality", "point", "budget", "target")
"""Keys of `--config`, of which one may be given."""
OTHERS = ("events", "inputs", "maps", "colour")
"""The other keys of `--config`, which choose no quality: where jobs tell of themselves, how inputs are compared, and what
`score/<scene>` reads."""


LABORATORY = "with simulated predictions and given objects (from photographs alone, expect several dB less)"
"""How the points were measured. It stands next to every number that comes from them."""
MOST_SCENES = 5
"""Largest number of scenes that are listed one by one with what differs from the quality."""


class Request(NamedTuple):
    """What `--config` asks for, checked as far as no scene is needed.

    Attributes:
        key, value: as given.
        quality: the quality by name. If each scene is to choose its own, this is the quality of all that is not a scene.
        cores: that Snakemake may use.
    """

    key: str
    value: str
    quality: str
    cores: int


class Choice(NamedTuple):
    """The quality of a scene, and the line that explains it to a person."""

    quality: str
    line: str = ""


def read(config: Mapping[str, Any], given: Collection[str], cores: int | None) -> Request:
    """Return what `--config` asks for.

    Args:
        config: all keys, with their defaults.
        given: keys that were given on the command line or in files of the user.
        cores: that Snakemake may use; None on a cluster, where jobs are expected to take two.

    Raises:
        InputError: unknown keys or values.
    """
    keys = CHOOSES + OTHERS
    odd = sorted(set(config) - set(keys))
    if odd:
        raise InputError(
            f"--config {', '.join(odd)}: unknown key.{did_you_mean(odd[0], keys)} Allowed: {', '.join(keys)}."
            " Everything else belongs in config/scenes/<scene>.yaml (docs/reference/settings.md)."
        )
    asked = [key for key in CHOOSES if key in config and (key in given or key != "quality")]
    if len(asked) > 1:
        raise InputError(f"--config {', '.join(asked)}: each of them chooses the quality; give one of them")
    key = asked[0] if asked else "quality"
    value = str(config.get(key, DEFAULT))
    if key == "point" and value not in points():
        raise InputError(f"--config point={value}: {unknown(value)}")
    if key in ("quality", "point"):
        if value not in quality_names():
            known = quality_names()
            raise InputError(
                f"--config quality={value}: unknown quality.{did_you_mean(value, known)} Allowed: {', '.join(known)}"
            )
        return Request(key, value, value, cores or 1)
    if key == "budget":
        _number("budget", value, "seconds of wall time, e.g. budget=120")
    else:
        _score(value)
    return Request(key, value, DEFAULT, cores or 2)


def choice(request: Request, scene: str) -> Choice:
    """Return the quality of a scene. Variants of studies keep theirs; variants of `bench` have the quality of their point.

    A choice that was made before is kept as long as request, points and settings are what they were (`keep`), although by now the
    machine is known better: an interrupted run continues, and a finished one is not repeated.

    Raises:
        InputError: settings of the scene that cannot be used, a budget that no point keeps to, a target that none reaches.
    """
    parts = study_files.derived(scene)
    if parts or request.key in ("quality", "point"):
        return Choice(canonical(parts.variant if parts and parts.study == study_files.BENCH else request.quality))
    kept = _kept(request, scene)
    return kept or (_by_budget if request.key == "budget" else _by_target)(request.value, scene, request.cores)


def keep(request: Request, chosen: Mapping[str, Choice]) -> None:
    """Write down what was chosen for each scene, when the jobs begin."""
    for scene, made in chosen.items():
        if request.key in ("budget", "target") and made.line:
            write_json(_file(scene), {**_marks(request, scene, made.quality), **made._asdict()})


def _kept(request: Request, scene: str) -> Choice | None:
    try:
        document = json.loads(_file(scene).read_text())
        made = Choice(str(document["quality"]), str(document["line"]))
        same = _marks(request, scene, made.quality).items() <= document.items()
    except (OSError, ValueError, KeyError, TypeError, AttributeError, InputError):
        return None
    return made if same else None


def _file(scene: str) -> Path:
    return Path("results") / scene / "choice.json"


def _marks(request: Request, scene: str, quality: str) -> dict[str, str]:
    """What a choice depends on, in addition to the speed of the machine."""
    table = hashlib.sha256(SHIPPED.read_bytes()).hexdigest()[:16]
    settings = hashlib.sha256(fingerprints.resolved(scene, quality).encode()).hexdigest()[:16]
    return {"request": f"{request.key}={request.value}", "points": table, "settings": settings}


def fits(stage: str, scene: str) -> bool:
    """Return whether a job makes materials of a scene, whose scores depend on its quality, and no variant of a study."""
    return not STAGES[stage].on_demand and not study_files.derived(scene)


def told(request: Request, chosen: Mapping[str, Choice]) -> list[str]:
    """Return what is said about the qualities of a run, `chosen` for each scene."""
    point = point_of(request.quality) if request.key in ("quality", "point") else None
    if not point:
        return [choice.line for choice in chosen.values() if choice.line]
    lines = [_expectation(request.quality, point)]
    for scene in chosen:
        changed = [] if study_files.derived(scene) else overridden(scene, request.quality)
        if changed:
            lines.append(f"{scene} may differ: {scene_origin(scene)} sets {', '.join(changed)} itself")
    if len(lines) > MOST_SCENES + 1:
        return [lines[0], f"{len(lines) - 1} of {len(chosen)} scenes set some of it themselves"]
    return lines


def reached(request: Request, scenes: Iterable[str]) -> list[str]:
    """Return what is said after the run about the score that was asked for."""
    if request.key != "target":
        return []
    (score, wanted), lines = _score(request.value), []
    for scene in scenes:
        summary = Path(f"results/{scene}/metrics/summary.json")
        if study_files.derived(scene) or not _is_current(
            summary.with_name("manifest.json"), scene, choice(request, scene).quality
        ):
            continue
        found = measured_scores(json.loads(summary.read_text())).get(score)
        if found is None:
            lines.append(f"{scene}: target {request.value}: it has no such score{_missing(score)}")
        elif found >= wanted:
            lines.append(f"{scene}: target {request.value}: reached, {found:.2f} dB")
        else:
            lines.append(
                f"{scene}: target {request.value}: missed, {found:.2f} dB; `snakemake --cores 2 bench/{scene}` measures what this"
                " room can reach, and the same command then chooses by that"
            )
    return lines


def _is_current(manifest: Path, scene: str, quality: str) -> bool:
    try:
        return json.loads(manifest.read_text())["fingerprint"] == fingerprints.fingerprint("metrics", scene, quality)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _number(key: str, text: str, form: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise InputError(f"--config {key}: found {text!r}, needed {form}")
    return value


def _costs(scene: str, cores: int) -> dict[str, forecast.Wall]:
    """What each point takes, without those whose settings do not go with the scene.

    Raises:
        InputError: what is wrong with the first point, if none is left.
    """
    fingerprints.fingerprint("capture", scene, next(iter(points())))  # says what is wrong with the data of the scene
    out, problems = {}, []
    for name in points():
        try:
            out[name] = forecast.wall(scene, name, cores)
        except InputError as problem:
            problems.append(problem)
    if not out:
        raise problems[0]
    return out


def _by_budget(text: str, scene: str, cores: int) -> Choice:
    """The best point among those that are expected to keep to the budget."""
    budget, costs = _number("budget", text, "seconds of wall time, e.g. budget=120"), _costs(scene, cores)
    kept = [name for name, cost in costs.items() if cost.seconds.middle <= budget]
    if not kept:
        cheapest = min(costs, key=lambda name: costs[name].seconds.middle)
        least, changed = costs[cheapest].seconds, overridden(scene, cheapest)
        why = f"{scene_origin(scene)} sets {', '.join(changed)} itself. " if changed else ""
        raise InputError(
            f"--config budget={text}: {scene} is expected to take at least some {least.middle:.0f} s on this machine, at point"
            f" {cheapest} ({forecast.span(least)}){costs[cheapest].beside}. {why}Ask for more, or run it with"
            f" --config point={cheapest}"
        )
    name = max(kept, key=lambda name: (points()[name].expected("albedo").mean, -costs[name].seconds.middle))
    line = f"{scene}, budget {text} s: {_about(scene, name, costs[name])}; {_expectation(name, points()[name])}"
    return Choice(canonical(name), line)


def _score(text: str) -> tuple[str, float]:
    score, _, number = text.partition(":")
    if score not in SCORES:
        raise InputError(f"--config target={text}: needed <score>:<dB> with {' or '.join(SCORES)}, e.g. target=held_out:24")
    return score, _number(f"target={score}", number, "decibels, e.g. target=held_out:24")


def _by_target(text: str, scene: str, cores: int) -> Choice:
    """The cheapest point that is expected to reach a score, by what was measured in this room where `bench` ran."""
    score, wanted = _score(text)
    if score == "held_out" and not json.loads(fingerprints.resolved(scene, DEFAULT))["capture"]["test_every"]:
        raise InputError(f"--config target={text}: {scene} holds no photograph out; set `capture: {{test_every: 8}}` in its file")
    shifts, basis = _shifts(scene, score)
    expected = {name: point.expected(score).mean + shifts[name] for name, point in points().items()}
    name = next((name for name in points() if expected[name] >= wanted), "")
    if not name:
        best = max(expected, key=lambda name: expected[name])
        raise InputError(
            f"--config target={text}: the best point, {best}, is expected to reach {score} {expected[best]:.1f} dB in {scene}"
            f" ({basis}). Ask for less, or take it with --config point={best}"
        )
    try:
        about = _about(scene, name, forecast.wall(scene, name, cores))
    except InputError:  # of a kind of work of which the model has no row
        about = f"point {name}; what it takes was never measured for such a scene"
    return Choice(canonical(name), f"{scene}, target {text}: {expected[name]:.1f} dB expected ({basis}); {about}")


def _shifts(scene: str, score: str) -> tuple[dict[str, float], str]:
    """How much better a score is in this room than in the rooms of the table, point by point, and on what that is based. Between
    the points that `bench` ran it is interpolated along the front, and beyond them it stays what it is at the last one."""
    import numpy as np  # not for runs that ask for no target

    found, names = bench.measured(scene, score), list(points())
    if found is None:
        rooms = sorted({room for point in points().values() for room in point.rooms})
        said = f"the mean of {', '.join(rooms)}, {LABORATORY}; `snakemake --cores 2 bench/{scene}` measures it in this room"
        return dict.fromkeys(names, 0.0), said
    known = [(place, found[name] - points()[name].expected(score).mean) for place, name in enumerate(names) if name in found]
    if not known:
        raise InputError(
            f"--config target={score}: {scene} has no such score{_missing(score)}, or its bench is of other settings"
        )
    places, moved = zip(*known, strict=True)
    shifts = np.interp(range(len(names)), places, moved).tolist()
    return dict(zip(names, shifts, strict=True)), f"from {bench.FOLDER / scene / 'bench.json'}"


def _missing(score: str) -> str:
    why = "its source has no ground truth" if score == "albedo" else "no photograph was held out; set `capture.test_every`"
    return f": {why}"


def _about(scene: str, name: str, cost: forecast.Wall) -> str:
    also = [quality for quality, point in named().items() if point == name]
    names = f"point {name}" + (f" ({', '.join(also)})" if also else "")
    changed = overridden(scene, name)
    over = f". {scene_origin(scene)} sets {', '.join(changed)} itself" if changed else ""
    return f"{names}, about {cost.seconds.middle:.0f} s ({forecast.span(cost.seconds)}){cost.beside}{over}"


def _expectation(quality: str, point: Point) -> str:
    parts = []
    for score in SCORES:
        expected = point.expected(score)
        words = "held-out photographs, re-rendered" if score == "held_out" else f"{score} up to scale"
        parts.append(f"{words} {expected.mean:.1f} dB ({expected.low:.1f} to {expected.high:.1f})")
    return f"quality {quality}, {photographs(quality)}: PSNR in {len(point.rooms)} rooms {LABORATORY}: {', '.join(parts)}"
