"""Settings of what is made from the result: re-rendering, scores, files, page."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from workflow.settings.section import Section, word_or_count


class Render(Section):
    """Re-rendering of the views from the recovered scene."""

    samples: int = Field(16, ge=1)
    """Paths per pixel."""


class Metrics(Section):
    """Scores of the result."""

    views: Annotated[Literal["all"] | Annotated[int, Field(ge=1)], word_or_count("all", least=1)] = "all"
    """Views that are scored, spread evenly over those that were used; of the held-out ones as many again. `summary.json` says
    how many there were of how many."""
    lpips_vgg: bool = False
    """Also score the albedo of the result, of the base and of the first prediction with LPIPS on VGG16, raw and scaled, as in
    the paper. This needs weights (`snakemake --cores 1 results/weights/lpips_vgg.npz`) and triples the time of the stage."""


class Export(Section):
    """Files for other programs."""

    max_faces_glb: int = Field(200_000, ge=1000)
    """Largest number of faces, about; a larger mesh is simplified."""
    max_parts: int = Field(200, ge=2)
    """Largest number of meshes in `scene.glb`, `scene_unlit.glb`, `scene.usdc` and `mitsuba/`: the smallest pieces are joined to
    one. Lamps stay by themselves, however many they are."""
    texture_size: int = Field(2048, ge=128, le=16384)
    """Largest side of the textures, in texels; smaller where the photographs show less. `export.json` says what it costs."""
    normal_map: bool = False
    """Give parts that were simplified a normal map from the photographs' mesh, in `scene.glb`."""
    max_mb: float = Field(40.0, gt=0)
    """Largest size of `scene.glb` in MB: its textures become JPEG, and then smaller, until it fits."""


VIEWS_OF_REPORT = 6
"""Views that the report shows with all maps, from the worst to the best; each adds up to 2 MB to it."""


class Report(Section):
    """The page."""

    credit: str = ""
    """Line under the title, such as artist and licence."""


class Room(Section):
    """The page to walk in."""

    lightmap_size: int = Field(768, ge=32, le=4096)
    """Largest side of the light maps, in texels; smaller where many lamps would make the page too large. Time and size go with
    its square."""
    samples: int = Field(64, ge=1)
    """Paths for each texel of the light maps, for all lamps together."""
    max_mb: float = Field(25.0, ge=2)
    """Largest size of `room.html` in MB: light maps take at most half of it, and photographs become smaller, or are left out,
    until it fits."""
