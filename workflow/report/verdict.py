"""Judges a result: four lights (geometry, light, materials, scale) with reasons and remedies, from what the stages measured.

`evidence.py` collects the `Evidence`; `LIMITS` holds every threshold, with its reason; `MEANS` says what a green light means, and
`calibration.py` how often it did.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from workflow.decisions import held
from workflow.report import calibration
from workflow.report.wording import percent

NOTED, GREEN, AMBER, RED = "noted", "green", "amber", "red"
ORDER = (NOTED, GREEN, AMBER, RED)
NAMED = 3
"""Doubtful lamps that a finding names."""
WORDS = {NOTED: "not judged", GREEN: "good", AMBER: "doubtful", RED: "poor"}
"""A light, or one of its findings, in a word, so that no colour is needed to read it. No light is `NOTED`."""


class Limit(NamedTuple):
    """Where a number stops to be good.

    Attributes:
        amber: the last value that is green.
        red: the last value that is amber.
        why: reason of both.
    """

    amber: float
    red: float
    why: str

    def level(self, value: float) -> str:
        """Return the colour of a value. Larger is worse where `red` is larger than `amber`; NaN is red."""
        sign = 1.0 if self.red >= self.amber else -1.0
        if sign * value <= sign * self.amber:
            return GREEN
        return AMBER if sign * value <= sign * self.red else RED


LIMITS: dict[str, Limit] = {
    "escape": Limit(0.1, 0.4, "windows let 2 to 5 % of the rays out, a missing ceiling two thirds, and its light is a guess"),
    "depth": Limit(0.02, 0.05, "of the distance: 2 % is the noise of depth cameras; beyond 5 % the source refuses by default"),
    "edges": Limit(0.2, 0.05, "correlation of edges in photographs and mesh: a good scan has 0.4; the source warns below 0.2"),
    "agreement": Limit(0.7, 0.4, "correlation of a photograph with the others: 0.9 is usual; below 0.2 a single one is left out"),
    "lost": Limit(0.1, 1 / 3, "of the photographs; beyond a third the fault lies in the capture, not in single photographs"),
    "photographed": Limit(0.4, 0.3, "of the surface that lights the rest; below 0.3 indirect light is not read from photographs"),
    "stability": Limit(0.7, 0.3, "adjusted Rand index of the objects under small changes; the plan's own limit is 0.7"),
    "misfit": Limit(0.05, 0.4, "mean squared relative error of the light: good captures have 0.01 to 0.04; 0.4 is 60 %"),
    "doubtful_area": Limit(0.5, 2.0, "m^2 taken for lamps that hardly outshine the room, or are hardly photographed"),
    "unlikely_power": Limit(0.5, 1.0, "share of the power of lamps in those that are more likely surface: most of the light"),
    "missed": Limit(0.1, 1.0, "of what is saturated in photographs; good captures have up to 0.05, half-seen windows 0.5"),
    "light_spread": Limit(0.1, 0.3, "spread of the light's error over objects, by the truth, as a logarithm: 10 % and 35 %"),
    "rerendering": Limit(20.0, 16.0, "dB: 20 is an error of 10 % of the sensor's range, 16 is one of 16 %"),
    "rival": Limit(1.0, 99.0, "dB by which the mean of other photographs, which knows no light, predicts held-out ones better"),
    "albedo": Limit(20.0, 14.0, "dB against the truth: 20 is an error of 0.1; one grey for a whole room reaches 10 to 12"),
    "roughness": Limit(20.0, 10.0, "dB against the truth: 20 is an error of 0.1, 10 one of 0.3; rooms have 13 to 24"),
    "metallic": Limit(20.0, 10.0, "dB against the truth: 20 is an error of 0.1; rooms, mostly without metal, have 19 or more"),
    "uncertainty": Limit(0.15, 0.2, "claimed standard error of the albedo, median over the surface; good captures reach 0.14"),
    "unfitted": Limit(0.2, 0.6, "share of the pixels on objects that could not be fitted by themselves"),
    "level_error": Limit(0.25, 0.5, "claimed relative error of the level; rooms with truth have 0.05 to 0.28"),
    "raised": Limit(1.02, 1.5, "factor on all light without which albedos would exceed 1; 1.5 contradicts every claimed error"),
    "light_scale": Limit(1.2, 2.0, "factor between the two estimates of the level, in either direction"),
    "discrepancy": Limit(1.5, 4.0, "mean square of the discrepancy of objects' levels over what is claimed; 1 is as claimed"),
}  # fmt: skip
"""Every threshold of the verdict (docs/guide/results.md#the-four-lights)."""

LIGHT_OF = {
    **dict.fromkeys(("escape", "depth", "edges", "agreement", "lost", "photographed"), "geometry"),
    **dict.fromkeys(("misfit", "doubtful_area", "unlikely_power", "missed", "light_spread"), "light"),
    **dict.fromkeys(("stability", "rerendering", "rival", "albedo", "roughness", "metallic"), "materials"),
    **dict.fromkeys(("uncertainty", "unfitted"), "materials"),
    **dict.fromkeys(("level_error", "raised", "light_scale", "discrepancy"), "scale"),
}
"""Which light a threshold is of."""


class Meaning(NamedTuple):
    """What a green light means.

    Attributes:
        within: error (a column `true_<name>` of lab/notebook/data/verdicts.csv) -> the largest that it means.
        words: the same as a clause, after "green means that".
    """

    within: dict[str, float]
    words: str


MEANS: dict[str, Meaning] = {
    "geometry": Meaning(
        {"offset": 0.02, "missing": 0.1},
        "three of four photographs lie on the mesh to within 2 % of their width, and that it lacks at most 10 % of the room's"
        " surface",
    ),
    "light": Meaning({"false_m2": 0.5}, "at most 0.5 m² of surface is taken for a lamp and is none"),
    "materials": Meaning(
        {"albedo_scaled": 0.15},
        "the albedo of what photographs show is off by at most 0.15 of 1 (root mean square), after one factor on all of it; it"
        " promises nothing about roughness and metallic",
    ),
    "scale": Meaning({"level_factor": 1.35}, "albedo as a whole is right to within a factor of 1.35"),
}
"""Light -> what its green means; `calibration.py` says of how many green ones in rooms with truth it is true."""


@dataclass(frozen=True)
class Evidence:
    """What is known about a result; None where nothing was measured. Shares are of 1, factors of 1, scores in dB.

    Attributes:
        escape: share of the rays from surface that leave the mesh; escape_camera: the same of the rays from cameras.
        depth: median disagreement of mesh and measured depth.
        edges: correlation of edges of photographs and mesh; edges_warn: whether the source found it too weak.
        agreement: median correlation of a photograph with what the others show of the same surface.
        confirmed: share of the pixels whose depth several photographs confirm, of a mesh that was found from photographs alone;
            built: m^2 of its sides where they show no surface.
        added: whether sides were made up around a scan.
        photographs: number of photographs; lost: how many were left out of those given.
        photographed: share of the surface met by rays from surface that photographs show.
        stability: of the objects; None also where objects are given.
        lamps: number of lamps that were found, a window counted once; unlikely: those of them that are more likely surface that
            reflects, each with its probability; unlikely_power: share of the power of all lamps that these have.
        environment: whether light from outside was found.
        doubtful_area: m^2 of what was taken for lamps without clear evidence (`evidence.doubtful_area`).
        misfit: of the light; light_spread: of the light against the truth.
        missed: share of what is saturated in photographs that is re-rendered dark; missed_in: photographs with most of it.
        worst: the photograph whose re-rendering is worst, and its PSNR.
        held_out, used: PSNR of re-renderings of photographs that were held out, and that were used.
        held_out_views: number of held-out photographs; others: PSNR of the mean of the other photographs on these;
            held_out_each: PSNR of each of them.
        albedo, roughness, metallic: PSNR against the truth, as they are; has_truth: whether there is truth.
        roughness_interval: half of the 95 % interval of roughness, median over the pixels; None if less than half have one.
        prior: kind of the prior.
        uncertainty: claimed standard error of the albedo.
        unfitted: share of the pixels on objects that take what others have.
        level: what fixed the level (`iif_core.fitting.gauge.KINDS`); level_error: its relative standard error.
        raised: factor by which all light was raised; light_scale: factor between the two estimates of the level.
        discrepancy: of the levels of objects.
        warnings: (stage, sentence) of the figures beyond their limits.
    """

    escape: float | None = None
    escape_camera: float | None = None
    depth: float | None = None
    edges: float | None = None
    edges_warn: bool = False
    agreement: float | None = None
    confirmed: float | None = None
    built: float = 0.0
    added: bool = False
    photographs: int = 0
    lost: int = 0
    photographed: float | None = None
    stability: float | None = None
    lamps: int = 0
    unlikely: Sequence[str] = ()
    unlikely_power: float = 0.0
    environment: bool = False
    doubtful_area: float | None = None
    misfit: float | None = None
    light_spread: float | None = None
    missed: float | None = None
    missed_in: Sequence[str] = ()
    held_out: float | None = None
    held_out_views: int = 0
    others: float | None = None
    held_out_each: Sequence[float] = ()
    used: float | None = None
    worst: tuple[str, float] | None = None
    albedo: float | None = None
    roughness: float | None = None
    metallic: float | None = None
    roughness_interval: float | None = None
    has_truth: bool = False
    prior: str = ""
    uncertainty: float | None = None
    unfitted: float | None = None
    level: str = ""
    level_error: float | None = None
    raised: float = 1.0
    light_scale: float = 1.0
    discrepancy: float | None = None
    warnings: Sequence[tuple[str, str]] = field(default_factory=tuple)


class Finding(NamedTuple):
    """One reason: its colour, a sentence with a number, and what to do about it (empty where it is green)."""

    level: str
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Light:
    """One of the four lights: the colour of its worst finding; findings are sorted from worst to best."""

    name: str
    question: str
    findings: Sequence[Finding]

    @property
    def level(self) -> str:
        return max([GREEN, *(f.level for f in self.findings)], key=ORDER.index)

    @property
    def word(self) -> str:
        return WORDS[self.level]

    @property
    def means(self) -> str:
        """What its colour means, from rooms with truth."""
        return calibration.words(self.name, self.level, MEANS[self.name].words)

    @property
    def shown(self) -> Sequence[Finding]:
        """What is not green, or else the first two findings."""
        return [f for f in self.findings if f.level in (AMBER, RED)] or self.findings[:2]

    @property
    def rest(self) -> Sequence[Finding]:
        return [f for f in self.findings if f not in self.shown]

    @property
    def rest_words(self) -> str:
        """How many of the rest passed, and how many say what nothing was judged by."""
        passed, noted = (sum((f.level == NOTED) == is_noted for f in self.rest) for is_noted in (False, True))
        told = [f"{_counted(passed, 'more check')} passed"] if passed else []
        return ", ".join([*told, *([f"{noted} not judged"] if noted else [])])


@dataclass(frozen=True)
class Verdict:
    """A sentence, its colour, and the four lights."""

    sentence: str
    level: str
    lights: Sequence[Light]

    @property
    def word(self) -> str:
        return WORDS[self.level]

    def document(self) -> dict[str, Any]:
        """Return the verdict as `verdict.json` has it: as text, with all findings."""
        lights = {
            light.name: {"verdict": light.word, "means": light.means, "findings": [
                {"verdict": WORDS[one.level], "text": one.text, "remedy": one.remedy} for one in light.findings
            ]}
            for light in self.lights
        }  # fmt: skip
        return {"verdict": self.word, "sentence": self.sentence, "lights": lights}


def judge(e: Evidence) -> Verdict:
    """Judge a result by its evidence."""
    doubts = _doubts(e)
    lights = [_doubted(light, doubts) for light in (_geometry(e), _light(e), _materials(e), _scale(e))]
    return Verdict(_sentence(lights, e), max((light.level for light in lights), key=ORDER.index), lights)


def foreseen(e: Evidence) -> list[str]:
    """Return what the geometry alone, which is known before anything else, says of a result: a word, then each finding that is
    not good, with what helps."""
    light = _geometry(e)
    bad = [finding for finding in light.findings if finding.level in (AMBER, RED)]
    return [f"geometry: {light.word}", *(f"{finding.text}. To do: {finding.remedy}" for finding in bad)]


def _doubts(e: Evidence) -> dict[str, str]:
    """Return light -> what is wrong with it that speaks against every light. Photographs, mesh and light go together: where one
    of them is wrong, any of them may be, and none is green."""
    worst = min((score for score in (e.held_out, e.used) if score is not None), default=None)
    found = [
        ("light", _finding("misfit", e.misfit, "surfaces are {} brighter or darker than it explains", "", ".0%", AMBER, np.sqrt)),
        ("light", _finding("doubtful_area", e.doubtful_area, "{} m² of lamps are doubtful", "", ".1f", AMBER)),
        ("materials", _finding("rerendering", worst, "re-renderings reach {} dB PSNR", "", ".1f")),
    ]
    out: dict[str, str] = {}
    for name, finding in found:
        if finding is not None and finding.level != GREEN and (name != "materials" or finding.level == RED):
            out.setdefault(name, finding.text)
    return out


def _doubted(light: Light, doubts: Mapping[str, str]) -> Light:
    """Return a light that is green by itself with the doubts of others, each in a sentence; all that they rest on, and what
    helps, stands there."""
    added = [
        Finding(AMBER, f"The {name} {'is' if name == 'light' else 'are'} in doubt ({what}), and this may have the same cause",
                f"See to the {name} first")
        for name, what in doubts.items()
        if light.level == GREEN  # what is worse has its own reason, and two lights that send to each other help nobody
    ]  # fmt: skip
    return _made(light.name, light.question, [*light.findings, *added])


def _doubtful(e: Evidence) -> Finding | None:
    return _finding(
        "doubtful_area", e.doubtful_area, "{} m² were taken for lamps that hardly outshine the room, or are hardly photographed",
        "Look at the largest lamps in the list below: where one is a bright wall or table, poses, mesh or exposures are wrong, or"
        " a real lamp is not in the photographs, or torn in the mesh", ".1f", AMBER,
    )  # fmt: skip


def _sentence(lights: Sequence[Light], e: Evidence) -> str:
    worst = max((light.level for light in lights), key=ORDER.index)
    named = [light for light in lights if light.level == worst]
    if worst == GREEN:
        unknown = "" if e.has_truth else " Without ground truth, none of them compares albedo or gloss with what they really are."
        return f"No check found a fault.{unknown}"
    names = _joined([light.name for light in named])
    reason = named[0].findings[0].text
    reason = reason[0].lower() + reason[1:] if not reason[:2].isupper() else reason
    if worst == AMBER:
        return f"Usable with care: {names} {'is' if len(named) == 1 and names != 'materials' else 'are'} in doubt ({reason})."
    return f"Do not rely on this result for {names}: {reason}."


def _joined(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _made(name: str, question: str, findings: Sequence[Finding | None]) -> Light:
    found = [finding for finding in findings if finding is not None]
    ordered = sorted(found, key=lambda finding: -ORDER.index(finding.level))
    return Light(name, question, ordered or [Finding(AMBER, "Nothing was measured", "Run the stage again")])


def _finding(
    limit: str,
    value: float | None,
    text: str,
    remedy: str,
    format_: str = "",
    worst: str = RED,
    shown: Callable[[float], float] = float,
) -> Finding | None:
    """Return the finding about a number, whose place in `text` is `{}`; None where the number is not known.

    `worst` is the worst colour that it may have; `shown` makes of the value what people read.
    """
    if value is None:
        return None
    level = LIMITS[limit].level(value) if np.isfinite(value) else RED
    level = min(level, worst, key=ORDER.index)
    words = format(shown(value), format_).replace("%", " %")
    return Finding(level, text.format(words), "" if level == GREEN else remedy)


def _warned(e: Evidence, stages: Sequence[str]) -> list[Finding]:
    return [
        Finding(
            AMBER, f"Numerical warning of stage {stage}: {sentence}", "See the sentence itself; docs/method/numerics.md#guards"
        )
        for stage, sentence in e.warnings
        if stage in stages
    ]


FROM_PHOTOGRAPHS = (
    "Look at reconstruction/overview.png: cameras stand where you stood, and walls where they are. Where it is wrong, take more"
    " photographs in between (docs/guide/programs.md#photographs-alone)"
)
"""What to do about a mesh that was found from the photographs alone, which does not fit them."""


def _geometry(e: Evidence) -> Light:
    lost = e.lost / max(e.photographs + e.lost, 1)
    edges = None
    if e.edges is not None:
        level = max(LIMITS["edges"].level(e.edges), AMBER if e.edges_warn else GREEN, key=ORDER.index)
        remedy = (
            FROM_PHOTOGRAPHS
            if e.confirmed is not None
            else "Look at the pictures 'alignment'; check source.axes, source.unit, and that each photograph has its own pose"
        )
        # Measured depth is stronger evidence than edges, which a room without texture hardly has.
        level = min(level, AMBER, key=ORDER.index) if e.depth is not None else level
        edges = Finding(level, f"Edges of photographs and mesh correlate by {e.edges:.2f}", "" if level == GREEN else remedy)
    camera = "" if e.escape_camera is None else f", and {percent(e.escape_camera, 1)} of those from the cameras"
    alone = None
    if e.confirmed is not None:  # nothing but the photographs judges this mesh, and they made it
        alone = Finding(
            AMBER,
            f"Cameras and mesh were found from the photographs alone: {percent(e.confirmed)} of their pixels have a depth that"
            f" several photographs confirm, and {e.built:.0f} m² of flat sides were built where none shows any",
            "Look at the picture of cameras and mesh (reconstruction/overview.png), and at room.html from above: what has no"
            " texture may have holes. Take more photographs of what is torn, or use the mesh of a scan (docs/guide/programs.md)",
        )  # fmt: skip
    made_up = Finding(
        AMBER, "Sides were made up around the scan (source.close), whose colour 0 photographs show",
        "Compare with a run without source.close, by held-out photographs (capture: {test_every: 8}): in the open scans that were"
        " tried, light from all directions did better (docs/guide/own-data.md)",
    ) if e.added else None  # fmt: skip
    escape = _finding(
        "escape", e.escape, f"{{}} of the rays from surfaces leave the mesh{camera}",
        "Photograph the walls, floor and ceiling that are missing, each from three places, and add them"
        if e.confirmed is not None else
        "Close the mesh: scan the walls, floor and ceiling that it lacks, because they reflect light and keep light out."
        " Where that cannot be, use albedo with care, and do not relight: sides made up by source.close help less than they cost"
        " in most rooms (docs/guide/own-data.md)", ".1%",
    )  # fmt: skip
    if alone and escape and escape.level == GREEN:  # the sides that were built let nothing out
        escape = None
    return _made(
        "geometry",
        "Does the mesh hold the room, and do the photographs lie on it?",
        [
            alone,
            made_up,
            _finding(
                "agreement", e.agreement, "Photographs of the same surface correlate by {} (median)",
                FROM_PHOTOGRAPHS if alone else
                "See whether each photograph stands with its own pose, then refine poses where they were made (COLMAP, the"
                " phone's app); source.registration mends a few pixels",
                ".2f",
            ),
            escape,
            _finding(
                "depth", e.depth, "Mesh and measured depth differ by {} (median)",
                "Check unit, axes and frame of the mesh (source.unit, source.axes)", ".1%",
            ),
            edges,
            _finding(
                "photographed", e.photographed, "The photographs show {} of the surfaces that reflect light onto others",
                "Photograph also what lies behind the camera: every wall, floor and ceiling", ".0%",
            ),
            _finding(
                "lost", lost if e.photographs else None,
                f"{e.lost} of {e.photographs + e.lost} photographs were left out ({{}})",
                "Take more photographs between them and the others; the notes say which were left out, and why"
                if alone else "Take them again, sharper and with poses; the notes say why each was left out", ".0%",
            ),
        ],
    )  # fmt: skip


def _light(e: Evidence) -> Light:
    outside = "light from outside the mesh" if e.environment else ""
    counted = f"{e.lamps} {'lamp' if e.lamps == 1 else 'lamps'} found"
    if e.unlikely:
        more = f" and {len(e.unlikely) - NAMED} more" if len(e.unlikely) > NAMED else ""
        counted += f"; less likely lamps than bright surface: {', '.join(e.unlikely[:NAMED])}{more}, with"
        counted += f" {percent(e.unlikely_power)} of the power"
    look = "Look at the list of lamps below, and photograph each lamp and window from several sides"
    if e.lamps > len(e.unlikely):
        level = min(LIMITS["unlikely_power"].level(e.unlikely_power), AMBER, key=ORDER.index)
        also = f"{';' if e.unlikely else ' and'} {outside}{' lights the room too' if e.unlikely else ''}" if outside else ""
        lamps = Finding(level, f"{counted}{also}", "" if level == GREEN else look)
    elif e.environment and e.escape is not None and LIMITS["escape"].level(e.escape) == GREEN:
        lamps = Finding(AMBER, counted, look) if e.lamps else Finding(GREEN, f"{counted}; {outside} lights the room")
    elif e.environment:
        lamps = Finding(
            LIMITS["escape"].level(e.escape) if e.escape is not None else AMBER,
            f"{counted}; what shines through the holes of the mesh ({outside}) stands for them",
            "Photograph every lamp and window, and close the mesh around them",
        )  # fmt: skip
    else:
        lamps = Finding(
            RED, f"{counted} and no light from outside: nothing{' else' if e.lamps else ''} lights the room",
            "Photograph a lamp or the window, and keep its surface in the mesh",
        )  # fmt: skip
    is_missed = e.missed_in and LIMITS["missed"].level(e.missed or 0.0) != GREEN
    where = f", most in {_joined(list(e.missed_in))}" if is_missed else ""
    return _made(
        "light",
        "Was found what lights the room?",
        [
            lamps,
            _finding(
                "misfit", e.misfit, "The light that was found explains how bright surfaces are to within {}",
                "Look for lamps that are missing in the list below; photograph each lamp and window from several sides", ".0%",
                shown=np.sqrt,
            ),
            _doubtful(e),
            _finding(
                "missed", e.missed, f"Of what is saturated in photographs, {{}} is re-rendered at less than half of that{where}",
                "Look at what is white there: a lamp that is not in the list below is missing in the mesh, or torn; photograph it"
                " from several sides", ".0%", AMBER,
            ),
            _finding(
                "light_spread", e.light_spread, "Against the truth, the error of the light varies by {} from object to object",
                "Photograph each lamp and window from several sides", ".0%", shown=np.expm1,
            ),
            *_warned(e, ("emission", "shading")),
        ],
    )  # fmt: skip


_WORST_VIEWS = (
    "Look at the worst views first: a wrong pose doubles edges, a missing lamp darkens what it lit,"
    " a mirror is wrong inside its frame"
)


def _materials(e: Evidence) -> Light:
    worst = "" if e.worst is None else f"; of all, {e.worst[0]} is worst with {e.worst[1]:.1f}"
    if e.held_out is not None:
        held = _counted(e.held_out_views, "held-out photograph")
        each = np.array(e.held_out_each)
        ends = f" ({each.min():.1f} to {each.max():.1f})" if len(each) > 1 else ""
        # Of a few photographs, one good one does not make up for most that are not.
        usual = min(e.held_out, float(np.median(each))) if len(each) else e.held_out
        scored = _finding(
            "rerendering", usual, f"Re-renderings reach {e.held_out:.1f} dB PSNR on {held}{ends}{worst}", _WORST_VIEWS
        )
        behind = None if e.others is None else e.others - e.held_out
        rival = _finding(
            "rival", behind, f"The mean of other photographs, which knows no light, predicts them with {e.others or 0.0:.1f} dB",
            "Light or materials are wrong where the error maps are bright: relit pictures will be, too. Look for lamps that are"
            " missing, and for a mesh that does not lie on the photographs", worst=AMBER,
        )  # fmt: skip
    else:
        rival = None
        scored = _finding(
            "rerendering", e.used, f"Re-renderings reach {{}} dB PSNR on the photographs{worst}",
            _WORST_VIEWS, ".1f",
        )  # fmt: skip
    judged = None
    if not e.has_truth and e.held_out is None:
        judged = Finding(
            AMBER, "0 photographs were held out and there is no ground truth: nothing independent judges the materials",
            "Hold some out: capture: {test_every: 8}",
        )  # fmt: skip
    elif not e.has_truth:
        judged = Finding(NOTED, f"No ground truth: {_counted(e.held_out_views, 'held-out photograph')} stand in for it")
    weak = None
    if e.prior == "retinex":
        weak = Finding(
            AMBER, "Prior retinex: 0 learned weights, so roughness and metallic are weak guesses",
            "Leave `prior` out of the scene file: the learned prior then predicts the materials (docs/guide/priors.md)",
        )  # fmt: skip
    return _made(
        "materials",
        "Are albedo, roughness and metallic those of the room?",
        [
            scored,
            rival,
            _finding(
                "albedo", e.albedo,
                f"Albedo reaches {{}} dB PSNR against the truth, an error of about {_off(e.albedo or 0.0):.2f}",
                "See which objects are off in the pictures 'albedo error'", ".1f",
            ),
            *_gloss(e),
            judged,
            weak,
            _finding(
                "uncertainty", e.uncertainty, "The fit claims a standard error of {} for the albedo (median)",
                "More photographs of the surface, at more exposures, from more directions", ".3f",
            ),
            _finding(
                "unfitted", e.unfitted, "{} of the pixels lie on objects that could not be fitted on their own",
                "More photographs, or larger objects (segmentation)", ".0%",
            ),
            _finding(
                "stability", e.stability, "Objects stay the same when photographs are left out: {} of 1",
                "Judge the pictures 'objects'; give object ids, or change segmentation.scale", ".2f", AMBER,
            ),
            *_warned(e, ("base", "affines")),
        ],
    )  # fmt: skip


def _gloss(e: Evidence) -> list[Finding | None]:
    """Judge roughness and metallic by the truth, or else say how well roughness is known."""
    remedy = "Compare 'roughness' of result and truth; what you know, set under `materials` in the scene file"
    if e.has_truth:
        return [
            _finding(
                "roughness", e.roughness, "Against the truth, roughness has a root mean square error of {}",
                remedy, ".2f", shown=_off,
            ),
            _finding(
                "metallic", e.metallic, "Against the truth, metallic has a root mean square error of {}",
                remedy.replace("roughness", "metallic"), ".2f", shown=_off,
            ),
        ]  # fmt: skip
    if e.roughness_interval is None:
        return [Finding(NOTED, "Not judged: photographs show the roughness of less than 50 % of the surface")]
    known = f"Not judged: roughness is known to within ±{e.roughness_interval:.2f}"
    rooms = f"in {held.rooms()} rendered rooms, 95 % intervals of roughness held for {held.words('roughness')} of the objects"
    return [Finding(NOTED, f"{known}; {rooms} that have one")]


def _off(psnr: float) -> float:
    """Return the root mean square error that a PSNR against a range of 1 stands for."""
    return float(10 ** (-psnr / 20))


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


FIXED = {"white_patch": "a white patch of known albedo", "lamp": "a lamp of known radiance"}
CONVENTION = {"prior": "the mean albedo of the prior's predictions", "mean_albedo": "a mean albedo that was set"}


def _scale(e: Evidence) -> Light:
    patch = (
        "Photograph a white patch of known albedo, or take a wall whose paint you know, and name it in the scene file, such as"
        " affines: {scale: {white_patch: {object: white wall 1, albedo: 0.8}}}; or name a lamp of known radiance"
    )
    fixed = None
    if e.level in FIXED:
        fixed = Finding(
            GREEN, f"The level is fixed by {FIXED[e.level]}" + (f" (within {percent(e.level_error)})" if e.level_error else "")
        )
    elif e.level in CONVENTION:
        error = "" if e.level_error is None else f"; its error of {percent(e.level_error)} leaves out the error of the convention"
        fixed = Finding(AMBER, f"The level is a convention: {CONVENTION[e.level]}{error}", patch)
    else:
        fixed = _finding(
            "level_error",
            e.level_error,
            "The level of light and albedo is known from indirect light, with a typical error of {}",
            patch,
            ".0%",
        )
        fixed = fixed or Finding(AMBER, "The level of light and albedo is not known: 0 measurements of it", patch)
    moved = max(e.light_scale, 1 / e.light_scale) if e.light_scale > 0 else float("inf")
    raised = None  # what fixes the level does so whatever was raised before
    if e.level not in FIXED:
        raised = Finding(GREEN, "No light had to be added to keep albedos below 1") if e.raised <= 1 else _finding(
            "raised", e.raised, "All light was raised by a factor of {}, so that albedos stay below 1",
            "Light is missing: photograph every lamp and window and close the mesh, or fix the level by a white patch", ".2f",
        )  # fmt: skip
    return _made(
        "scale",
        "How bright are albedo and light together?",
        [
            fixed,
            raised,
            _finding(
                "light_scale", moved, "The light that was found and the albedo that was predicted disagree by a factor of {}"
                f" (the albedos were divided by {e.light_scale:.3g})", patch, ".2f",
            ) if e.level not in (*FIXED, "mean_albedo") else None,
            _finding(
                "discrepancy", e.discrepancy,
                "Photographs and predictions disagree on how bright objects are by {} times the variance that they claim",
                "Look at objects whose uncertainty is large; lamps may be missing near them", ".2f",
            ),
        ],
    )  # fmt: skip


def means_table() -> str:
    """Return what green means, and how often it did, as a Markdown table, which docs/guide/results.md holds."""
    rows = ["| light | green means that | true of | by thresholds of other rooms |", "|---|---|---|---|"]
    for name, meaning in MEANS.items():
        counts = calibration.measured()["lights"][name]
        own, others = (f"{found['right']} of {found['of']}" for found in (counts[GREEN], counts["left_out"]))
        rows.append(f"| {name} | {meaning.words} | {own} | {others} |")
    return "\n".join(rows) + "\n"


def limits_table() -> str:
    """Return the thresholds as a Markdown table, which docs/guide/results.md holds."""
    rows = ["| evidence | light | green up to | amber up to | why |", "|---|---|---|---|---|"]
    for name, limit in LIMITS.items():
        ends = [f"at least {v:g}" if limit.red < limit.amber else f"{v:.3g}" for v in (limit.amber, limit.red)]
        rows.append(f"| `{name}` | {LIGHT_OF[name]} | {ends[0]} | {ends[1]} | {limit.why} |")
    return "\n".join(rows) + "\n"
