"""Where photographs, cameras and mesh come from, and how they are taken."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from workflow.settings.section import Section


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
