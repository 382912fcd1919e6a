"""Render the scene next to this file with the exact reflectance of the method:

    python render.py [--view NAME] [--samples 256] [--size 640x480] [--output room.exr] [--variant llvm_ad_rgb]

Needs Mitsuba 3 (pip install mitsuba) and one of its JIT variants: `llvm_ad_rgb` on processors, with the library LLVM 16 or later
(DRJIT_LIBLLVM_PATH names it where it is not found), or `cuda_ad_rgb` on graphics cards. Change lamps in scene.xml, as for the
command `mitsuba`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from workflow.exporters import mitsuba_bsdf

PARAMETERS = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}
"""Parameters of the plug-in, and the textures that they are read from."""
PASS = 64
"""Samples a pixel between two messages."""


def exact_scene(text: str) -> str:
    """Return the text of scene.xml with the plug-in in place of what stands for it."""
    tree = ElementTree.fromstring(text)
    for bsdf in tree.iter("bsdf"):
        if bsdf.get("type") != "twosided":
            continue
        for child in list(bsdf):
            bsdf.remove(child)
        bsdf.set("type", mitsuba_bsdf.NAME)
        for parameter, texture in PARAMETERS.items():
            ElementTree.SubElement(bsdf, "ref", name=parameter, id=texture)
    return ElementTree.tostring(tree, encoding="unicode")


def load(folder: Path, **parameters: str) -> Any:
    """Load scene.xml of a folder with the plug-in, for the variant that is set; `parameters` of the file, such as spp."""
    import mitsuba as mi

    mitsuba_bsdf.register()
    resolver = mi.file_resolver()
    resolver.prepend(str(folder))
    return mi.load_string(exact_scene((folder / "scene.xml").read_text()), **parameters)


def rendered(scene: Any, sensor: Any, samples: int) -> Any:
    """Render a view in passes that have random numbers of their own, and say after each how long the rest will take."""
    import drjit as dr
    import mitsuba as mi

    total, started = 0.0, time.monotonic()
    for done in range(0, samples, PASS):
        count = min(PASS, samples - done)
        picture = mi.TensorXf(mi.render(scene, sensor=sensor, spp=count, seed=done))
        total = total + count * picture
        dr.eval(total)
        dr.sync_thread()
        left = (time.monotonic() - started) / (done + count) * (samples - done - count)
        print(f"{done + count} of {samples} samples a pixel, about {left:.0f} s left", file=sys.stderr)
    return total / samples


def main() -> None:
    import drjit as dr
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--view", default="", help="name of a photograph, without `view-`; the first one if it is left out")
    parser.add_argument("--samples", type=int, default=256, help="paths per pixel")
    parser.add_argument(
        "--size", default="", help="WIDTHxHEIGHT in pixels, such as 960x960; the size of the photographs if left out"
    )
    parser.add_argument("--output", type=Path, default=Path("room.exr"), help=".exr (linear) or .png")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba")
    asked = parser.parse_args()
    mi.set_variant(asked.variant)
    dr.set_thread_count(
        max(dr.thread_count(), 2)
    )  # with one, as on one core, Mitsuba waits for ever for the blocks of an EXR file
    size = dict(zip(("resx", "resy"), asked.size.lower().split("x"), strict=True)) if asked.size else {}
    scene = load(Path(__file__).resolve().parent, **size)
    sensors = {sensor.id().removeprefix("view-"): sensor for sensor in scene.sensors()}
    if asked.view and asked.view not in sensors:
        parser.error(f"no view {asked.view}; there are {', '.join(sensors)}")
    sensor = sensors[asked.view] if asked.view else scene.sensors()[0]
    mi.util.write_bitmap(str(asked.output), rendered(scene, sensor, asked.samples))
    print(asked.output)


if __name__ == "__main__":
    main()
