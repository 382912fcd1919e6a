"""The settings of a scene: one typed model that validates, documents and generates (schema, defaults, reference page).

Order of precedence: defaults here < `config/quality/<quality>.yaml` < `config/scenes/<scene>.yaml`; for a variant of a study
(workflow/studies.py) also < `config/studies/scenes.yaml` < `config/studies/<study>.yaml`; for a line of `config/batch.tsv`
(workflow/batch.py) its base stands in the place of the scene's file, under the line's columns.
Nothing else is consulted: no environment variables, no hidden files.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from iif_core.errors import InputError

QUALITIES = ("draft", "standard", "paper")


class Section(BaseModel):
    """A part of the settings; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


# ---------------------------------------------------------------------------------------------------------------- sources


class BuiltinSource(Section):
    """The room that the project makes itself; needs nothing from outside."""

    kind: Literal["builtin"]
    scene: Literal["kitchen", "tiny"] = "kitchen"
    """`kitchen`: a furnished room; `tiny`: a few boxes for tests."""


class MitsubaSource(Section):
    """Any Mitsuba 3 scene XML; the workflow renders photographs, G-buffers and ground truth itself."""

    kind: Literal["mitsuba"]
    path: Path
    """The scene's XML file."""
    max_bounces: int = Field(16, ge=1, le=64)
    """Path length of the rendered photographs."""
    drop_transparent: bool = True
    """Leave dielectric surfaces out of the mesh (a scan has none either); recorded, pixels behind them are not scored."""


class PhotographedSource(Section):
    alignment: Literal["check", "warn", "off"] = "check"
    """Reproject the mesh against depth, sparse points or image edges; `check` refuses a mismatch with the measured
    disagreement."""
    alignment_tolerance: float = Field(0.05, gt=0)
    """Largest accepted median relative depth disagreement, where depth images or sparse points exist."""
    registration: Literal["auto", "off"] = "auto"
    """`auto`: poses, focal length and principal point corrected by what mesh and other photographs show, if held-out surface
    agrees; blurred and badly posed photographs left out. `off`: as given."""


class FolderSource(PhotographedSource):
    """Your own scene: cameras (`transforms.json` or a COLMAP model), images and a mesh in one folder (docs/own-data.md)."""

    kind: Literal["folder"]
    path: Path
    """The folder."""
    cameras: str | None = None
    """transforms.json, or the folder of a COLMAP model, inside the folder; default: `transforms.json`, else `sparse/0`,
    `sparse`, `colmap/sparse/0`, `colmap`."""
    images: str = "images"
    """COLMAP: what the names of its images count from."""
    mesh: str | None = None
    """Mesh file inside the folder; default: the only one of mesh.ply, mesh.obj, mesh.glb."""
    unit: Literal["m", "cm", "mm", "km", "ft", "in"] | float = "m"
    """Unit of mesh and camera positions (a number = metres per unit)."""
    axes: Literal["opengl", "opencv"] = "opengl"
    """Camera axes of `transform_matrix`."""
    pixel_centre: Literal["auto", "half", "integer"] = "auto"
    """Where principal points count from: centres at (u+0.5) or at integers; auto reads `pixel_centres_at` of the file."""
    applied_transform: Literal["keep", "undo"] = "keep"
    """`undo`: the mesh is in the frame before nerfstudio's `applied_transform` (a mesh that COLMAP made)."""
    frames: str | None = None
    """Keep only images whose file path matches this glob."""


class ScanNetppSource(PhotographedSource):
    """A scene of ScanNet++ as released: `dslr/` and `scans/` in one folder (docs/own-data.md)."""

    kind: Literal["scannetpp"]
    path: Path
    """The scene's folder, such as `data/scannetpp/data/2a1b555966`."""
    images: Literal["dslr", "undistorted"] = "dslr"
    """`dslr`: fisheye `resized_images`, undistorted here; `undistorted`: what the toolbox made of them."""
    lists: Literal["all", "train"] = "all"
    """`all`: photographs of the test list are held out; `train`: they are left out."""
    world: Literal["nerfstudio", "mesh"] = "nerfstudio"
    """Frame of the poses in transforms.json: as released (turned against the mesh), or the mesh's own."""
    drop_bad: bool = True
    """Leave out photographs that the release marks as bad (`is_bad`)."""


class FiptSource(PhotographedSource):
    """A scene of FIPT or IIF, synthetic (`train/transforms.json`) or real (`cam.txt`, `K_list.txt`) (docs/own-data.md)."""

    kind: Literal["fipt"]
    path: Path
    """The scene's folder: holds scene.obj."""
    mesh: str = "scene.obj"
    """Mesh file inside the folder."""
    unit: Literal["m", "cm", "mm", "km", "ft", "in"] | float = "m"
    """Unit of mesh and camera positions (a number = metres per unit)."""
    validation: Literal["test", "none"] = "test"
    """Synthetic: photographs of `val/` are held out, or left out."""
    ids: Literal["auto", "parts", "semantic", "none"] = "auto"
    """Object ids: `parts` = `IndexMA`, `semantic` = `segmentation`; `auto`: the first of them that exists."""


Source = Annotated[BuiltinSource | MitsubaSource | FolderSource | ScanNetppSource | FiptSource, Field(discriminator="kind")]


class Capture(Section):
    """How the photographs encode radiance, and how many are taken."""

    dynamic_range: Literal["ldr", "hdr"] = "ldr"
    """`ldr`: 8-bit through an unknown response; `hdr`: linear radiance."""
    views: int = Field(16, ge=1)
    """Photographs to render, or the largest number to take (evenly spread) from those that exist."""
    width: int = Field(160, ge=16, le=8192)
    """Image width in pixels (existing photographs are reduced to fit width x height, aspect kept)."""
    height: int = Field(160, ge=16, le=8192)
    """Image height in pixels."""
    samples: int = Field(128, ge=1)
    """Paths a pixel for rendered photographs."""
    exposure: Literal["given", "estimate"] = "given"
    """`estimate`: gains of the views from surface that they share."""
    denoise: bool = False
    """Denoise rendered photographs: fewer samples do, at the price of a bias of a few per cent."""
    test_every: int = Field(0, ge=0)
    """Every n-th view is held out: no stage before `render` and `metrics` reads its photograph (0 = none)."""

    @field_validator("test_every")
    @classmethod
    def _leave_views(cls, value: int) -> int:
        if value == 1:
            raise ValueError("1 would keep every view for testing and leave none to use; allowed: 0, or 2 and more")
        return value


# ------------------------------------------------------------------------------------------------------------------ prior


class PriorBase(Section):
    samples: int = Field(8, ge=1, le=256)
    """Predictions a photograph, K."""
    seed: int | None = Field(None, ge=0, lt=2**31)
    """Seed of the predictions alone; default: the scene's."""


class SimulatedPrior(PriorBase):
    """Ground truth, spoilt the way RGB-X fails (needs a source with truth)."""

    kind: Literal["simulated"]
    strength: float = Field(1.0, ge=0, le=4)
    """0 = truth; 1 = the raw errors that the paper reports for RGB-X."""


class FilesPrior(PriorBase):
    """Maps of any model: `predictions/{albedo,roughness,metallic}/<view>_<kkk>.png|exr`."""

    kind: Literal["files"]
    path: Path | None = None
    """Folder that holds `predictions/`; default: the source's folder."""
    albedo_space: Literal["linear", "srgb"] = "linear"
    """Encoding of the albedo files."""
    roughness_is: Literal["perceptual", "alpha"] = "perceptual"
    """`alpha` = r^2 (microfacet)."""


class RetinexPrior(PriorBase):
    """No weights: photograph / light gathered from all photographs, then colour retinex (docs/real-scenes.md). A baseline, not
    a learned prior."""

    kind: Literal["retinex"]
    mean_albedo: float = Field(0.4, gt=0, lt=1)
    """Mean albedo that each hypothesis is scaled to."""


class DiffusionPrior(PriorBase):
    accept_license: bool = False
    """`true` says that you read the licence of the weights and may use them for this."""
    tile: int = Field(1024, ge=64, le=4096, multiple_of=64)
    """Larger pictures are sampled in tiles of this edge (pixels that the model sees), which overlap by a quarter."""
    batch: int | None = Field(None, ge=1)
    """Samples at once; default: 4 on a GPU, on a CPU one a thread."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: the GPU if torch sees one."""
    precision: Literal["auto", "float32", "float16", "bfloat16"] = "auto"
    """Of the U-Net; `auto`: float16 on a GPU, float32 on a CPU. The rest is float32."""


class RgbxPrior(DiffusionPrior):
    """RGB-X, a diffusion model whose weights you bring (docs/priors.md). Non-commercial research only."""

    kind: Literal["rgbx"]
    checkpoint: str = "zheng95z/rgb-to-x"
    """Folder in diffusers' layout, or the name of a repository in the local cache of Hugging Face. Nothing is downloaded."""
    revision: str | None = Field("b38b3fd73a14ea62f3953fc54bc4ac67b067bae0", pattern=r"^[0-9a-f]{7,40}$")
    """Commit of the checkpoint that is meant, or its first digits; where a folder tells none, it is not compared."""
    steps: int = Field(50, ge=1, le=1000)
    """Denoising steps."""
    longest_side: int = Field(1024, ge=64, le=8192)
    """Photographs are scaled to this size, in pixels, for the model; the maps are scaled back."""


class MarigoldPrior(DiffusionPrior):
    """Marigold-IID appearance, a diffusion model whose weights you bring (docs/priors.md)."""

    kind: Literal["marigold"]
    checkpoint: str = "prs-eth/marigold-iid-appearance-v1-1"
    """Folder in diffusers' layout, or the name of a repository in the local cache of Hugging Face. Nothing is downloaded."""
    revision: str | None = Field("e7280a0a0fc5a0df0b36050882b3d8b77da22fd9", pattern=r"^[0-9a-f]{7,40}$")
    """Commit of the checkpoint that is meant, or its first digits; where a folder tells none, it is not compared."""
    steps: int | None = Field(None, ge=1, le=1000)
    """Denoising steps; default: what the checkpoint recommends (4)."""
    longest_side: int | None = Field(None, ge=64, le=8192)
    """Photographs are scaled to this size, in pixels, for the model; default: what the checkpoint recommends (768)."""


Prior = Annotated[SimulatedPrior | FilesPrior | RetinexPrior | RgbxPrior | MarigoldPrior, Field(discriminator="kind")]

# ----------------------------------------------------------------------------------------------------------------- stages


class SegmentationBase(Section):
    border_erosion: int = Field(1, ge=0, le=16)
    """Pixels next to another object that count as border."""


class GivenSegmentation(SegmentationBase):
    """Ids that the source came with, of the mesh's faces or of views."""

    kind: Literal["given"] = "given"


class PiecesOfMesh(SegmentationBase):
    scale: float = Field(0.05, gt=0)
    """Pieces of the mesh: larger gives fewer, larger pieces."""
    min_faces: int = Field(100, ge=1)
    """Pieces of the mesh: smaller ones are merged into a neighbour."""
    colour: float = Field(0.1, ge=0)
    """Pieces of the mesh: weight of the photographs' mean colour of a face beside the bend of the surface (0 = shape alone)."""


class MaskSegmentation(PiecesOfMesh):
    """2D masks of any tool, `masks/<view>.png|exr` or `masks/<view>/<n>.png`, clustered across the views by view consensus;
    pieces of the mesh where there are none (docs/segmentation.md)."""

    kind: Literal["masks"]
    path: Path | None = None
    """Folder that holds `masks/`; default: the source's folder."""
    min_faces: int = Field(20, ge=1)
    """Pieces of the mesh: smaller ones are merged into a neighbour."""
    visible: float = Field(0.3, gt=0, le=1)
    """Share of a mask that a view must see to have an opinion about it."""
    contained: float = Field(0.8, gt=0, le=1)
    """A view holds a mask together if one of its own masks has more than this share of what it sees of it."""
    split: float = Field(0.5, gt=0, le=1)
    """A mask that more than this share of the views split is dropped: it holds several things. Smaller gives finer objects."""
    consensus: float = Field(0.9, gt=0, le=1)
    """Masks are joined if this share of the views that contain both hold them together. Larger gives finer objects."""
    min_points: int = Field(4, ge=1)
    """Masks of fewer surface points (two pixel footprints apart) are ignored."""


class GeometrySegmentation(PiecesOfMesh):
    """Felzenszwalb on the mesh graph: no ids and no masks are needed."""

    kind: Literal["geometry"]


Segmentation = Annotated[GivenSegmentation | MaskSegmentation | GeometrySegmentation, Field(discriminator="kind")]


_DIRECT_ALONE = ("sweeps", "ridge", "temperature", "anneal", "final_temperature", "seams", "robust", "objective")
_SGD_ALONE = ("preset", "texture", "iterations", "median_gradient")  # the sizes of the hash grid come with a quality


def _default(model: type[BaseModel], name: str) -> Any:
    return model.model_fields[name].get_default()


class Base(Section):
    """Fusing the K predictions of all views into one 3D base texture."""

    solver: Literal["direct", "sgd"] = "direct"
    """`direct`: alternating closed forms on surface cells; `sgd`: the paper's optimiser, to compare with."""
    variant: Literal["full", "uniform", "image_affine", "texel_mean", "object_mean", "raw"] = "full"
    """`full`: affines and selection; `uniform`: affines, no selection; `image_affine`: one affine an image instead of one an
    object and image; the means, and `raw` = the first prediction of each view as it is: baselines."""
    predictions: int | None = Field(None, ge=1)
    """Use only the first so many predictions of each view; default: all."""
    cell_edge: float | None = Field(None, gt=0)
    """Edge of a surface cell in metres; default: `cell_footprints` pixel footprints."""
    cell_footprints: float = Field(0.4, gt=0)
    """Cell edge in median pixel footprints."""
    border_weight: float = Field(0.1, gt=0, le=1)
    """Weight of pixels next to another object: real predictions bleed across borders."""
    footprint_power: float = Field(0.0, ge=0, le=4)
    """Weight pixels by (median footprint / own footprint) to this power: prefers near and frontal views of a surface."""
    objective: Literal["least_squares", "distribution"] = "least_squares"
    """`direct`: `distribution` then minimises the paper's own loss for the selection found."""
    robust: bool = False
    """`direct`: cells take an M-estimate instead of the mean (outliers in few views, at the price of sharpness)."""
    sweeps: int = Field(9, ge=1, le=200)
    """`direct`: alternations."""
    polish: int = Field(25, ge=1, le=1000)
    """`direct`, `objective: distribution`: sweeps on the paper's loss."""
    ridge: float = Field(0.01, gt=0)
    """`direct`: pull of the affines towards identity, per pixel."""
    temperature: float = Field(1.0, ge=0)
    """`direct`: selection temperature of the first sweep, in units of a segment's median error."""
    anneal: float = Field(0.6, gt=0, lt=1)
    """`direct`: factor on the selection temperature per sweep."""
    final_temperature: float = Field(0.1, ge=0)
    """`direct`: where annealing stops; 0 = the single best prediction, more = near-ties are averaged."""
    seams: bool = True
    """`direct`: close seams between parts of an object that no photograph shows together."""
    preset: Literal["safe", "paper"] = "safe"
    """`sgd`: `paper` = the published behaviour; `safe` = with the treatments of docs/base.md. Decides what is not set below."""
    texture: Literal["cells", "hashgrid"] | None = None
    """`sgd`: texture model; default: `cells`, `preset: paper` the hash grid."""
    iterations: int | None = Field(None, ge=1)
    """`sgd`: optimiser steps of 65,536 pixels; default: 3000, `preset: paper` 10 passes over the pixels."""
    hash_levels: int | None = Field(None, ge=1, le=32)
    """`sgd`, hash grid: levels; default: 16, `preset: paper` 32."""
    hash_entries: int | None = Field(None, ge=8, le=24)
    """`sgd`, hash grid: log2 of the entries a level; default: 17, `preset: paper` 19."""
    median_gradient: bool | None = None
    """`sgd`: follow the slope of the median over the predictions; default: no, `preset: paper` yes."""
    judge: bool = False
    """Evaluate the paper's loss of the result, of `sgd` also that of `direct` at the same selection (base.json)."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Base:
        if self.solver == "sgd" and self.variant != "full":
            raise ValueError(
                f"`solver: sgd` fits `variant: full` alone, not `{self.variant}`; use `solver: direct` for the others"
            )
        idle = _SGD_ALONE if self.solver == "direct" else _DIRECT_ALONE
        named = [name for name in idle if name in self.model_fields_set and getattr(self, name) != _default(Base, name)]
        if named:
            other = "sgd" if self.solver == "direct" else "direct"
            raise ValueError(
                f"{', '.join(f'`{name}`' for name in named)}: read by `solver: {other}` alone and without effect on `solver:"
                f" {self.solver}`; remove it, or set the solver"
            )
        if self.objective == "distribution" and self.variant not in ("full", "image_affine"):
            raise ValueError(f"`objective: distribution` needs a selection; `variant: {self.variant}` makes none")
        return self


class Emission(Section):
    """Emitters: which faces, how bright."""

    saturation: float = Field(0.99, gt=0, le=1)
    """Sensor value at which a pixel counts as saturated."""
    min_observations: int = Field(8, ge=1)
    """Pixels that must have seen a face (or patch) before it can be an emitter."""
    cache_edge: float = Field(0.06, gt=0)
    """Edge of a radiance-cache voxel in metres."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Path length where the cache does not answer."""
    rows: int = Field(40000, ge=100)
    """Pixels whose transport rows are traced."""
    samples: int = Field(16, ge=2)
    """Paths a row (two independent halves)."""
    prune: float = Field(0.01, ge=0, lt=1)
    """Groups below this share of the total power are dropped."""
    environment: Literal["auto", "on", "off"] = "auto"
    """Environment light (16 x 32 texels in groups; twelve directions where the mesh is open) for rays that escape;
    `auto`: when enough of them do."""
    solver: Literal["direct", "sgd"] = "direct"
    """`direct`: non-negative least squares; `sgd`: the paper's descent on the same rows, to compare with."""
    preset: Literal["safe", "paper"] = "safe"
    """`sgd`: `paper` = the published rate and pruning; `safe` = steps scaled by the diagonal, averaged."""
    iterations: int = Field(10000, ge=1)
    """`sgd`: batches of 1024 rows."""


class Shading(Section):
    """Cached incident shading: diffuse and split specular."""

    samples: int = Field(32, ge=2)
    """Paths a pixel (specular) and paths a cell to begin with (diffuse), over both halves."""
    levels: int = Field(10, ge=3, le=32)
    """Roughness levels."""
    cell_edge: float = Field(0.03, gt=0)
    """Diffuse light is cached once a piece of surface of this edge (metres), for all views."""
    noise: float = Field(0.1, gt=0)
    """Relative standard error of diffuse light (median of an object) at which no more paths are added."""
    max_samples: int = Field(512, ge=2)
    """Most paths a cell."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Path length where the radiance cache does not answer."""
    indirect: Literal["auto", "cache", "path"] = "auto"
    """`cache`: paths end at surface whose radiance was photographed; `path`: always traced with the base materials; `auto`:
    `cache` where enough of what the surface sees was photographed."""


class ResponseFile(Section):
    """A measured camera response."""

    file: Path
    """CSV or Parquet with columns `x, R, G, B` (exposed radiance from 0 to 1, sensor values), or NPY (3, samples) over
    even steps of x."""


class WhitePatch(Section):
    """Surface of known albedo: an object, or a box of pixels in one view."""

    object: str | None = None
    """Its name (objects.parquet)."""
    view: str | None = None
    """View of the box."""
    box: tuple[int, int, int, int] | None = None
    """Left, top, right, bottom in pixels; right and bottom excluded."""
    albedo: float = Field(gt=0, le=1)
    """Its albedo, mean over the channels, linear."""

    @model_validator(mode="after")
    def _one_place(self) -> WhitePatch:
        if (self.object is None) == (self.view is None) or (self.view is None) != (self.box is None):
            raise ValueError("a white patch is either `object: NAME` or `view: NAME` with `box: [left, top, right, bottom]`")
        return self


class KnownLamp(Section):
    """An emitter of known radiance."""

    emitter_id: int = Field(ge=0)
    """Its number (emitters.parquet)."""
    radiance: tuple[float, float, float]
    """R, G, B in the units that the result shall have; the mean counts."""

    @field_validator("radiance")
    @classmethod
    def _shines(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) < 0 or sum(value) <= 0:
            raise ValueError(f"radiance {list(value)}: no channel below 0, and their sum above 0")
        return value


class KnownScale(Section):
    """What fixes the scale of light and albedo: exactly one."""

    white_patch: WhitePatch | None = None
    """Surface of known albedo."""
    lamp: KnownLamp | None = None
    """Emitter of known radiance."""
    mean_albedo: float | None = Field(None, gt=0, le=1)
    """Mean albedo of the fitted pixels."""

    @model_validator(mode="after")
    def _one_kind(self) -> KnownScale:
        given = [name for name in ("white_patch", "lamp", "mean_albedo") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of white_patch, lamp, mean_albedo; found {', '.join(given) or 'none'}")
        return self


class Affines(Section):
    """One affine per object and the camera response."""

    model: Literal["objects", "base", "object_mean", "texture_average", "fipt", "iris"] = "objects"
    """`objects`: one affine an object; the others are baselines over the same light: `base` fits nothing, `object_mean`: the
    predictions' mean of each object, `texture_average`: the photographs' mean colour of each surface cell taken as albedo,
    `fipt`, `iris`: a free BRDF in every surface cell (docs/studies.md)."""
    solver: Literal["direct", "sgd", "adam"] = "direct"
    """`objects`: `direct` Gauss-Newton; `sgd`: the paper's optimiser on the paper's loss; `adam`: the same with its safe variant.
    `fipt`, `iris`: `direct` exact per cell; `adam` as published."""
    response: Literal["auto", "identity", "srgb", "gamma", "ggcm", "spline"] | ResponseFile = "auto"
    """Family of the camera response, or `{file: curve.csv}` for a measured one (CSV or Parquet with columns `x, R, G, B`; NPY
    (3, samples)). `auto`: identity for HDR; for LDR the smallest of srgb, gamma, ggcm and spline that explains how
    differently exposed photographs show the same surface, srgb where there are none."""
    iterations: int = Field(60, ge=1, le=500)
    """`direct`: most Gauss-Newton steps; it ends when a step changes nothing."""
    pixels: int = Field(200000, ge=100)
    """Pixels in the fit (drawn evenly over objects)."""
    population: bool = True
    """`direct`: objects lean on what the well-determined ones have in common, as far as those agree; otherwise on `ridge`."""
    ridge: float = Field(0.002, gt=0)
    """`direct` without `population`: pull towards identity, per pixel."""
    robust_width: float = Field(0.1, gt=0)
    """`direct`: Cauchy width of the residual in sensor units."""
    epochs: int = Field(3, ge=1)
    """`sgd`, `adam`: passes over the pixels; the rate falls to a fifth after each."""
    batch: int = Field(32768, ge=1)
    """`sgd`, `adam`: pixels of a step."""
    rate: float | None = Field(None, gt=0)
    """`sgd`, `adam`: step size; default 10 and 0.01."""
    scale: Literal["found", "prior"] | KnownScale = "found"
    """What fixes the factor between light and albedo. `found`: the light as stage emission found it, by how much of it is
    indirect (always so for HDR, unless a known scale is given); `prior`: the prior's mean albedo; or what is known: {white_patch:
    {object: NAME, albedo: 0.9}}, {white_patch: {view: NAME, box: [left, top, right, bottom], albedo: 0.9}}, {lamp: {emitter_id:
    0, radiance: [5, 5, 4]}} or {mean_albedo: 0.4}."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Affines:
        allowed = {"objects": ("direct", "sgd", "adam"), "fipt": ("direct", "adam"), "iris": ("direct", "adam")}
        solvers = allowed.get(self.model, ("direct",))
        if self.solver not in solvers:
            raise ValueError(f"`solver: {self.solver}` does not fit `model: {self.model}`; allowed with it: {', '.join(solvers)}")
        return self


class Render(Section):
    """Re-rendering of the views from the recovered scene."""

    samples: int = Field(16, ge=1)
    """Paths a pixel."""
    max_bounces: int = Field(16, ge=1, le=64)
    """Path length."""
    denoise: bool = True
    """Denoise the re-renderings (they are looked at and compared, nothing is fitted to them)."""


class Metrics(Section):
    """What is compared."""

    views: Literal["all"] = "all"
    """Views that are scored."""
    lpips_vgg: bool = False
    """Score albedo (of the result, the base and the first prediction; as it is and scaled) also with LPIPS on VGG16, as the
    paper does. Needs its weights: `snakemake --cores 1 results/weights/lpips_vgg.npz`. Triples the time of the stage."""


class Export(Section):
    """Files for other programs."""

    max_faces_glb: int = Field(2_000_000, ge=1000)
    """Faces in scene.glb; above, it is refused with a note rather than written for minutes."""


class Report(Section):
    """The page."""

    views: int = Field(6, ge=1)
    """Views shown."""
    credit: str = ""
    """Line under the title (artist, licence)."""


class RelightSphere(Section):
    """A black sphere that shines, put into the room."""

    center: tuple[float, float, float]
    """Metres, world axes."""
    radius: float = Field(0.2, gt=0)
    """Metres."""
    radiance: tuple[float, float, float] = (53.0, 50.0, 45.0)
    """In the units of emitters.parquet."""
    path_to: tuple[float, float, float] | None = None
    """Where it has moved to in the last frame."""


class RelightCamera(Section):
    """Stills or a flight between views."""

    views: list[str] = Field(default_factory=list)
    """Names of the views to fly along (one: a still camera); default: the first view."""
    frames: int = Field(1, ge=1, le=10000)
    """Pictures."""
    fov: float | None = Field(None, gt=1, lt=170)
    """Horizontal field of view in degrees; default: as photographed."""
    width: int | None = Field(None, ge=8, le=8192)
    """Pixels; default: of the first view."""
    height: int | None = Field(None, ge=8, le=8192)
    """Pixels; default: of the first view."""


class Relighting(Section):
    """One relighting of the recovered scene: `snakemake --cores 2 relight/<scene>` (docs/relighting.md)."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
    """Folder of its pictures."""
    emitters: float = Field(1.0, ge=0)
    """`on`, `off`, or what their radiance is multiplied by."""
    environment: Literal["keep", "off"] | tuple[float, float, float] | Path = "keep"
    """Light from outside: `keep`, `off`, one radiance `[r, g, b]`, or a latitude-longitude EXR (top row = up)."""
    environment_turn: float = 0.0
    """Degrees by which an EXR is turned about the up axis."""
    sphere: RelightSphere | None = None
    """A lamp that is put in."""
    camera: RelightCamera = RelightCamera()
    """Where from."""
    exposure: float | None = Field(None, gt=0)
    """What radiance is multiplied by before the camera response; default: by the brightness of the first frame."""
    samples: int = Field(64, ge=1)
    """Paths a pixel."""
    max_bounces: int = Field(8, ge=1, le=64)
    """Path length."""
    denoise: bool = True
    """Denoise the pictures."""

    @field_validator("emitters", mode="before")
    @classmethod
    def _switch(cls, value: Any) -> Any:
        return {"on": 1.0, "off": 0.0}.get(value, value) if isinstance(value, str) else value

    @field_validator("environment", mode="before")
    @classmethod
    def _no_environment(cls, value: Any) -> Any:  # YAML reads a bare `off` as false
        return {False: "off", True: "keep"}[value] if isinstance(value, bool) else value


class SceneSettings(Section):
    """Everything about one scene."""

    source: Source
    """Where photographs, cameras and mesh come from."""
    capture: Capture = Capture()
    prior: Prior
    """Where the K material predictions come from."""
    segmentation: Segmentation = GivenSegmentation()
    """Which surface belongs to which object."""
    base: Base = Base()
    emission: Emission = Emission()
    shading: Shading = Shading()
    affines: Affines = Affines()
    render: Render = Render()
    metrics: Metrics = Metrics()
    export: Export = Export()
    report: Report = Report()
    relight: list[Relighting] = Field(default_factory=list)
    """Pictures under other light and from elsewhere, made on demand."""
    seed: int = Field(0, ge=0, lt=2**31)
    """Seed of everything random."""

    @field_validator("segmentation", mode="before")
    @classmethod
    def _given_unless_named(cls, value: Any) -> Any:
        return {"kind": "given", **value} if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _known_predictions(self) -> SceneSettings:
        made, used = getattr(self.prior, "samples", None), self.base.predictions
        if made is not None and used is not None and used > made:
            raise ValueError(
                f"`base: predictions` is {used}, but `prior: samples` makes {made}; lower the one or raise the other"
            )
        return self


# ---------------------------------------------------------------------------------------------------------------- loading


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a key that stands twice in one mapping is an error, not a silent choice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=deep) for key, _ in node.value]
        for key, (key_node, _) in zip(keys, node.value, strict=True):
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"key `{key}` stands twice", key_node.start_mark)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """A file of `key: value` lines; an `InputError` names file and line."""
    try:
        document = yaml.load(path.read_text(encoding="utf-8"), _StrictLoader)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}{where}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path}: found {type(document).__name__}, expected `key: value` lines; see config/scenes/kitchen.yaml")
    return document


def merge(lower: dict[str, Any], upper: dict[str, Any]) -> dict[str, Any]:
    """`upper` over `lower`, key by key; a different `kind` replaces the whole section."""
    out = dict(lower)
    for key, value in upper.items():
        below = out.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            replaced = "kind" in value and "kind" in below and value["kind"] != below["kind"]
            out[key] = value if replaced else merge(below, value)
        else:
            out[key] = value
    return out


def scene_names(root: Path = Path(".")) -> list[str]:
    """Every scene that has a file."""
    return sorted(path.stem for path in (root / "config/scenes").glob("*.yaml"))


def scene_file(scene: str, root: Path = Path(".")) -> Path:
    """Path of a scene's file, of a study's derived scene its parent's; an unknown scene is an error with the nearest name."""
    from workflow import batch, studies  # they need this module first

    parts = studies.derived(scene, root)
    scene = parts.scene if parts else scene
    path = root / "config/scenes" / f"{scene}.yaml"
    if not path.is_file():
        files = scene_names(root)
        listed = [line.name for line in batch.read_table(root) if line.name not in files]
        near = difflib.get_close_matches(scene, files + listed, 1)
        hint = f" Did you mean scenes/{near[0]}?" if near else ""
        more = f" and {len(listed)} of {batch.TABLE}" if listed else ""
        raise InputError(
            f"config/scenes/{scene}.yaml: not found.{hint} Known scenes: {', '.join(files) or 'none'}{more}."
            " Add a file there to add a scene (docs/own-data.md)."
        )
    return path


def scene_origin(scene: str, root: Path = Path(".")) -> str:
    """Where a scene is described, for messages: its file, or its line of the batch table."""
    from workflow import batch

    line = batch.find(scene, root)
    return line.at() if line else str(scene_file(scene, root))


_UNIONS: dict[str, dict[str, type[Section]]] = {
    "source": {
        "builtin": BuiltinSource,
        "mitsuba": MitsubaSource,
        "folder": FolderSource,
        "scannetpp": ScanNetppSource,
        "fipt": FiptSource,
    },
    "prior": {
        "simulated": SimulatedPrior,
        "files": FilesPrior,
        "retinex": RetinexPrior,
        "rgbx": RgbxPrior,
        "marigold": MarigoldPrior,
    },
    "segmentation": {"given": GivenSegmentation, "masks": MaskSegmentation, "geometry": GeometrySegmentation},
}


def _section_in(annotation: Any) -> Any:
    """The section in `list[Section]` and `Section | None`; other types as they are."""
    inner = [t for t in getattr(annotation, "__args__", ()) if isinstance(t, type) and issubclass(t, Section)]
    return inner[0] if inner else annotation


def _section_of(where: tuple[str | int, ...]) -> type[Section] | None:
    model: Any = SceneSettings
    parts = [str(p) for p in where]
    for part in parts[:-1]:
        if part in _UNIONS and model is SceneSettings:
            model = _UNIONS[part]
        elif isinstance(model, dict):
            model = model.get(part, model)
        else:
            field = getattr(model, "model_fields", {}).get(part)
            model = _section_in(field.annotation) if field else model
    return model if isinstance(model, type) else None


def _explain(error: ValidationError, origin: Callable[[str], str]) -> str:
    """One line a problem; `origin` tells the file of a dotted key."""
    lines = []
    for problem in error.errors():
        where = problem["loc"]
        tags = {tag for union in _UNIONS.values() for tag in union}
        dotted = ".".join(str(p) for i, p in enumerate(where) if not (i == 1 and str(p) in tags))
        found = problem.get("input")
        kind = problem["type"]
        path = origin(f"{dotted}.kind" if kind.startswith("union_tag") else dotted)
        if kind == "extra_forbidden":
            section = _section_of(where)
            allowed = sorted(section.model_fields) if section else []
            near = difflib.get_close_matches(str(where[-1]), allowed, 1)
            hint = f" Did you mean `{near[0]}`?" if near else ""
            lines.append(f"{path}: `{dotted}`: unknown key.{hint} Allowed here: {', '.join(allowed)}.")
        elif kind in ("model_type", "model_attributes_type", "dict_type"):
            lines.append(f"{path}: `{dotted}`: found {found!r}, needed `key: value` pairs, e.g. `{where[0]}: {{kind: ...}}`.")
        elif kind == "missing":
            lines.append(f"{path}: `{dotted}`: missing. Add it; config/scenes/kitchen.yaml is a complete example.")
        elif kind in ("union_tag_invalid", "union_tag_not_found"):
            union = _UNIONS.get(str(where[0]), {})
            got = found.get("kind") if isinstance(found, dict) else found
            lines.append(f"{path}: `{dotted}.kind`: found {got!r}, allowed: {', '.join(union)}.")
        elif kind == "value_error" and isinstance(found, dict):  # keys that do not go together: the message says which
            lines.append(f"{path}: `{dotted}`: {problem['ctx']['error']}.")
        else:
            shown = found if not isinstance(found, dict) else "a mapping"
            lines.append(f"{path}: `{dotted}`: found {shown!r}. {problem['msg']}.")
    return "\n".join(lines)


def load(scene: str, quality: str = "draft", root: Path = Path(".")) -> SceneSettings:
    """Settings of `scene` at `quality`; an `InputError` names file, key, what was found and what is allowed."""
    if quality not in QUALITIES:
        raise InputError(f"--config quality={quality}: unknown quality; allowed: {', '.join(QUALITIES)}")
    from workflow import batch, studies

    preset_file = root / "config/quality" / f"{quality}.yaml"
    preset = read_yaml(preset_file) if preset_file.is_file() else {}
    if line := batch.find(scene, root):
        layers = [(f"config/quality/{quality}.yaml", preset), *batch.layers(line, root)]
        try:
            return SceneSettings.model_validate(_merged(layers))
        except ValidationError as error:
            raise InputError(_explain(error, batch.blame(line, layers))) from None
    path = scene_file(scene, root)
    shown = path.relative_to(root) if path.is_absolute() else path
    layers = [("", preset), (str(shown), read_yaml(path))]
    if parts := studies.derived(scene, root):
        layers += studies.layers(parts, root)
    try:
        return SceneSettings.model_validate(_merged(layers))
    except ValidationError:
        for count in range(2, len(layers) + 1):  # blame the first layer that spoils it
            try:
                SceneSettings.model_validate(_merged(layers[:count]))
            except ValidationError as error:
                raise InputError(_explain(error, lambda _, blamed=layers[count - 1][0]: blamed)) from None
        raise


def _merged(layers: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for _, layer in layers:
        out = merge(out, layer)
    return out


def dump(settings: SceneSettings) -> dict[str, Any]:
    """Plain JSON values of the settings."""
    return settings.model_dump(mode="json")


def select(document: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """The parts of a dumped settings tree named by dotted `keys`."""
    out: dict[str, Any] = {}
    for key in keys:
        value: Any = document
        for part in key.split("."):
            value = value[part]
        out[key] = value
    return out


def require_relighting(document: dict[str, Any], scene: str) -> list[dict[str, Any]]:
    """The relightings of a dumped settings tree; an error where there are none, or two of one name."""
    wanted: list[dict[str, Any]] = document["relight"]
    if not wanted:
        raise InputError(
            f"config/scenes/{scene}.yaml: no relighting is configured. Add one, for example"
            " `relight: [{name: evening, emitters: off, sphere: {center: [2, 2, 1.5]}}]` (docs/relighting.md)."
        )
    names = [entry["name"] for entry in wanted]
    if len(set(names)) < len(names):
        raise InputError(f"`relight`: found the names {', '.join(names)}; every relighting needs a name of its own")
    return wanted


def relight_files(document: dict[str, Any]) -> list[Path]:
    """Environment files that the relightings of a dumped settings tree name; a missing one is an error."""
    named = [entry["environment"] for entry in document["relight"]]
    files = [Path(value) for value in named if isinstance(value, str) and value not in ("keep", "off")]
    for path in files:
        if path.suffix.lower() != ".exr" or not path.is_file():
            raise InputError(
                f"`relight.environment`: found {str(path)!r}, which is no EXR file here; allowed: keep, off, [r, g, b] or the"
                " path of a latitude-longitude EXR"
            )
    return files


def schema_json() -> str:
    """JSON schema of a scene file, for editors (`config/scene.schema.json`)."""
    schema = SceneSettings.model_json_schema()
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=1) + "\n"


_BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below", "min_length": "at least"}


def _bound(rule: Any) -> str:
    """`at least 1` of pydantic's `Ge(ge=1)`."""
    return ", ".join(f"{words} {getattr(rule, name)}" for name, words in _BOUNDS.items() if hasattr(rule, name))


def reference_markdown() -> str:
    """The settings as a page: key, default, allowed values, meaning (docs/settings.md)."""
    lines = ["# Settings", "", "Made from `workflow/settings.py` by `python -m workflow.settings`; do not edit.", ""]

    def rows(model: type[Section], prefix: str) -> None:
        lines.extend(["| key | default | meaning |", "|---|---|---|"])
        nested_rows: list[tuple[str, type[Section]]] = []
        for name, field in model.model_fields.items():
            if name == "kind":
                continue
            section = _section_in(field.annotation)
            nested = isinstance(section, type) and issubclass(section, Section)
            if nested:
                nested_rows.append((f"{prefix}{name}.", section))
                default = "none" if field.get_default() is None else "see below"
            else:
                default = "required" if field.is_required() else f"`{field.get_default(call_default_factory=True)}`"
            text = " ".join((field.description or "").split())
            bounds = ", ".join(filter(None, map(_bound, field.metadata)))
            literal = getattr(field.annotation, "__args__", ())
            if literal and all(isinstance(v, str) for v in literal):
                text += f" One of {', '.join(f'`{v}`' for v in literal)}."
            lines.append(f"| `{prefix}{name}` | {default} | {text}{f' ({bounds})' if bounds else ''} |")
        lines.append("")
        for inner, section in nested_rows:
            rows(section, inner)

    for name, field in SceneSettings.model_fields.items():
        if name in _UNIONS:
            for kind, model in _UNIONS[name].items():
                lines.extend([f"## `{name}: {{kind: {kind}}}`", "", " ".join((model.__doc__ or "").split()), ""])
                rows(model, f"{name}.")
        elif isinstance(section := _section_in(field.annotation), type) and issubclass(section, Section):
            many = section is not field.annotation
            lines.extend([f"## `{name}`" + (" (a list)" if many else ""), "", " ".join((section.__doc__ or "").split()), ""])
            rows(section, f"{name}[]." if many else f"{name}.")
        else:
            lines.extend([f"## `{name}`", "", f"Default `{field.get_default()}`. {field.description or ''}", ""])
    return "\n".join(lines)


if __name__ == "__main__":
    Path("config/scene.schema.json").write_text(schema_json())
    Path("docs/settings.md").write_text(reference_markdown())
