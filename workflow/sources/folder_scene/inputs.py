"""The files of a scene: the record that every source of photographs fills, and the search of the source `folder`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.settings.names import did_you_mean_path
from workflow.sources.folder_scene import apps, colmap, exposure, images, mesh, photogrammetry, transforms
from workflow.sources.folder_scene.camera import metres_per_unit
from workflow.sources.folder_scene.frames import Cameras, Frame, files_below, folder_at

TRUTH = ("albedo", "roughness", "metallic", "emission")


@dataclass(frozen=True)
class Inputs:
    """Every file that the capture of a scene reads.

    Attributes:
        cameras: the checked ones.
        mesh: the mesh file.
        exposures: exposures.json.
        metres: per unit of the poses and of the mesh.
        of_vertices: reads the object ids of the mesh's vertices.
        load_ids: reads a map of object ids, given its path, the EXIF turn and the size of the picture.
        response: (3, 101) true camera response.
        also: further files that are read.
    """

    cameras: Cameras
    mesh: Path
    exposures: Path | None = None
    metres: float = 1.0
    of_vertices: Callable[[], mesh.VertexIds] | None = None
    load_ids: Callable[[Path, int, tuple[int, int]], np.ndarray] = images.load_ids
    response: np.ndarray | None = None
    also: tuple[Path, ...] = ()

    def from_origin(self, origin: np.ndarray) -> Inputs:
        """Return the inputs with all positions relative to an origin (3,), metres."""
        if not origin.any():
            return self
        own = origin / self.metres

        def moved(matrix: np.ndarray | None) -> np.ndarray | None:
            return None if matrix is None else matrix - np.pad(own[:, None], ((0, 1), (3, 0)))

        frames = tuple(
            replace(
                frame,
                matrix=moved(frame.matrix),
                depth_matrix=moved(frame.depth_matrix),
                seen=None if frame.seen is None else frame.seen - own,
            )
            for frame in self.cameras.frames
        )
        return replace(self, cameras=replace(self.cameras, frames=frames))

    def files(self) -> list[Path]:
        """List all files."""
        out = [self.cameras.path, self.mesh, *([self.exposures] if self.exposures else [])]
        out += [path for frame in self.cameras.frames for path in frame.files()]
        return [*out, *self.cameras.also, *self.also]


def find_inputs(source: dict[str, Any], capture: dict[str, Any], points: bool = False) -> Inputs:
    """Find and check the cameras of a scene and its files; `points`: also read the sparse points of a COLMAP model, which is
    slow.

    Raises:
        InputError: missing or unusable files, by name.
    """
    metres = metres_per_unit(source["unit"])
    folder = folder_at(source, "transforms.json, a COLMAP model, or the export of a program")
    listed, meshes = _cameras(folder, source, capture, points)
    if capture["test_every"] == 1:
        raise InputError("`capture.test_every: 1` keeps every view for testing; give 0 (none) or 2 and more")
    mesh_path = mesh.find(folder, source.get("mesh"), meshes)
    exposures = folder / "exposures.json"
    has_exposures = exposures.is_file()
    if has_exposures:
        exposure.read_given(exposures, [(f.name, f.file_path) for f in listed.frames])
    ids, truth = _instances(folder, listed.frames), _truth(folder, listed.frames)
    frames = tuple(replace(f, ids=ids.get(f.name), truth=truth.get(f.name, {})) for f in listed.frames)
    return Inputs(replace(listed, frames=frames), mesh_path, exposures if has_exposures else None, metres)


def _cameras(folder: Path, source: dict[str, Any], capture: dict[str, Any], points: bool) -> tuple[Cameras, tuple[str, ...]]:
    """Read the cameras of a folder, by whichever program wrote them; also the names of meshes that this program exports."""
    stated = source["cameras"]
    if str(stated).endswith("transforms.json") or (stated is None and (folder / "transforms.json").is_file()):
        return transforms.read(source, capture), ()
    of_program = photogrammetry.find(folder, stated)
    if of_program is not None:
        return photogrammetry.frames_of(folder, of_program, source, capture), ()
    if str(stated).endswith(".json"):
        return transforms.read(source, capture), ()
    model = colmap.find(folder, stated)
    if model is not None:
        return colmap.frames_of(folder, model, source, capture, points), ()
    app = apps.find(folder)
    if app is not None:
        return apps.frames_of(app, folder, source, capture), apps.MESHES[app]
    raise InputError(
        f"{folder}: neither transforms.json nor a COLMAP model, nor cameras of another program that is known"
        " (docs/guide/programs.md); a `folder` scene needs one of them, a scene of photographs alone has"
        f" `source: {{kind: photographs}}`.{_hint(folder)}"
    )


FOREIGN = {
    ".csv": "what RealityScan calls camera parameters; export Registration, COLMAP text (docs/guide/programs.md#realityscan)",
    ".xmp": "what RealityScan writes beside photographs; export Registration, COLMAP text (docs/guide/programs.md#realityscan)",
    ".rcproj": "a project of RealityScan; export Registration, COLMAP text (docs/guide/programs.md#realityscan)",
    ".psx": "a project of Metashape; export its cameras as XML (docs/guide/programs.md#metashape)",
    ".psz": "a project of Metashape; export its cameras as XML (docs/guide/programs.md#metashape)",
    ".mg": "a project of Meshroom; its cameras are in cameras.sfm of a later step (docs/guide/programs.md#meshroom)",
    ".nvm": "cameras of VisualSFM; `colmap model_converter` or RealityScan's COLMAP text brings them here",
    ".out": "cameras of Bundler; export them as a COLMAP model",
    ".blend": "a file of Blender; export its cameras (docs/guide/programs.md#blender)",
    ".r3d": "a recording of Record3D; unpack it (docs/guide/programs.md#record3d)",
    ".zip": "an archive; unpack it there",
}
"""Files of other programs that hold no cameras as they are read here -> what they are, and what to do."""


def _hint(folder: Path) -> str:
    """Say which file may be meant, what lies there instead, or that the capture lies one folder further down, as archives are
    often unpacked."""
    found = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in photogrammetry.SUFFIXES)
    if found:
        return f" Found {', '.join(found[:3])}: name it with `source.cameras`"
    for below in sorted(path for path in folder.iterdir() if path.is_dir()):
        if (
            (below / "transforms.json").is_file()
            or apps.find(below)
            or photogrammetry.find(below, None)
            or colmap.find(below, None)
        ):
            return f" There is one in {below}: set `source.path` to it"
    foreign = {path.suffix.lower(): path for path in reversed(files_below(folder, FOREIGN))}
    for suffix, what in FOREIGN.items():
        if suffix in foreign and (suffix != ".csv" or _begins_with(foreign[suffix], b"#name")):
            return f" {foreign[suffix].relative_to(folder)} is {what}"
    return did_you_mean_path(folder / "transforms.json")


def _begins_with(path: Path, start: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(start)) == start


def _instances(folder: Path, frames: tuple[Frame, ...]) -> dict[str, Path]:
    here = folder / "instances"
    if not here.is_dir():
        return {}
    out = {}
    for frame in frames:
        found = [path for suffix in (".png", ".exr") if (path := here / f"{frame.name}{suffix}").is_file()]
        if len(found) > 1:
            raise InputError(f"{here}: {found[0].name} and {found[1].name} are the same view; remove one")
        if found:
            out[frame.name] = found[0]
    if not out:
        raise InputError(f"{here}: no file for any view; expected names such as {frames[0].name}.png")
    return out


def _truth(folder: Path, frames: tuple[Frame, ...]) -> dict[str, dict[str, Path]]:
    here = folder / "truth"
    if not here.is_dir():
        return {}
    out = {frame.name: {kind: here / kind / f"{frame.name}.exr" for kind in TRUTH} for frame in frames}
    missing = [path for maps in out.values() for path in maps.values() if not path.is_file()]
    if missing:
        raise InputError(
            f"{missing[0]}: not found ({len(missing)} of {4 * len(frames)} truth maps are missing); truth needs"
            f" {', '.join(TRUTH)} for every view, or no `truth` folder"
        )
    for frame in frames:
        radiance = here / "radiance" / f"{frame.name}.exr"
        if radiance.is_file():
            out[frame.name]["radiance"] = radiance
    return out
