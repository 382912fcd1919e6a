"""Settings of the source: where photographs, cameras and mesh come from, and how many photographs are taken."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from iif_core.errors import InputError
from iif_core.surface.axes import AS_IS, turn_of
from workflow import plugins
from workflow.settings.section import ON_OFF, Section

MESH_UP = {"as_poses": AS_IS, "y": "x -z y", "z": "x z -y"}
"""Words of `source.mesh_up` -> the axes of the poses, as axes of the mesh file."""


def mesh_axes(mesh_up: str) -> str:
    """Return the axes of the poses, as axes of the mesh file, of a value of `source.mesh_up`."""
    return MESH_UP.get(mesh_up, mesh_up)


class PhotographedSource(Section):
    alignment: Annotated[Literal["check", "warn", "off"], ON_OFF] = "check"
    """Compare the projected mesh with depth images, sparse points or image edges; `check` refuses a mismatch and reports the
    measured disagreement."""
    registration: Annotated[Literal["auto", "off"], ON_OFF] = "auto"
    """`auto`: correct poses, focal length and principal point by the mesh and the other photographs, if held-out surface confirms
    the correction, and leave out blurred and badly posed photographs. `off`: use them as given."""
    borders: Literal["leave_out", "keep"] = "leave_out"
    """`leave_out`: black pixels that hang together with the edge in most photographs are no surface: borders of photographs whose
    distortion was removed without cropping, letterboxes. Nor is what is written into nearly all of them, such as a date."""
    close_holes: float = Field(0.5, ge=0)
    """Close holes of the mesh up to so many metres across, where the filling continues the surface around; 0: leave them open.
    Through a hole light is lost, and comes in that was never there."""
    close: Literal["none", "box", "planes"] = "none"
    """Build the walls, floor and ceiling that a scan lacks: `box`: six sides at its extent; `planes`: its large outer planes,
    prolonged until they meet, and sides of that box where there are none. No pixel shows what was built; it reflects light, keeps
    light out, and each side of it may shine. Windows without a pane are closed too."""
    colour: Literal["file", "srgb", "linear", "display_p3", "adobe_rgb", "rec2020", "acescg"] = "file"
    """Colour space of the photographs: as each file says, or one for all, whatever they say. Of EXR files, which are linear, it
    gives the primaries."""
    mesh_up: Literal["as_poses", "y", "z"] | str = "as_poses"
    """How the mesh file is turned against the poses: `y`: it has y up and they have z up (as a GLB of a room with z up), `z`: the
    other way round. Any other quarter turn: the x, y and z of the poses, as axes of the mesh file, such as `z x y`."""

    @field_validator("mesh_up")
    @classmethod
    def _names_a_turn(cls, value: str) -> str:
        try:
            turn_of(mesh_axes(value))
        except InputError:
            words = ", ".join(map(repr, MESH_UP))
            turn = "x, y and z in another order or with signs that make no mirror image: x -z y"
            raise ValueError(f"Needed: {words}, or {turn}") from None
        return value


class FolderSource(PhotographedSource):
    """A scene of your own: cameras of any of several programs (docs/guide/programs.md), images and a mesh in one folder
    (docs/guide/own-data.md)."""

    kind: Literal["folder"]
    path: Path
    """The folder."""
    cameras: str | None = None
    """transforms.json, the folder of a COLMAP model, or cameras of Metashape (.xml) or Meshroom (.sfm) inside the folder; by
    default the first that exists of `transforms.json`, `cameras.xml`, `cameras.sfm`, `sfm.json`, `sparse/0`, `sparse`,
    `colmap/sparse/0`, `colmap`, and the raw data of a scanning app."""
    images: str = "images"
    """COLMAP, Metashape, Meshroom: folder that the names of the images are relative to."""
    mesh: str | None = None
    """Mesh file inside the folder; by default the only one of mesh.ply, mesh.obj and mesh.glb."""
    unit: Literal["m", "cm", "mm", "km", "ft", "in"] | float = "m"
    """Unit of mesh and camera positions; a number is metres per unit."""
    axes: Literal["opengl", "opencv"] = "opengl"
    """Camera axes of `transform_matrix`."""
    pixel_centre: Literal["auto", "half", "integer"] = "auto"
    """Convention of principal points: pixel centres at half-integers or at integers; `auto` reads `pixel_centres_at` of the
    file."""
    applied_transform: Literal["keep", "undo"] = "keep"
    """`undo`: the mesh is in the frame before nerfstudio's `applied_transform`, as a mesh made by COLMAP is."""
    frames: str | None = None
    """Keep only images whose file path matches this glob pattern."""


class PhotographsSource(PhotographedSource):
    """Photographs and nothing else: cameras and mesh are found from them (docs/guide/programs.md#photographs-alone)."""

    kind: Literal["photographs"]
    path: Path
    """Folder of the photographs; those in its folders count too."""
    mesh_up: Literal["as_poses"] = "as_poses"
    """The mesh that is found lies as the cameras do."""
    most: int = Field(120, ge=3, le=2000)
    """Largest number of photographs whose cameras are found, evenly spread by name; of those, `capture.views` are used for
    materials."""
    room_height: float | None = Field(None, gt=0.5, lt=20)
    """Metres from floor to ceiling, which give the scale."""
    camera_height: float = Field(1.5, gt=0.05, lt=20)
    """Metres above the floor at which the cameras are held (median); a guess of the scale where `room_height` is not given."""
    detail: int = Field(480, ge=64, le=4096)
    """Pixels along the longer side of the depth maps of which the mesh is made. Time goes with its cube."""


class ScanNetppSource(PhotographedSource):
    """A scene of ScanNet++ as released: `dslr/` and `scans/` in one folder (docs/guide/own-data.md)."""

    kind: Literal["scannetpp"]
    path: Path
    """Folder of the scene, such as `data/scannetpp/data/2a1b555966`."""
    images: Literal["dslr", "undistorted"] = "dslr"
    """`dslr`: the fisheye `resized_images`, undistorted here; `undistorted`: the images that the toolbox has undistorted."""
    world: Literal["nerfstudio", "mesh"] = "nerfstudio"
    """Frame of the poses in transforms.json: as released (rotated against the mesh), or the frame of the mesh."""


class FiptSource(PhotographedSource):
    """A scene of FIPT or IIF, synthetic (`train/transforms.json`) or real (`cam.txt`, `K_list.txt`) (docs/guide/own-data.md)."""

    kind: Literal["fipt"]
    path: Path
    """Folder of the scene, which holds scene.obj."""
    mesh: str = "scene.obj"
    """Mesh file inside the folder."""
    unit: Literal["m", "cm", "mm", "km", "ft", "in"] | float = "m"
    """Unit of mesh and camera positions; a number is metres per unit."""


Source = Annotated[
    plugins.union("source", FolderSource, PhotographsSource, ScanNetppSource, FiptSource),
    Field(discriminator="kind"),
]


class Capture(Section):
    """How the photographs encode radiance, and how many are taken."""

    dynamic_range: Literal["ldr", "hdr"] = "ldr"
    """`ldr`: 8-bit values through an unknown camera response; `hdr`: linear radiance."""
    views: int = Field(16, ge=1)
    """Number of photographs to render, or the largest number to take, evenly spread, from those that exist."""
    width: int = Field(160, ge=16, le=8192)
    """Image width in pixels; existing photographs are reduced to fit width x height, with their aspect ratio kept."""
    height: int = Field(160, ge=16, le=8192)
    """Image height in pixels."""
    exposure: Literal["auto", "given", "estimate"] = "auto"
    """`given`: exposures of `exposures.json` or the source, without them all alike. `estimate`: found from surface that several
    photographs show. `auto`: given ones, without them those of 8-bit photographs estimated if they differ."""
    test_every: int = Field(0, ge=0)
    """Hold out every n-th view, or as many in stretches of a video: no stage before `render` and `metrics` reads its photograph
    (0 = none)."""

    @field_validator("test_every")
    @classmethod
    def _leave_views(cls, value: int) -> int:
        if value == 1:
            raise ValueError("1 would keep every view for testing and leave none to use; allowed: 0, or 2 and more")
        return value
