"""Text for the last section of the report: what the files of a deliverable are, and what to do next with them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from typing import NamedTuple

from workflow.artifacts.store import chosen


class Kind(NamedTuple):
    """A kind of file: pattern of its name, what it is, and what opens it. Files of a `folder` are listed as one entry."""

    pattern: str
    what: str
    opens: str = ""
    folder: bool = False


KINDS = (
    Kind("room.html", "the room to walk through, under other light", "any browser, offline"),
    Kind("scene.glb", "mesh, materials and lamps (glTF 2.0)", "Blender, three.js, Windows 3D Viewer"),
    Kind("scene_unlit.glb", "the same with the room's light baked in (glTF 2.0, unlit)", "viewers without lighting"),
    Kind("scene.usdc", "mesh, materials, lamps and cameras (USD)", "Houdini, Omniverse, Blender, Apple devices"),
    Kind("blender_import.py", "sets up mesh, lamps, cameras, photographs and response", "blender --python blender_import.py"),
    Kind("mitsuba/scene.xml", "the room for Mitsuba 3, with up to 16 cameras", "mitsuba -m scalar_rgb scene.xml"),
    Kind("mitsuba/render.py", "renders that scene with the exact reflectance", "python render.py --help"),
    Kind("mitsuba/*", "meshes and programs of the Mitsuba scene", folder=True),
    Kind("maps/*", "re-rendering and material maps of each photograph, linear (EXR)", "Nuke, Blender, tev, any EXR viewer", True),
    Kind("photos/*", "the photographs that were used", "any viewer; EXR where they are linear", True),
    Kind("textures/*", "texture images of the mesh", "any viewer", True),
    Kind("objects.csv", "objects: colour, roughness, metallic, their intervals, what was seen", "a spreadsheet"),
    Kind("objects.parquet", "objects: the fitted numbers and their errors", "pandas, DuckDB"),
    Kind("emitters.parquet", "lamps: object, area, radiance and standard errors", "pandas, DuckDB"),
    Kind("camera_response.parquet", "response curve of the camera", "pandas, DuckDB"),
    Kind("camera_response.cube", "response curve of the camera as a 1D lookup table", "OCIO, Nuke, Resolve"),
    Kind("environment.exr", "light from outside, a latitude-longitude map", "any renderer"),
    Kind("cameras.json", "cameras of the photographs (nerfstudio's transforms.json)", "nerfstudio, blender_import.py"),
    Kind("verdict.json", "the verdict of this page, with all findings", "a text editor, jq"),
    Kind("plan.yaml", "what was modelled, what was left out, and why", "a text editor"),
    Kind("metrics.parquet", "scores of every view", "pandas, DuckDB"),
    Kind("timings.parquet", "time and memory of every job", "pandas, DuckDB"),
    Kind("manifest.json", "settings, versions, and the hash of every file", "a text editor"),
)  # fmt: skip
"""In the order of the report; a file takes the first entry that its name matches. What matches none is listed by its name."""


class Download(NamedTuple):
    """A line of the list: address relative to the page, name, what it is, what opens it, and the names of a folder's files."""

    href: str
    name: str
    what: str
    opens: str
    files: Sequence[str] = ()


def downloads(names: Iterable[str]) -> list[Download]:
    """Return the list of the files `names` of a deliverable, the page itself left out."""
    left, out = sorted(set(names) - {"report.html"}), []
    for kind in KINDS:
        own = [name for name in left if fnmatch(name, kind.pattern)]
        left = [name for name in left if name not in own]
        if kind.folder and own:
            folder = kind.pattern.rstrip("*")
            out.append(Download(folder, folder, f"{kind.what}: {len(own)} files", kind.opens, own))
        else:
            out += [Download(name, name, kind.what, kind.opens) for name in own]
    return out + [Download(name, name, "", "") for name in left]


class Command(NamedTuple):
    """A command, and what it is for."""

    purpose: str
    text: str


def commands(scene: str, quality: str, overrides: Sequence[tuple[str, str]], names: Iterable[str], plan: str) -> list[Command]:
    """Return the commands that go on from this result.

    Args:
        scene, quality: of this result.
        overrides: (component, words for the scene's file) of the decisions that can be overridden.
        names: files of the deliverable.
        plan: the plan of config/relight/ that stands for the relightings of a scene whose file lists none.
    """
    made, same = f"snakemake --cores 2 scenes/{scene}", chosen(quality)
    others = [other for other in ("draft", "standard", "paper") if other != quality]
    out = [
        Command(
            "see it under other light and from other cameras, which `relight` in the scene file lists,"
            f" or else `config/relight/{plan}.yaml`",
            f"snakemake --cores 2 relight/{scene}{same}",
        )
    ]
    out += [Command(f"make it again at quality {other}", f"{made} --config quality={other}") for other in others]
    out.append(Command("or in a time that you give, in seconds", f"{made} --config quality=600s"))
    if overrides:
        component, words = overrides[0]
        out.append(Command(f"decide about {component} yourself: add this to the scene file, then", f"{words}\n{made}{same}"))
    names = set(names)
    if "mitsuba/render.py" in names:
        out.append(Command("render it with Mitsuba and the exact reflectance", f"python scenes/{scene}/mitsuba/render.py"))
    if "blender_import.py" in names:
        out.append(
            Command(
                "open it in Blender with lamps, cameras and photographs", f"blender --python scenes/{scene}/blender_import.py"
            )
        )
    out.append(Command("check that no file has changed since", f"python -m workflow verify {scene}"))
    return out
