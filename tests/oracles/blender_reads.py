"""What Blender reads of an exported glTF file. This runs in a separate Python that has Blender's module `bpy`:

    python blender_reads.py REQUEST.json

REQUEST names `glb`, the folder `out`, and `views`: size, lens, shift, pixel aspect, and pose in Blender's world. It writes
`out/read.json` (cameras, emission and textures as imported), `out/<texture>.npy` (bytes as decoded, first row on top) and for
each view `out/<number>-colour.exr`, the base colour, and `out/<number>-surface.exr`, roughness and metallic, both with the depth.
Cycles looks them up itself at the middle of every pixel, at the nearest texel, with the texture coordinates and the colour
spaces of the import.
"""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

FILTER = 0.01
"""Width in pixels of the box over which Cycles places its one sample."""


def textures(out):
    """Keep the pictures, and tell their colour space."""
    found = {}
    for image in bpy.data.images:
        if not image.size[0]:
            continue
        pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
        image.pixels.foreach_get(pixels)
        pixels = pixels.reshape(image.size[1], image.size[0], 4)[::-1]
        np.save(out / f"{image.name}.npy", np.round(255 * pixels).astype(np.uint8))
        found[image.name] = image.colorspace_settings.name
    return found


def cameras():
    """Position, direction, right and fields of view of the cameras that glTF has."""
    found = {}
    for thing in bpy.data.objects:
        if thing.type != "CAMERA":
            continue
        pose, data = thing.matrix_world, thing.data
        found[thing.name] = {"pose": [list(row) for row in pose], "angle_x": data.angle_x, "angle_y": data.angle_y}
        found[thing.name]["fit"] = data.sensor_fit
    return found


def emission():
    """Colour times strength of each material that shines."""
    found = {}
    for material in bpy.data.materials:
        nodes = material.node_tree.nodes if material.use_nodes else []
        for node in (node for node in nodes if node.type == "BSDF_PRINCIPLED"):
            strength = node.inputs["Emission Strength"].default_value
            colour = [strength * value for value in node.inputs["Emission Color"].default_value[:3]]
            if max(colour) > 0:
                found[material.name] = colour
    return found


def show(quantities):
    """Let every material emit inputs of its surface: one colour, or up to three numbers."""
    for material in bpy.data.materials:
        if not material.use_nodes:
            continue
        nodes, links = material.node_tree.nodes, material.node_tree.links
        surface = next((node for node in nodes if node.type == "BSDF_PRINCIPLED"), None)
        output = next((node for node in nodes if node.type == "OUTPUT_MATERIAL" and node.is_active_output), None)
        if surface is None or output is None:
            continue
        for node in [node for node in nodes if node.label == "shown"]:
            nodes.remove(node)
        for node in nodes:
            if node.type == "TEX_IMAGE":
                node.interpolation = "Closest"
        emits = nodes.new("ShaderNodeEmission")
        emits.label = "shown"
        if len(quantities) == 1:
            connect(links, surface.inputs[quantities[0]], emits.inputs["Color"])
        else:
            joined = nodes.new("ShaderNodeCombineColor")
            joined.label = "shown"
            for name, socket in zip(quantities, joined.inputs, strict=False):
                connect(links, surface.inputs[name], socket)
            links.new(joined.outputs[0], emits.inputs["Color"])
        links.new(emits.outputs[0], output.inputs["Surface"])


def connect(links, source, target):
    if source.is_linked:
        links.new(source.links[0].from_socket, target)
    else:
        target.default_value = source.default_value


def settings():
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 1, False
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", FILTER
    scene.cycles.max_bounces = 0
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.use_persistent_data = True
    scene.world = bpy.data.worlds.new("dark")
    scene.world.use_nodes = True
    next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND").inputs["Strength"].default_value = 0
    scene.view_layers[0].use_pass_z = True
    picture = scene.render.image_settings
    picture.file_format, picture.color_depth, picture.exr_codec = "OPEN_EXR_MULTILAYER", "32", "ZIP"


def look(view, path):
    """Render one picture."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new("looks")
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", 36.0, view["lens"]
    data.shift_x, data.shift_y = view["shift"]
    data.clip_start, data.clip_end = 0.001, 1000
    thing = bpy.data.objects.new("looks", data)
    thing.matrix_world = Matrix(view["pose"])
    scene.collection.objects.link(thing)
    scene.camera = thing
    scene.render.resolution_x, scene.render.resolution_y = view["size"]
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = view["pixel_aspect"]
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    bpy.data.objects.remove(thing)


def main():
    request = json.loads(Path(sys.argv[1]).read_text())
    out = Path(request["out"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=request["glb"])
    bpy.context.view_layer.update()
    read = {"blender": bpy.app.version_string, "cameras": cameras(), "emission": emission(), "textures": textures(out)}
    read["meshes"] = sum(thing.type == "MESH" for thing in bpy.data.objects)
    (out / "read.json").write_text(json.dumps(read))
    settings()
    for suffix, quantities in (("colour", ["Base Color"]), ("surface", ["Roughness", "Metallic"])):
        show(quantities)
        for number, view in enumerate(request["views"]):
            look(view, out / f"{number}-{suffix}.exr")
    print("READ", flush=True)
    os._exit(0)  # Blender's own end may wait for ever in a module


main()
