"""All settings of one scene, as a validated model and as a tree of plain values."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from workflow import plugins
from workflow.settings import affines, base, light, outputs, source
from workflow.settings.by_hand import ByObject, Components, Names, by_former_names
from workflow.settings.light import NOISE_OF_OBJECTS, NOISE_OF_TEXTURES
from workflow.settings.limits import Limits
from workflow.settings.prior import LearnedPrior, Member, Prior
from workflow.settings.relight import Relightings, lamp_bases, recombines
from workflow.settings.section import Section
from workflow.settings.segmentation import GeometrySegmentation, Segmentation
from workflow.settings.source import Source

_SECTIONS: dict[str, type[Section]] = {
    "capture": source.Capture,
    "base": base.Base,
    "emission": light.Emission,
    "shading": light.Shading,
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
Capture, Base, Emission, Shading, Affines = (EXTENDED[name] for name in ("capture", "base", "emission", "shading", "affines"))
Render, Metrics, Export, Report, Room = (EXTENDED[name] for name in ("render", "metrics", "export", "report", "room"))


class SceneSettings(Section):
    """All settings of one scene."""

    source: Source
    """Where photographs, cameras and mesh come from."""
    capture: Capture = Capture()
    limits: Limits = Limits()
    """What a quality may ask for at most."""
    prior: Prior = plugins.extended("prior.learned", LearnedPrior)()
    """Where the K material predictions come from."""
    segmentation: Segmentation = plugins.extended("segmentation.geometry", GeometrySegmentation)()
    """Which surface belongs to which object."""
    base: Base = Base()
    emission: Emission = Emission()
    shading: Shading = Shading()
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
    names: Names = Field(default_factory=dict)
    """What objects are called: name or id of an object -> its new name, in tables, exports, `room.html`, the report, `materials`
    and relightings (docs/guide/segmentation.md#names)."""
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
    def _names_of_the_segmentation(self) -> SceneSettings:
        """Keep objects by the names that the segmentation gives them, so that another name makes no fit run again."""
        if not self.names:
            return self
        object.__setattr__(self, "materials", by_former_names(self.materials, self.names))
        entries = [entry.model_copy(update={"materials": by_former_names(entry.materials, self.names)}) for entry in self.relight]
        object.__setattr__(self, "relight", entries)
        patch = getattr(self.affines.scale, "white_patch", None)
        if patch is not None and patch.object is not None:
            known, *others = by_former_names({patch.object: None}, self.names)
            if others:
                raise ValueError(f"affines.scale.white_patch.object: {patch.object!r} is the name of several objects; give an id")
            scale = self.affines.scale.model_copy(update={"white_patch": patch.model_copy(update={"object": known})})
            object.__setattr__(self, "affines", self.affines.model_copy(update={"scale": scale}))
        return self

    @model_validator(mode="after")
    def _automatic_noise(self) -> SceneSettings:
        """Replace `shading: {noise: auto}` by the number."""
        if self.shading.noise == "auto":
            noise = NOISE_OF_TEXTURES if self.affines.of_cells(self.prior.kind) else NOISE_OF_OBJECTS
            object.__setattr__(self, "shading", self.shading.model_copy(update={"noise": noise}))
        return self

    def implied(self) -> dict[str, dict[str, Any]]:
        """Return what stages read and no setting of its own decides: section -> key -> plain value."""
        every = bool(self.affines.of_cells(self.prior.kind)) or self.affines.pixels == "all"
        chosen = self.components
        return {
            "emission": {"environment": chosen.environment},
            # What is traced follows from what is read.
            "shading": {
                "pixels": "all" if every else self.affines.pixels,
                "indirect": {"auto": "auto", "on": "cache", "off": "path"}[chosen.radiance_cache],
            },
            "second_look": {"enabled": True},
            "affines": {"textured": self.affines.textured(self.prior.kind)},
            "render": {"denoise": chosen.denoiser != "off"},
            "report": {"views": outputs.VIEWS_OF_REPORT},
            "room": {"denoise": chosen.denoiser != "off"},
        }


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
    """Return the settings as plain JSON values, with what they imply, and what stage `lamp_images` traces for the relightings
    among them, with the names of those that are summed from it."""
    document = settings.model_dump(mode="json")
    for section, values in settings.implied().items():
        document[section] = {**document.get(section, {}), **values}
    summed = [entry["name"] for entry in document["relight"] if recombines(entry)]
    return {**document, "lamp_images": lamp_bases(document["relight"]), "recombined": summed}


def select(document: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """Return the parts of a dumped settings tree that dotted `keys` name; None for those that its kind of section has not."""
    out: dict[str, Any] = {}
    for key in keys:
        value: Any = document
        for part in key.split("."):
            value = value.get(part) if part not in value and "kind" in value else value[part]
        out[key] = value
    return out


@cache
def _added(section: type[Section]) -> dict[str, Any]:
    """Return the fields that plug-ins add to a section of the product, with their defaults."""
    own = next(base for base in section.__mro__ if base.__module__.startswith("workflow."))
    if "kind" in section.model_fields and "kind" not in own.model_fields:  # a kind of a plug-in
        return {}
    return {name: field.default for name, field in section.model_fields.items() if name not in own.model_fields}


def _without_added(section: type[Section] | None, value: Any) -> Any:
    """Return a dumped section, and all that lies in it, without the fields of plug-ins that are at their defaults."""
    added, known = (_added(section), section.model_fields) if section else ({}, {})
    out = {name: entry for name, entry in value.items() if name not in added or entry != added[name]}
    for name in known.keys() & out.keys():
        inner = section_in(known[name].annotation)
        if isinstance(out[name], dict) and isinstance(inner, type) and issubclass(inner, Section):
            out[name] = _without_added(inner, out[name])
    return out | ({"of": [_without_added(POOLED[one["kind"]], one) for one in value["of"]]} if "of" in value else {})


def recorded(document: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """Return what `select` returns without the fields of plug-ins that are at their defaults, so that fingerprints and manifests
    do not depend on plug-ins that take no part."""
    out: dict[str, Any] = {}
    for key, value in select(document, keys).items():
        name, _, field = key.partition(".")
        section = UNIONS[name][document[name]["kind"]] if name in UNIONS else EXTENDED.get(name)
        if not field:
            out[key] = _without_added(section, value) if isinstance(value, dict) else value
        elif section is None or field not in _added(section) or value != _added(section)[field]:
            out[key] = value
    return out
