"""Settings of relightings: pictures of the recovered scene under other light, edited, and from other positions."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, AliasChoices, BeforeValidator, Field, field_validator, model_validator

from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from workflow.intake import limits
from workflow.intake.pictures import exr_size
from workflow.settings.by_hand import TEXT_KEYS
from workflow.settings.mesh_files import MESHES, files_of_mesh
from workflow.settings.names import did_you_mean_path
from workflow.settings.section import Section

Light = Annotated[float, Field(ge=0, le=limits.RADIANCE)]
"""Radiance, or a factor on it."""
Reflectance = Annotated[float, Field(ge=0, le=1)]


def _of_hex(value: Any) -> Any:
    """Return linear R, G, B of a colour as browsers and paint charts write it, `"#c0d8e0"` in sRGB; other values as they are."""
    if not isinstance(value, str):
        return value
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", value):
        raise ValueError("Needed: linear R, G, B such as [0.5, 0.2, 0.1], or sRGB in hexadecimal digits, in quotes: '#c0d8e0'")
    return tuple(linear_from_srgb(np.array([int(value[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0).tolist())


Colour = Annotated[tuple[Light, Light, Light], BeforeValidator(_of_hex, json_schema_input_type=tuple[Light, Light, Light] | str)]
Paint = Annotated[
    tuple[Reflectance, Reflectance, Reflectance],
    BeforeValidator(_of_hex, json_schema_input_type=tuple[Reflectance, Reflectance, Reflectance] | str),
]
SWITCH = {"on": 1.0, "off": 0.0, True: 1.0, False: 0.0}
"""What `on` and `off`, which YAML reads as booleans, stand for."""


def _switched(value: Any) -> Any:
    return SWITCH[value] if isinstance(value, bool) or value in ("on", "off") else value


class RelightLamp(Section):
    """What becomes of one lamp. A number, `on` or `off` instead of this is its `factor`."""

    factor: Annotated[Light, BeforeValidator(_switched)] = 1.0
    """Factor on the radiance that was found; `on` is 1, `off` is 0."""
    colour: Colour | None = Field(None, validation_alias=AliasChoices("colour", "color"))
    """Linear R, G, B of its light, or `"#ffd0a0"` (sRGB); the luminance stays. By default as found."""
    move: tuple[float, float, float] | None = None
    """By how much it is moved, in metres along the world axes."""

    @model_validator(mode="before")
    @classmethod
    def _factor_alone(cls, value: Any) -> Any:
        if isinstance(value, str | list | tuple) and value not in ("on", "off"):
            raise ValueError("Needed: a factor, `on`, `off`, or keys; a colour is linear R, G, B: `{colour: [1, 0.5, 0.2]}`")
        return value if isinstance(value, dict) else {"factor": value}

    @field_validator("colour")
    @classmethod
    def _some_light(cls, value: Colour | None) -> Colour | None:
        if value is not None and not any(value):
            raise ValueError("Needed: three numbers of at least 0, one of them above; a lamp without light is `off`")
        return value


class MaterialEdit(Section):
    """Other paint on one object. What is not named stays as it was recovered."""

    albedo: Paint | None = None
    """Linear R, G, B of flat paint, or `"#c0d8e0"` (sRGB); it replaces the texture."""
    tint: Colour | None = None
    """Factors on R, G, B of the albedo; the texture stays."""
    roughness: float | None = Field(None, ge=0.02, le=1)
    """Perceptual roughness, the same all over."""
    metallic: Reflectance | None = None
    """Metallic, the same all over."""

    @model_validator(mode="after")
    def _one_paint(self) -> MaterialEdit:
        if self.albedo is not None and self.tint is not None:
            raise ValueError("`albedo` is flat paint and `tint` keeps the texture; remove one of the two")
        if not self.model_fields_set:
            raise ValueError("nothing is edited; write `albedo` or `tint`, `roughness`, `metallic`")
        return self


class InsertMaterial(Section):
    """One material for all of an inserted object, in the place of those of its file."""

    albedo: Paint = (0.5, 0.5, 0.5)
    """Linear R, G, B, or `"#c0d8e0"` (sRGB)."""
    roughness: float = Field(0.5, ge=0.02, le=1)
    """Perceptual roughness."""
    metallic: Reflectance = 0.0
    """0 = dielectric, 1 = metal."""


class RelightInsert(Section):
    """An object that is put into the room: it casts shadows, is lit, and is seen in reflections."""

    file: Path
    """Mesh: `.glb`, `.gltf`, `.ply` or `.obj`. The y axis of glTF files is turned to the up axis of the room."""
    name: str | None = None
    """Name in captions and of its light; by default the name of the file."""
    position: tuple[float, float, float]
    """Where it stands: the middle of its lowest side, in metres, world axes."""
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Degrees by which it is turned about the world axes x, y and z, in this order."""
    scale: float = Field(1.0, gt=0)
    """Factor on its size."""
    material: InsertMaterial | None = None
    """One material for all of it; by default those of the file (metallic-roughness, with textures or vertex colours)."""
    radiance: Colour | None = None
    """R, G, B that it emits, in the units of emitters.parquet; by default what the materials of its file emit, and nothing if
    `material` replaces them."""


class RelightSphere(Section):
    """A black sphere that emits light, put into the room."""

    center: tuple[float, float, float] = Field(validation_alias=AliasChoices("center", "centre"))
    """Position in metres, world axes."""
    radius: float = Field(0.2, gt=0)
    """Radius in metres."""
    radiance: Colour = (53.0, 50.0, 45.0)
    """R, G, B in the units of emitters.parquet."""
    path_to: tuple[float, float, float] | None = None
    """Position in the last frame; the sphere moves there in a straight line."""


class RelightPose(Section):
    """A camera by its position and what it looks at."""

    position: tuple[float, float, float]
    """Metres, world axes."""
    look_at: tuple[float, float, float]
    """The point in the middle of the picture, in metres."""

    @model_validator(mode="after")
    def _looks_somewhere(self) -> RelightPose:
        if self.look_at == self.position:
            raise ValueError(f"`look_at` and `position` are the same point, {list(self.position)}; look at another one")
        return self


class RelightCamera(Section):
    """A still camera, or a flight between views or poses."""

    views: list[str] = Field(default_factory=list)
    """Names of the views to fly along, or of one view for a still camera; by default the view that shows most surface."""
    poses: list[RelightPose] = Field(default_factory=list)
    """Positions to fly along, in the place of views."""
    frames: int = Field(1, ge=1, le=10000)
    """Number of pictures."""
    fov: float | None = Field(None, gt=1, lt=170)
    """Horizontal field of view in degrees; by default as photographed."""
    width: int | None = Field(None, ge=8, le=8192)
    """Width in pixels; by default the width of the first view."""
    height: int | None = Field(None, ge=8, le=8192)
    """Height in pixels; by default the height of the first view."""
    through_surface: bool = False
    """Let the path lead through walls and furniture; otherwise it is an error that names what is in the way."""

    @model_validator(mode="after")
    def _views_or_poses(self) -> RelightCamera:
        if self.views and self.poses:
            raise ValueError("`views` and `poses` are both given; remove one of the two")
        return self


class RelightVideo(Section):
    """A flight as an MP4 file."""

    fps: int = Field(24, ge=1, le=240)
    """Frames per second."""
    codec: Literal["av1", "h264"] = "av1"
    """`av1` is smaller, `h264` is played everywhere."""


class Relighting(Section):
    """One relighting of the recovered scene: `snakemake --cores 2 relight/<scene>` (docs/guide/relighting.md)."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=100)
    """Name of the folder of its pictures: letters, digits, `_` and `-`."""
    emitters: Annotated[Light, BeforeValidator(_switched)] = 1.0
    """Recovered emitters that `lamps` does not name: `on`, `off`, or a factor on their radiance."""
    lamps: Annotated[dict[str, RelightLamp], TEXT_KEYS] = Field(default_factory=dict)
    """Single lamps: name as in the report (`window 1`) or of an object that shines, or id of emitters.parquet -> factor, `on`,
    `off`, or its keys."""
    each: Literal["alone", "off"] | None = None
    """Instead of `emitters` and `lamps`: one picture for each of the twelve strongest lamps, with its light `alone`, or with all
    but it (`off`). Names end with the lamp's."""
    environment: Literal["keep", "off"] | Light | Colour | Path = "keep"
    """Light from outside: `keep`, `off`, a factor on what was found, a uniform radiance `[r, g, b]`, or a latitude-longitude EXR
    (top row = up)."""
    environment_turn: float = 0.0
    """Degrees by which the EXR is turned about the up axis."""
    sphere: RelightSphere | None = None
    """A lamp to add."""
    insert: list[RelightInsert] = Field(default_factory=list)
    """Objects to put into the room."""
    materials: Annotated[dict[str, MaterialEdit], TEXT_KEYS] = Field(default_factory=dict)
    """Other paint: name or id of an object -> its `albedo` or `tint`, `roughness`, `metallic`."""
    camera: RelightCamera = RelightCamera()
    """From where the pictures are taken."""
    exposure: Literal["photograph", "auto"] | Annotated[float, Field(gt=0)] = "photograph"
    """Factor on radiance before the camera response. `photograph`: the factor of the first view, so that pictures compare
    with it; `auto`: by the brightness of the first frame; or a number."""
    response: Literal["camera", "srgb"] = "camera"
    """Curve that turns radiance into pictures: the response of the photographs, or sRGB. HDR photographs have none."""
    video: RelightVideo | None = RelightVideo()
    """The frames of a flight as an MP4 file as well; `off`: none."""
    method: Literal["auto", "recombine", "path"] = "auto"
    """`recombine`: sum pictures of single lamps, so that another factor or colour is ready at once; `path`: trace every frame;
    `auto`: sum where nothing but factors and colours of lamps differs from the room as it was found."""
    samples: int = Field(64, ge=1)
    """Paths per pixel."""
    max_bounces: int = Field(8, ge=1, le=64)
    """Longest path, in bounces."""
    denoise: bool = True
    """Denoise the pictures."""

    @field_validator("each", mode="before")
    @classmethod
    def _each_off(cls, value: Any) -> Any:  # YAML reads a bare `off` as false
        return "off" if value is False else value

    @field_validator("environment", mode="before")
    @classmethod
    def _no_environment(cls, value: Any) -> Any:  # YAML reads a bare `off` as false
        return {False: "off", True: "keep"}[value] if isinstance(value, bool) else value

    @field_validator("video", mode="before")
    @classmethod
    def _no_video(cls, value: Any) -> Any:
        if value in ("on", "off") or isinstance(value, bool):
            return None if value in ("off", False) else {}
        return value

    @model_validator(mode="after")
    def _moves(self) -> Relighting:
        """A flight needs something that moves, and a film more than one picture."""
        camera = self.camera
        frames, stands = camera.frames, len(camera.views) + len(camera.poses) < 2
        if frames > 1 and stands and (self.sphere is None or self.sphere.path_to is None):
            raise ValueError(
                f"`camera` has {frames} frames and stands still, so all of them are one picture; name several `views` or `poses`"
                " to fly along, or leave out `frames`"
            )
        if frames == 1 and len(camera.views) + len(camera.poses) > 1:
            raise ValueError("`camera` has several `views` or `poses` and takes one picture; give the number of its `frames`")
        if frames == 1 and self.video is not None and "video" in self.model_fields_set:
            raise ValueError("`video` of a camera that takes one picture; give the number of its `frames`, or leave out `video`")
        return self

    @model_validator(mode="after")
    def _each_alone(self) -> Relighting:
        if self.each and {"emitters", "lamps"} & self.model_fields_set:
            raise ValueError("`each` says what is on; remove `emitters` and `lamps`")
        return self

    @model_validator(mode="after")
    def _can_be_summed(self) -> Relighting:
        if self.method == "recombine" and self.sphere is not None and self.sphere.path_to is not None:
            raise ValueError(
                "`method: recombine` with a sphere that moves: its light differs in every frame; write `method: path`"
            )
        return self


def _named_apart(entries: list[Relighting]) -> list[Relighting]:
    names = [entry.name for entry in entries]
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise ValueError(f"{names.count(twice[0])} relightings are called {twice[0]!r}; each needs its own name")
    return entries


Relightings = Annotated[list[Relighting], AfterValidator(_named_apart)]


class RelightPlan(Section):
    """A file `config/relight/<plan>.yaml`: relightings for any scene, `snakemake --cores 2 relight/<scene>/<plan>`."""

    title: str = ""
    """What the plan shows, for people: the title of the contact sheet."""
    relight: Relightings = Field(min_length=1)
    """The relightings, as in a scene file."""


def require_relighting(document: dict[str, Any], scene: str) -> list[dict[str, Any]]:
    """Return the relightings of a dumped settings tree.

    Raises:
        InputError: there are none.
    """
    wanted: list[dict[str, Any]] = document["relight"]
    if not wanted:
        raise InputError(
            f"config/scenes/{scene}.yaml: no relighting is configured. Ask for a plan, as in"
            f" `snakemake --cores 2 relight/{scene}/example`, or add one, for example"
            " `relight: [{name: evening, emitters: off, sphere: {center: [2, 2, 1.5]}}]` (docs/guide/relighting.md)."
        )
    return wanted


def files_of(entry: dict[str, Any]) -> list[Path]:
    """Return the environment and the meshes that a dumped relighting names."""
    found = [entry["environment"]] if isinstance(entry["environment"], str) else []
    return [Path(value) for value in found if value not in ("keep", "off")] + [Path(one["file"]) for one in entry["insert"]]


def name_of(insert: dict[str, Any]) -> str:
    """Return the name of a dumped inserted object: its own, or the name of its file."""
    return insert["name"] or Path(insert["file"]).stem


def relight_files(entries: list[dict[str, Any]]) -> list[Path]:
    """Return the files that dumped relightings name, and those that these name in turn.

    Raises:
        InputError: one is missing, of a kind that is not read, or cut short.
    """
    for entry in entries:
        for path in files_of(entry):
            inserted = any(Path(one["file"]) == path for one in entry["insert"])
            kinds = MESHES if inserted else (".exr",)
            if path.suffix.lower() in kinds and path.is_file():
                if not inserted:
                    _check_environment(path, entry["name"])
                continue
            if inserted:
                why = "not found" if path.suffix.lower() in kinds else f"found {path.suffix or 'no suffix'}"
                raise InputError(
                    f"`relight.insert.file` of {entry['name']}: {str(path)!r}: {why}; allowed: a mesh that ends in"
                    f" {', '.join(MESHES)}.{did_you_mean_path(path) if not path.exists() else ''}"
                )
            raise InputError(
                f"`relight.environment` of {entry['name']}: found {str(path)!r}, which is no EXR file here; allowed: keep, off, a"
                f" factor, [r, g, b] or the path of a latitude-longitude EXR.{did_you_mean_path(path)}"
            )
    found: dict[Path, None] = {}
    for entry in entries:
        try:
            found |= dict.fromkeys(all_files_of(entry))
        except InputError as error:
            raise InputError(f"`relight.insert.file` of {entry['name']}: {error}") from None
    return list(found)


def _check_environment(path: Path, name: str) -> None:
    try:
        exr_size(path)
    except InputError as error:
        raise InputError(f"`relight.environment` of {name}: {error}") from None


def all_files_of(entry: dict[str, Any]) -> list[Path]:
    """Return the files that a dumped relighting depends on: those that it names, and those that its meshes name.

    Raises:
        InputError: as `files_of_mesh`.
    """
    named = files_of(entry)
    return [file for path in named for file in (files_of_mesh(path) if path.suffix.lower() in MESHES else [path])]


_NOT_TRACED = ("name", "emitters", "each", "exposure", "response", "video", "method")
"""Keys of a relighting on which the light of single lamps does not depend."""


def recombines(entry: dict[str, Any]) -> bool:
    """Return whether the pictures of a dumped relighting are sums of the pictures of single lamps."""
    if entry["method"] != "auto":
        return bool(entry["method"] == "recombine")
    found = isinstance(entry["environment"], float | int) or entry["environment"] in ("keep", "off")
    moved = any(lamp["move"] for lamp in entry["lamps"].values())
    return found and not (moved or entry["sphere"] or entry["insert"] or entry["materials"])


def lamp_basis(entry: dict[str, Any]) -> dict[str, Any]:
    """Return what the pictures of the single lamps of a dumped relighting depend on: everything but factors, colours and how
    they are shown."""
    basis = {key: value for key, value in entry.items() if key not in _NOT_TRACED}
    basis["lamps"] = {key: lamp["move"] for key, lamp in sorted(entry["lamps"].items()) if lamp["move"]}
    if isinstance(entry["environment"], float | int) or entry["environment"] in ("keep", "off"):
        basis["environment"], basis["environment_turn"] = "keep", 0.0
    return basis


def key_of(basis: dict[str, Any]) -> str:
    """Return twelve hexadecimal characters that name what `lamp_basis` returns."""
    return hashlib.sha256(json.dumps(basis, sort_keys=True).encode()).hexdigest()[:12]


def lamp_bases(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return every `lamp_basis` that dumped relightings are summed from, once each, in an order that is theirs."""
    found = {key_of(basis): basis for basis in map(lamp_basis, filter(recombines, entries))}
    return [found[key] for key in sorted(found)]
