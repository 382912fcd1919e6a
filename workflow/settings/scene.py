"""All settings of one scene, as a validated model and as a tree of plain values."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from workflow import plugins
from workflow.settings import affines, base, light, outputs
from workflow.settings.by_hand import ByObject, Components
from workflow.settings.light import NOISE_OF_OBJECTS, NOISE_OF_TEXTURES
from workflow.settings.limits import Limits
from workflow.settings.prior import LearnedPrior, Member, Prior, predictions
from workflow.settings.relight import Relightings, lamp_bases, recombines
from workflow.settings.section import Section
from workflow.settings.segmentation import GeometrySegmentation, Segmentation
from workflow.settings.source import Capture, Source

_SECTIONS: dict[str, type[Section]] = {
    "base": base.Base,
    "emission": light.Emission,
    "shading": light.Shading,
    "second_look": base.SecondLook,
    "affines": affines.Affines,
    "render": outputs.Render,
    "metrics": outputs.Metrics,
    "export": outputs.Export,
    "report": outputs.Report,
    "room": outputs.Room,
}
"""Sections to which plug-ins may add fields."""
EXTENDED = {name: plugins.extended(name, own) for name, own in _SECTIONS.items()}
"""The same with those fields."""
Base, Emission, Shading, SecondLook, Affines = (
    EXTENDED[name] for name in ("base", "emission", "shading", "second_look", "affines")
)
Render, Metrics, Export, Report, Room = (EXTENDED[name] for name in ("render", "metrics", "export", "report", "room"))


class SceneSettings(Section):
    """All settings of one scene."""

    source: Source
    """Where photographs, cameras and mesh come from."""
    capture: Capture = Capture()
    limits: Limits = Limits()
    """What a quality may ask for at most."""
    prior: Prior = LearnedPrior()
    """Where the K material predictions come from."""
    segmentation: Segmentation = GeometrySegmentation()
    """Which surface belongs to which object."""
    base: Base = Base()
    emission: Emission = Emission()
    shading: Shading = Shading()
    second_look: SecondLook = SecondLook()
    """Whether the photographs are looked at again once their light is known."""
    affines: Affines = Affines()
    render: Render = Render()
    metrics: Metrics = Metrics()
    export: Export = Export()
    report: Report = Report()
    room: Room = Room()
    components: Components = Components()
    """Parts of the model that are forced in or out, in the words of plan.yaml."""
    materials: ByObject = Field(default_factory=dict)
    """Corrections by hand: name or id of an object -> its `roughness`, `metallic` or both, which are then not fitted
    (docs/guide/relighting.md#corrections-by-hand)."""
    relight_title: str = ""
    """Title of the contact sheet of `relight`; plans of relightings have `title`."""
    relight: Relightings = Field(default_factory=list)
    """Pictures under other light, edited, and from other positions, made on demand; where there are none,
    `config/relight/<scene>.yaml` or `config/relight/example.yaml` stands for them."""
    seed: int = Field(0, ge=0, lt=2**31)
    """Seed of all random numbers."""
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Where rays are traced. `auto`: on a CUDA device where the machine has one, else on the CPU; `cuda` is an error where there
    is none. Recorded in the manifests, and no reason to run a job again: numbers differ by rounding and noise alone. What a GPU
    brings is in docs/guide/quality.md#a-gpu."""

    @field_validator("prior", mode="before")
    @classmethod
    def _learned_unless_named(cls, value: Any) -> Any:
        return {"kind": "learned", **value} if isinstance(value, dict) else value

    @field_validator("segmentation", mode="before")
    @classmethod
    def _geometry_unless_named(cls, value: Any) -> Any:
        return {"kind": "geometry", **value} if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _known_predictions(self) -> SceneSettings:
        made, used = predictions(self.prior.model_dump()), self.base.predictions
        if used is not None and used > made:
            raise ValueError(
                f"`base: predictions` is {used}, but `prior` makes {made} (`samples`); lower the one or raise the other"
            )
        return self

    @model_validator(mode="after")
    def _overridden(self) -> SceneSettings:
        """Put components that are forced, and have a setting of their own, in the place of that setting."""
        choice = self.components
        forced = {name: value for name, value in choice.model_dump().items() if value != "auto"}
        own = {
            "environment": ("emission", "environment", {"on": "on", "off": "off"}),
            "radiance_cache": ("shading", "indirect", {"on": "cache", "off": "path"}),
            "denoiser": ("render", "denoise", {"on": True, "off": False}),
        }
        for component, (section, key, values) in own.items():
            if component in forced:
                part, value = getattr(self, section), values[forced[component]]
                if key in part.model_fields_set and getattr(part, key) not in (value, "auto"):
                    raise ValueError(
                        f"`components: {component}: {forced[component]}` contradicts"
                        f" `{section}: {key}: {getattr(part, key)}`; remove one of the two"
                    )
                object.__setattr__(self, section, part.model_copy(update={key: value}))
        return self

    @model_validator(mode="after")
    def _automatic_shading(self) -> SceneSettings:
        """Replace `shading: {pixels: auto}` by the number or `all`, and `noise: auto` by the number: what is traced follows from
        what is read."""
        cells = self.affines.of_cells(self.prior.kind)
        every = bool(cells) or self.affines.pixels == "all"
        asked, needed = self.shading.pixels, "all" if every else self.affines.pixels
        if asked == "auto":
            object.__setattr__(self, "shading", self.shading.model_copy(update={"pixels": needed}))
        elif asked != "all" and (every or asked < self.affines.pixels):
            why = (
                f"{cells or '`affines: pixels: all`'} reads every pixel"
                if every
                else f"the fit reads {needed} (`affines: pixels`)"
            )
            raise ValueError(f"`shading: pixels` is {asked}, but {why}; write `auto`, or at least `{needed}`")
        if self.shading.noise == "auto":
            noise = NOISE_OF_TEXTURES if cells else NOISE_OF_OBJECTS
            object.__setattr__(self, "shading", self.shading.model_copy(update={"noise": noise}))
        return self


SceneSettings = plugins.extended("scene", SceneSettings)


def _members(union: Any) -> dict[str, type[Section]]:
    """Return the sections of a union by their `kind`."""
    sections = get_args(get_args(union)[0])
    return {get_args(section.model_fields["kind"].annotation)[0]: section for section in sections}


UNIONS = {"source": _members(Source), "prior": _members(Prior), "segmentation": _members(Segmentation)}
"""Sections whose `kind` decides which other keys they have: section -> kind -> model."""
POOLED = _members(Member)
"""The same of the members of `prior: {kind: pooled}`."""


def section_in(annotation: Any) -> Any:
    """Return the section in `list[Section]` or `Section | None`; other types unchanged."""
    inner = [t for t in getattr(annotation, "__args__", ()) if isinstance(t, type) and issubclass(t, Section)]
    return inner[0] if inner else annotation


def dump(settings: SceneSettings) -> dict[str, Any]:
    """Return the settings as plain JSON values, and what stage `lamp_images` traces for the relightings among them, with the
    names of those that are summed from it."""
    document = settings.model_dump(mode="json")
    summed = [entry["name"] for entry in document["relight"] if recombines(entry)]
    return {**document, "lamp_images": lamp_bases(document["relight"]), "recombined": summed}


def select(document: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """Return the parts of a dumped settings tree that dotted `keys` name."""
    out: dict[str, Any] = {}
    for key in keys:
        value: Any = document
        for part in key.split("."):
            value = value[part]
        out[key] = value
    return out


@cache
def _added(section: str) -> dict[str, Any]:
    """Return the fields that plug-ins add to a section, with their defaults as they are dumped."""
    own = _SECTIONS.get(section, Section).model_fields
    dumped = EXTENDED[section]().model_dump(mode="json") if section in EXTENDED else {}
    return {name: value for name, value in dumped.items() if name not in own}


def recorded(document: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """Return what `select` returns without the fields of plug-ins that are at their defaults, so that fingerprints and manifests
    do not depend on plug-ins that take no part."""
    out: dict[str, Any] = {}
    for key, value in select(document, keys).items():
        section, _, field = key.partition(".")
        added = _added(section)
        if not field and added:
            out[key] = {name: entry for name, entry in value.items() if name not in added or entry != added[name]}
        elif field not in added or value != added[field]:
            out[key] = value
    return out
