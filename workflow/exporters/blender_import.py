"""Sets up the recovered room in Blender (4.2 or newer): meshes with their lamps, the cameras of the photographs with the
photographs as background, the light from outside, and the camera's response and exposure as the view's curves.

    blender --python blender_import.py                       this file lies next to scene.glb
    blender --python blender_import.py -- /path/to/folder    or the folder that holds scene.glb and cameras.json

or open it in Blender's text editor and run it. What is in the file is not touched, but for the cube, lamp and camera of the
start. Frame i of the timeline is the camera of photograph i. Pictures look as the photographs do in the view itself (colour
management of the render settings); saved EXR files stay linear.
"""

import json
import math
import sys
from pathlib import Path

try:
    import bpy
    from mathutils import Matrix
except ImportError:
    bpy = None

CURVE_POINTS = 33
"""Points of the view's curves; Blender keeps few per curve, closer where the response bends."""


def load(folder):
    """Import everything and return the cameras, in the order of the photographs."""
    folder = Path(folder)
    document = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))
    if not bpy.data.filepath and set(bpy.data.objects.keys()) == {"Cube", "Light", "Camera"}:
        for thing in list(bpy.data.objects):
            bpy.data.objects.remove(thing)
    known = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(folder / "scene.glb"))
    for thing in [thing for thing in bpy.data.objects if thing not in known and thing.type == "CAMERA"]:
        bpy.data.objects.remove(thing)  # those of glTF have no shift
    collection = bpy.data.collections.new("Photographs")
    bpy.context.scene.collection.children.link(collection)
    cameras = [camera(folder, document, frame, collection) for frame in document["frames"]]
    world(folder, document["blender"].get("environment"), document["blender"]["world_to_blender"])
    timeline(cameras, document["frames"])
    curves = response(folder, document["blender"].get("response"))
    if cameras:
        names = [made.name for made in cameras]  # objects do not outlive an undo
        bpy.app.handlers.frame_change_post.append(lambda scene, *_: use(of_frame(scene, names), curves))
        use(cameras[0], curves)
    return cameras


def of_frame(scene, names):
    """Return the camera of the frame; Blender itself follows the markers only after its handlers have run."""
    return bpy.data.objects.get(names[min(max(scene.frame_current, 1), len(names)) - 1])


def camera(folder, document, frame, collection):
    """Make the camera of one photograph."""
    data = bpy.data.cameras.new(f"photo {frame['name']}")
    own = frame["blender"]
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = document["blender"]["sensor_width_mm"]
    data.lens = own["lens_mm"]
    data.shift_x, data.shift_y = own["shift"]
    data.clip_start = 0.01
    made = bpy.data.objects.new(data.name, data)
    made.matrix_world = Matrix(document["blender"]["world_to_blender"]) @ Matrix(frame["transform_matrix"])
    made["iif_size"] = [frame["w"], frame["h"]]
    made["iif_pixel_aspect"] = own["pixel_aspect"]
    made["iif_gain"] = frame["gain"]
    photo = folder / frame["file_path"]
    if photo.is_file():
        data.show_background_images = True
        background = data.background_images.new()
        background.image = bpy.data.images.load(str(photo), check_existing=True)
        background.alpha = 0.5
    collection.objects.link(made)
    return made


def timeline(cameras, frames):
    """Bind one camera to each frame."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, max(len(cameras), 1)
    for number, (made, frame) in enumerate(zip(cameras, frames, strict=True), 1):
        scene.timeline_markers.new(frame["name"], frame=number).camera = made
    scene.frame_set(1)


def world(folder, environment, turned):
    """Make the light from outside: a map where there is one, else its mean."""
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("Outside")
    scene.world.use_nodes = True
    background = next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND")
    radiance = (environment or {}).get("mean_radiance", [0.0, 0.0, 0.0])
    background.inputs["Color"].default_value = (*radiance, 1.0)
    if not environment or not environment.get("map") or not (folder / environment["map"]).is_file():
        return
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    picture, turn, where = (nodes.new(f"ShaderNode{name}") for name in ("TexEnvironment", "Mapping", "TexCoord"))
    picture.image = bpy.data.images.load(str(folder / environment["map"]), check_existing=True)
    picture.interpolation = "Closest"
    turn.inputs["Rotation"].default_value = Matrix(turned).to_3x3().transposed().to_euler()
    links.new(where.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], background.inputs["Color"])


def response(folder, name):
    """Read the response of the camera from its lookup table: (x, value) of each channel; None where photographs are linear."""
    if not name:
        return None
    rows = [line.split() for line in (folder / name).read_text().splitlines() if line[:1].isdigit() or line[:1] in "-."]
    values = [[float(v) for v in row] for row in rows]
    last = len(values) - 1
    chosen = [round(last * (i / (CURVE_POINTS - 1)) ** 2) for i in range(CURVE_POINTS)]  # closer near black
    return [[(k / last, values[k][c]) for k in sorted(set(chosen))] for c in range(3)]


def linear(value):
    """Decode an sRGB value: the standard view encodes what the curves give it."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def use(made, curves):
    """Show what the photograph of this camera would show: its size, its exposure, the response."""
    if made is None or "iif_gain" not in made:
        return
    scene = bpy.context.scene
    scene.camera = made
    scene.render.resolution_x, scene.render.resolution_y = (int(v) for v in made["iif_size"])
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = made["iif_pixel_aspect"]
    view = scene.view_settings
    view.view_transform, view.look, view.exposure, view.gamma = "Standard", "None", 0.0, 1.0
    gain = list(made["iif_gain"])
    if curves is None:
        view.use_curve_mapping = False
        view.exposure = math.log2(sum(gain) / 3)
        return
    view.use_curve_mapping = True
    mapping = view.curve_mapping
    mapping.initialize()
    mapping.extend = "HORIZONTAL"
    mapping.use_clip = False
    mapping.black_level, mapping.white_level = (0.0, 0.0, 0.0), [1.0 / g for g in gain]
    for channel, points in enumerate(curves):
        curve = mapping.curves[channel]
        while len(curve.points) > 2:
            curve.points.remove(curve.points[1])
        wanted = [(x, linear(max(y, 0.0))) for x, y in points]
        curve.points[0].location, curve.points[-1].location = wanted[0], wanted[-1]
        for x, y in wanted[1:-1]:
            curve.points.new(x, y)
        for point in curve.points:
            point.handle_type = "AUTO_CLAMPED"
    mapping.update()


if __name__ == "__main__":
    if bpy is None:
        sys.exit("blender_import.py runs inside Blender: blender --python blender_import.py")
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    beside = Path(bpy.data.filepath).parent if "__file__" not in globals() else Path(__file__).resolve().parent
    load(given[0] if given else beside)
