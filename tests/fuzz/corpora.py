"""Small valid inputs of every kind that is read, made by the tests' own builders, and what reads them as a run does."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from iif_core.errors import InputError
from tests.unit import own_scene as own
from tests.unit import scannetpp_scene as mini
from tests.unit import test_colmap, test_fipt
from tests.unit import test_raws as raw
from workflow import settings


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Attributes:
        files: that mutations change, relative to the folder of the case.
        build: writes the valid input into an empty folder.
        read: reads it, with the folder as working directory, as a run would; what it writes goes below the folder.
        weight: share of the cases, relative to the others.
    """

    files: tuple[str, ...]
    build: Callable[[Path], None]
    read: Callable[[], Any]
    weight: float = 1.0
    also: tuple[str, ...] = field(default=())


def written(names: list[str]) -> None:
    """Write a file for each name as a stage does, and read it again."""
    from workflow.artifacts.store import StageReader, StageWriter

    writer = StageWriter(Path("results/own/capture"), {"stage": "capture", "scene": "own", "fingerprint": "f"})
    for name in names:
        writer.json(f"photos/{name}.json", {})
    writer.finish()
    reader = StageReader(Path("results/own/capture"), "capture", "own")
    assert len(reader.names()) == len(names), "two views became one file"


def document(source: dict[str, Any], segmentation: dict[str, Any] | None = None, **capture: Any) -> dict[str, Any]:
    tree = {"source": source, "capture": {"width": 64, "height": 48, **capture}, "prior": {"kind": "retinex"}}
    tree |= {"segmentation": segmentation} if segmentation else {}
    return settings.dump(settings.SceneSettings.model_validate(tree))


def found(source: dict[str, Any], points: bool = False, **capture: Any) -> None:
    """Find and check a scene, read what it has of pictures and ids, and write under the names of its views."""
    import importlib

    from workflow import plugins
    from workflow.sources.folder_scene import images

    tree = document(source, **capture)
    module = importlib.import_module(plugins.implementation("source", source["kind"]))
    more = {"points": True} if points else {}
    finder = module.find_inputs if hasattr(module, "find_inputs") else None
    if finder is None:
        from workflow.sources.folder_scene.inputs import find_inputs as finder
    inputs = finder(tree["source"], tree["capture"], **more)
    written([frame.name for frame in inputs.cameras.frames])
    for frame in inputs.cameras.frames[:2]:
        assert np.isfinite(frame.matrix).all() and np.isfinite([frame.camera.fx, frame.camera.cx]).all()
        images.load_photo(frame.image, frame.turn)
        if frame.mask:
            images.load_mask(frame.mask, frame.turn, frame.mask_full)
        if frame.depth:
            images.load_depth(frame.depth, inputs.cameras.depth_unit)
        for path in (frame.truth or {}).values():
            images.load_map(path, 3)
        if frame.ids:
            inputs.load_ids(frame.ids, frame.turn)
    load_mesh(inputs.mesh, inputs.metres, inputs.of_vertices() if inputs.of_vertices else None, tree, inputs)
    if inputs.exposures:
        from workflow.sources.folder_scene import exposure

        exposure.read_given(inputs.exposures, [(f.name, f.file_path) for f in inputs.cameras.frames])


def load_mesh(path: Path, metres: float = 1.0, of_vertices: Any = None, tree: Any = None, inputs: Any = None) -> None:
    from workflow.sources.folder_scene import alignment, mesh

    found = mesh.load(path, metres, of_vertices)
    assert np.isfinite(found.vertices).all() and len(found.faces) and found.faces.max() < len(found.vertices)
    if inputs is not None:
        conventions = alignment.Conventions(inputs.cameras.axes, metres)
        centres = np.array([conventions.pose(frame)[:3, 3] for frame in inputs.cameras.frames])
        mesh.check_size(path, found, tree["source"].get("unit", "m"), metres, centres)


# ------------------------------------------------------------------------------------------------------------- builders


def folder_scene(home: Path) -> None:
    document = own.bare(home / "data", 3)
    for i, entry in enumerate(document["frames"]):
        entry["depth_file_path"], entry["mask_path"] = f"depth/{i}.png", f"masked/{i}.png"
        own.save_depth(home / "data" / entry["depth_file_path"], np.full((48, 64), 2.0))
        mini.save_mask((home / "data" / entry["mask_path"]), np.full((48, 64), 255, np.uint8))
    document |= {"k1": 0.01, "camera_model": "OPENCV", "applied_scale": 1.0, "applied_transform": np.eye(4)[:3].tolist()}
    own.write_transforms(home / "data", document)
    (home / "data/exposures.json").write_text(json.dumps({f"images/{i:03d}.png": 1.0 for i in range(3)}))


def released(home: Path) -> None:
    """The miniature of ScanNet++ with flat pictures, made without tracing a ray."""
    room = mini.room()
    views = [(pose, np.full((97, 146, 3), 0.5)) for pose in room.cameras(6)]
    kept = mini.geometry, mini.visible
    mini.geometry, mini.visible = (lambda room: None), (lambda shape, pose, points: (points - pose[:3, 3]) @ pose[:3, 2] > 0.05)
    try:
        mini.release(home / "data", room, views)
    finally:
        mini.geometry, mini.visible = kept


def colmap_scene(home: Path, binary: bool) -> None:
    released(home / "release")
    dslr = home / "release/data/dslr"
    place = home / "data/sparse/0"
    shutil.copytree(dslr / "colmap", place)
    shutil.copytree(dslr / "resized_images", home / "data/images")
    shutil.copy(home / "release/data/scans/mesh_aligned_0.05.ply", home / "data/mesh.ply")
    shutil.rmtree(home / "release")
    if binary:
        test_colmap.to_binary(place)
        for path in place.glob("*.txt"):
            path.unlink()


def fipt_scene(home: Path) -> None:
    kept = own.geometry, own.shoot
    own.geometry = lambda: None
    own.shoot = lambda geometry, pose, camera, **more: (
        np.full((camera.height, camera.width, 3), 0.4),
        np.ones((camera.height, camera.width)),
        np.zeros((camera.height, camera.width), int),
    )
    try:
        test_fipt.synthetic(home / "synthetic")
        test_fipt.real(home / "real")
    finally:
        own.geometry, own.shoot = kept


def meshes(home: Path) -> None:
    import trimesh

    vertices, faces, _ = own.room_mesh()
    own.save_mesh(home / "ascii.ply", vertices, faces, np.repeat([0, 1], 12))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(home / "binary.ply")
    mesh.export(home / "mesh.obj")
    scene = trimesh.Scene({"a": mesh, "b": trimesh.creation.box()})
    scene.export(home / "mesh.glb")


def inserts(home: Path) -> None:
    import trimesh
    from PIL import Image

    shutil.copy("config/relight/vase.glb", home / "vase.glb")
    box = trimesh.creation.box()
    picture = Image.fromarray(np.full((8, 8, 3), 128, np.uint8))
    box.visual = trimesh.visual.TextureVisuals(np.zeros((8, 2)), image=picture)
    box.export(home / "box.glb")
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(box)).items():
        (home / name).write_bytes(data)
    picture.save(home / "t.png")
    (home / "m.mtl").write_text("newmtl m\nKd 0.5 0.4 0.3\nmap_Kd t.png\n")
    corners = "\n".join(f"v {x} {y} {z}" for x, y, z in box.vertices)
    (home / "o.obj").write_text(
        f"mtllib m.mtl\n{corners}\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl m\n"
        + "\n".join(f"f {a + 1}/1 {b + 1}/2 {c + 1}/3" for a, b, c in box.faces)
        + "\n"
    )


def read_inserts() -> None:
    from workflow.relighting.inserts import load_insert
    from workflow.settings import relight_files

    for name in ("vase.glb", "box.glb", "model.gltf", "o.obj"):
        path = Path(name)
        entry = {"name": "a", "environment": "keep", "insert": [{"file": name, "name": None}]}
        relight_files([entry])
        found = load_insert(path)
        assert np.isfinite(found.corners).all() and len(found.corners)


def pictures(home: Path) -> None:
    import tifffile
    from PIL import Image

    rng = np.random.default_rng(0)
    values = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(values).save(home / "8.png")
    Image.fromarray(values).convert("P").save(home / "palette.png")
    Image.fromarray(values[..., 0].astype(np.uint16) * 257).save(home / "16.png")
    Image.fromarray(values).save(home / "a.jpg", exif=_exif())
    Image.fromarray(values).save(home / "progressive.jpg", progressive=True)
    for name, options in (("a.tif", {}), ("b.tif", {"compression": "zlib", "planarconfig": "separate"})):
        deep = values.astype(np.uint16) * 257
        tifffile.imwrite(home / name, np.moveaxis(deep, -1, 0) if options else deep, photometric="rgb", **options)
    Image.fromarray(values).save(home / "c.tif", compression="tiff_lzw")
    for name in ("a.webp", "a.avif", "a.bmp"):
        Image.fromarray(values).save(home / name)
    shutil.copy(Path(__file__).parents[1] / "unit/photograph.heic", home / "a.heic")
    large = np.tile(values / 255, (3, 3, 1))  # LibRaw takes less for no photograph
    raw.save_dng(home / "a.dng", large, opcodes={51009: raw.opcode_list(raw.gain_map(np.full((2, 3), 1.5)))})
    raw.save_dng(home / "b.dng", large, mosaic=False)
    channels = {c: values[..., i].astype(np.float32) / 255 for i, c in enumerate("RGB")}
    own.save_exr(home / "a.exr", channels)
    own.save_exr(home / "ids.exr", {"id": values[..., 0].astype(np.uint32)})
    shutil.copytree(home, home / "maps", ignore=shutil.ignore_patterns("maps"))


def _exif() -> Any:
    from PIL import Image

    exif = Image.Exif()
    exif[274] = 1
    return exif


def read_pictures() -> None:
    from workflow.intake.pictures import check_texture
    from workflow.priors import files
    from workflow.relighting.world import read_environment
    from workflow.sources.folder_scene import images

    problems = []
    for path in sorted(p for p in Path(".").iterdir() if p.suffix in images.EXTENSIONS):
        for number, read in enumerate(
            (
                images.header,
                check_texture,
                images.load_photo,
                images.load_ids,  # these may refuse what is a good photograph
                lambda path: images.load_mask(path) if path.suffix != ".exr" else images.load_map(path, 3),
                lambda path: images.load_depth(path, None),
                lambda path: files.load(path, 16, 12, True),
                lambda path: read_environment(path, np.array([0.0, 0, 1]), 0.0) if path.suffix == ".exr" else None,
            )
        ):
            try:
                read(path)
            except InputError as error:
                problems += [error] if number < 3 else []
    if problems:
        raise problems[0]


def responses(home: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    x = np.linspace(0, 1, 65)
    y = x**0.45
    np.save(home / "r.npy", np.stack([y] * 3))
    pyarrow.parquet.write_table(pyarrow.table({"x": x, "R": y, "G": y, "B": y}), home / "r.parquet")
    rows = "\n".join(f"{a!r},{b!r},{b!r},{b!r}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    (home / "r.csv").write_text(f"x,R,G,B\n{rows}\n")


def read_responses() -> None:
    from workflow.scene.response_file import read_response_file

    problems = []
    for name in ("r.npy", "r.parquet", "r.csv"):
        try:
            curve = read_response_file(Path(name))
            assert np.isfinite(curve(np.array([[0.5, 0.5, 0.5]]))).all()
        except InputError as error:
            problems.append(error)
    if problems:
        raise problems[0]


def artefacts(home: Path) -> None:
    from workflow.artifacts.store import StageWriter

    for stage in ("capture", "metrics"):
        facts = {"stage": stage, "scene": "own", "fingerprint": "f", "quality": "draft", "inputs": {}}
        writer = StageWriter(home / "results/own" / stage, facts)
        writer.exr("photos/000.exr", {"R": np.zeros((3, 4), np.float32)})
        writer.table("t.parquet", {"a": np.arange(3), "b": np.zeros((3, 2))})
        writer.json("j.json", {"a": [1, 2]})
        writer.finish()


def read_artefacts() -> None:
    """Also with manifests that somebody sealed again, as a stranger's results may be. What was changed must be named: a case is
    accepted only where the change left every byte as it was, or sealed another manifest."""
    from workflow.artifacts import manifest as manifests
    from workflow.artifacts.files import sha256_of
    from workflow.artifacts.sound import stage_faults
    from workflow.artifacts.store import StageReader
    from workflow.artifacts.verify import damaged

    named = [*damaged(Path(".")), *stage_faults(Path("results"), "own", "capture", "f")]
    folder = Path("results/own/capture")
    try:
        if not (folder / "manifest.json").is_file():
            raise OSError("a pipe is never at its end")
        listed = json.loads((folder / "manifest.json").read_bytes())
        for name, facts in listed["files"].items():
            if (folder / name).is_file():
                facts |= {"sha256": sha256_of(folder / name), "bytes": (folder / name).stat().st_size}
        manifests.write(folder / "manifest.json", listed)
    except (ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError):
        pass
    list(damaged(Path(".")))
    stage_faults.cache_clear()
    stage_faults(Path("results"), "own", "capture", "f")
    reader = StageReader(folder, "capture", "own")
    for name in reader.names():
        read = {".exr": reader.exr, ".parquet": reader.table, ".json": reader.json}.get(Path(name).suffix, reader.path)
        try:
            read(name)
        except InputError:
            pass
    if any(named):
        raise InputError(next(filter(None, named)))


SCENE = {
    "source": {"kind": "folder", "path": "data/own", "unit": "m"},
    "capture": {"width": 64, "height": 48, "views": 4, "exposure": "given"},
    "prior": {"kind": "retinex", "samples": 2},
    "segmentation": {"kind": "geometry"},
    "affines": {"iterations": 60, "response": "srgb"},
    "relight": [{"name": "evening", "emitters": 0.5, "sphere": {"center": [1, 1, 1], "radius": 0.1}, "exposure": 2}],
}
TABLE = (
    "name\tsource\tpath\tbase\toverrides\nown\t\t\t\t\nb\tbuiltin\t\town\tcapture.views=3;prior.samples=2\nc\t\tdata/x\town\t\n"
)


def settings_files(home: Path) -> None:
    (home / "config/scenes").mkdir(parents=True)
    (home / "config/relight").mkdir(parents=True)
    (home / "config/scenes/own.yaml").write_text(yaml.safe_dump(SCENE, sort_keys=False))
    (home / "config/relight/evening.yaml").write_text(
        yaml.safe_dump({"title": "x", "relight": [{"name": "a", "lamps": {"bulb": 0.3}, "camera": {"views": ["000"]}}]})
    )
    (home / "config/batch.tsv").write_text(TABLE)


def read_settings() -> None:
    from workflow.runtime.fingerprint import raw_inputs
    from workflow.settings.relight import require_relighting

    problems = []
    for scene in ("own", "own--relight-evening-s0"):
        try:
            tree = settings.dump(settings.load(scene))
            json.dumps(tree, allow_nan=False)
            require_relighting(tree, scene)
            for stage in ("capture", "prior", "segmentation", "relight", "emission"):
                with contextlib.suppress(InputError):  # files that the settings name are not there
                    raw_inputs(stage, tree)
        except InputError as error:
            problems.append(error)
    if problems:
        raise problems[0]


def read_table() -> None:
    from workflow.settings import batch_table

    problems = []
    for line in batch_table.read_table():
        try:
            settings.load(line.name)
        except InputError as error:
            problems.append(error)
    if problems:
        raise problems[0]


XML = """<?xml version="1.0"?>
<scene version="3.0.0">
  <default name="spp" value="4"/><default name="folder" value="parts"/>
  <sensor type="perspective"><float name="fov" value="70"/>
    <transform name="to_world"><lookat origin="1,1,1.5" target="3,2,1.2" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>
  <include filename="more.xml"/>
  <texture type="bitmap" id="t"><string name="filename" value="$folder/t.png"/></texture>
  <shape type="ply"><string name="filename" value="$folder/m.ply"/>
    <bsdf type="diffuse"><ref id="t" name="reflectance"/></bsdf></shape>
</scene>
"""


def mitsuba_scene(home: Path) -> None:
    (home / "scene.xml").write_text(XML)
    (home / "more.xml").write_text('<scene version="3.0.0"><shape type="cube"/></scene>\n')
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(home / "parts/m.ply", vertices, faces)
    own.save_png(home / "parts/t.png", np.full((4, 4, 3), 0.5))


def read_mitsuba_scene() -> None:
    from lab.sources import mitsuba

    mitsuba.raw_inputs({"source": {"path": "scene.xml"}})


def load_mitsuba_scene() -> None:
    """Load as stage `capture` first does: in a separate process, which Mitsuba may end. An error there is raised here."""
    from lab.mitsuba_scene import scene, trial

    read_mitsuba_scene()
    told, tell = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            scene.load(Path("scene.xml"))
        except BaseException as error:
            os.write(tell, f"{type(error).__name__}\n{error}".encode(errors="replace")[:2000])
        os._exit(0)
    os.close(tell)
    with os.fdopen(told, "rb") as file:
        kind, _, said = file.read().decode(errors="replace").partition("\n")
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == -signal.SIGXCPU:
        os.kill(os.getpid(), signal.SIGXCPU)  # it hangs, which is no crash
    trial.judge(Path("scene.xml"), code)
    if kind:
        raise {"InputError": InputError, "MemoryError": MemoryError}.get(kind, RuntimeError)(said)


def masks(home: Path) -> None:
    folder_scene(home)
    (home / "data/masks").mkdir()
    for i in range(3):
        mini.save_mask(home / f"data/masks/{i:03d}.png", np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) // 600)


def read_masks() -> None:
    from workflow.segmentations.masks import raw_inputs
    from workflow.sources.folder_scene import images

    tree = document({"kind": "folder", "path": "data"}, {"kind": "masks"})
    for path in raw_inputs(tree):
        if "masks" in path.parts:
            images.load_ids(path)


def weights(home: Path) -> None:
    import struct

    header = json.dumps({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}).encode()
    (home / "model.safetensors").write_bytes(struct.pack("<Q", len(header)) + header + bytes(8))
    (home / "config.json").write_text('{"model_type": "sam2"}')


def read_weights() -> None:
    from workflow.models.checkpoint import tensor_header

    tensor_header(Path("model.safetensors"))


_FOLDER = {"kind": "folder", "path": "data"}
TARGETS: dict[str, Target] = {
    "transforms.json": Target(("data/transforms.json", "data/exposures.json"), folder_scene, lambda: found(_FOLDER), 2),
    "transforms.json, undo": Target(
        ("data/transforms.json",), folder_scene, lambda: found({**_FOLDER, "applied_transform": "undo"}), 0.5
    ),
    "COLMAP text": Target(
        ("data/sparse/0/cameras.txt", "data/sparse/0/images.txt", "data/sparse/0/points3D.txt"),
        lambda home: colmap_scene(home, False),
        lambda: found(_FOLDER, True),
    ),
    "COLMAP binary": Target(
        ("data/sparse/0/cameras.bin", "data/sparse/0/images.bin", "data/sparse/0/points3D.bin"),
        lambda home: colmap_scene(home, True),
        lambda: found(_FOLDER, True),
    ),
    "ScanNet++": Target(
        (
            "data/dslr/nerfstudio/transforms.json",
            "data/dslr/train_test_lists.json",
            "data/scans/segments.json",
            "data/scans/segments_anno.json",
            "data/dslr/colmap/images.txt",
        ),
        released,
        lambda: found({"kind": "scannetpp", "path": "data"}, True),
    ),
    "FIPT real": Target(
        ("real/cam.txt", "real/K_list.txt", "real/scene.obj", "real/segmentation/000.exr"),
        fipt_scene,
        lambda: found({"kind": "fipt", "path": "real"}, dynamic_range="hdr"),
        0.5,
    ),
    "FIPT synthetic": Target(
        (
            "synthetic/train/transforms.json",
            "synthetic/train/Image/cam/exposure.npy",
            "synthetic/train/Image/cam/crf.npy",
            "synthetic/train/IndexMA/object_ids.txt",
            "synthetic/train/IndexMA/000_0001.exr",
        ),
        fipt_scene,
        lambda: found({"kind": "fipt", "path": "synthetic"}, dynamic_range="ldr"),
        0.5,
    ),
    "PLY text": Target(("ascii.ply",), meshes, lambda: load_mesh(Path("ascii.ply"))),
    "PLY binary": Target(("binary.ply",), meshes, lambda: load_mesh(Path("binary.ply"))),
    "OBJ": Target(("mesh.obj",), meshes, lambda: load_mesh(Path("mesh.obj"))),
    "GLB": Target(("mesh.glb",), meshes, lambda: load_mesh(Path("mesh.glb"))),
    "meshes put in": Target(
        ("vase.glb", "box.glb", "model.gltf", "o.obj", "m.mtl", "t.png", "gltf_buffer_0.bin"), inserts, read_inserts
    ),
    "PNG": Target(("8.png", "16.png", "palette.png"), pictures, read_pictures),
    "JPEG": Target(("a.jpg", "progressive.jpg"), pictures, read_pictures),
    "EXR": Target(("a.exr", "ids.exr"), pictures, read_pictures),
    "HEIF": Target(("a.heic", "a.avif"), pictures, read_pictures),
    "TIFF": Target(("a.tif", "b.tif", "c.tif", "a.webp", "a.bmp"), pictures, read_pictures),
    "raw": Target(("a.dng", "b.dng"), pictures, read_pictures),
    "response": Target(("r.npy", "r.parquet", "r.csv"), responses, read_responses),
    "manifests": Target(
        (
            "results/own/capture/manifest.json",
            "results/own/capture/t.parquet",
            "results/own/capture/photos/000.exr",
            "results/own/capture/j.json",
            "results/own/metrics/manifest.json",
        ),
        artefacts,
        read_artefacts,
    ),
    "scene files": Target(("config/scenes/own.yaml",), settings_files, read_settings, 2),
    "relight plans": Target(("config/relight/evening.yaml",), settings_files, read_settings),
    "batch.tsv": Target(("config/batch.tsv",), settings_files, read_table),
    "Mitsuba XML": Target(("scene.xml", "more.xml", "parts/m.ply", "parts/t.png"), mitsuba_scene, read_mitsuba_scene),
    "Mitsuba scene": Target(("scene.xml", "parts/m.ply", "parts/t.png"), mitsuba_scene, load_mitsuba_scene, 0.5),
    "masks": Target(("data/masks/000.png", "data/masks/001.png"), masks, read_masks, 0.5),
    "safetensors": Target(("model.safetensors",), weights, read_weights, 0.5),
}
