"""Source `photographs`: a textured room of known size, photographed by known cameras, of which the program sees the pictures."""

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.distance import pdist

from iif_core.camera.distortion import Pinhole
from iif_core.camera.pinhole import look_at
from iif_core.surface.triangles import face_geometry
from tests.errors import misset, refused
from tests.unit import own_scene as own
from workflow import settings
from workflow.artifacts import StageReader
from workflow.reconstruction import cameras as reconstruction
from workflow.reconstruction.cameras import Sparse, picture_of
from workflow.reconstruction.files import transforms_json
from workflow.registry import STAGES
from workflow.runtime import fingerprint
from workflow.runtime.job import run_stage
from workflow.sources import photographs
from workflow.sources.folder_scene import frames, images, inputs, transforms
from workflow.stages.reconstruction import scale_notes

SIZE = np.array([4.0, 3.0, 2.6])
CAMERA = Pinhole(260.0, 260.0, 160.0, 120.0, 320, 240)
RNG = np.random.default_rng(5)
WALLS = [  # of each side, fine and coarse texture, 1.25 cm a texel
    np.clip(0.5 + sum(gaussian_filter(RNG.normal(size=(400, 400)), w, mode="wrap") * 0.16 * w for w in (1, 3, 8)), 0.05, 1.0)
    for _ in range(6)
]


def shot(pose):
    """The room (0 to SIZE) as a camera sees it: picture in [0, 1] and z-depth."""
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore"):
        t = np.where(rays > 0, (SIZE - eye) / rays, -eye / rays)
    axis = t.argmin(-1)
    depth = t.min(-1)
    side = 2 * axis + np.take_along_axis(rays > 0, axis[..., None], -1)[..., 0]
    points = eye + depth[..., None] * rays
    picture = np.zeros(depth.shape)
    for number in range(6):
        own_pixels = side == number
        flat = np.delete(points[own_pixels], number // 2, axis=1) / 0.0125
        picture[own_pixels] = map_coordinates(WALLS[number], flat.T, order=1, mode="grid-wrap")
    return picture, depth


def poses(count):
    angle = 2 * np.pi * np.arange(count) / count
    eyes = np.stack([2 + 1.1 * np.cos(angle), 1.5 + 0.7 * np.sin(angle), 1.4 + 0.2 * np.sin(3 * angle)], 1)
    ats = np.stack([2 - 1.5 * np.cos(angle + 0.3), 1.5 - 1.2 * np.sin(angle + 0.3), 1.3 + 1.1 * np.sin(2 * angle)], 1)
    return [look_at(eye, at, (0, 0, 1)) for eye, at in zip(eyes, ats, strict=True)]


def sparse_of(count, names=None):
    """What the search for cameras would find, were it exact: points are what pixels on a grid show."""
    every = poses(count)
    world_to = np.array([np.linalg.inv(pose)[:3] for pose in every])
    grid = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 9), np.linspace(0.1, 0.9, 9), indexing="ij"), -1).reshape(-1, 2)
    points = []
    for axis in range(3):
        for end in (0.0, 1.0):
            points.append(np.insert(grid, axis, end, axis=1) * SIZE)
    points = np.concatenate(points)
    point, view = [], []
    for i, camera in enumerate(world_to):
        local = points @ camera[:, :3].T + camera[:, 3]
        x, y = CAMERA.fx * local[:, 0] / local[:, 2] + CAMERA.cx, CAMERA.fy * local[:, 1] / local[:, 2] + CAMERA.cy
        seen = np.flatnonzero((local[:, 2] > 0.1) & (x > 0) & (x < CAMERA.width) & (y > 0) & (y < CAMERA.height))
        point += seen.tolist()
        view += [i] * len(seen)
    names = names or [f"{i:03d}.png" for i in range(count)]
    return Sparse(names, [CAMERA] * count, np.zeros(count), world_to, points, np.array(point), np.array(view), {})


def photographed(folder, count):
    folder.mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(poses(count)):
        own.save_png(folder / f"{i:03d}.png", np.repeat(shot(pose)[0][..., None], 3, -1))


def scene(root, **source):
    """A working directory with a scene of photographs alone; its folder."""
    (root / "config/scenes").mkdir(parents=True, exist_ok=True)
    tree = {
        "source": {"kind": "photographs", "path": "data/own", **source},
        "capture": {"width": 64, "height": 48, "views": 100},
        "prior": {"kind": "retinex"},
    }
    (root / "config/scenes/own.yaml").write_text(yaml.safe_dump(tree))
    return root / "data/own"


# -------------------------------------------------------------------------------------------------------- the whole stage


def check_room(root, count, tolerance):
    """The mesh lies on the walls, stands upright on the floor, and cameras see it at the right distance."""
    made = StageReader(root / "results/own/reconstruction", "reconstruction", "own")
    facts = made.json("reconstruction.json")
    assert facts["photographs"] == count and not facts["left_out"]
    from workflow.sources.folder_scene import mesh

    found = mesh.load(made.path("mesh.ply"), 1.0)
    middle, area = found.vertices[found.faces].mean(1), face_geometry(found.vertices, found.faces)[1]
    low, high = (np.array([np.quantile(middle[:, i], q) for i in range(3)]) for q in (0.02, 0.98))
    np.testing.assert_allclose(np.sort(high - low), np.sort(SIZE), atol=3 * tolerance)
    assert high[2] - low[2] == pytest.approx(SIZE[2], abs=3 * tolerance) and abs(low[2]) < 2 * tolerance
    apart = np.minimum(np.abs(middle - low), np.abs(middle - high)).min(1)
    assert np.median(apart) < tolerance
    whole = 2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[0] * SIZE[2])
    assert 0.9 * whole < area.sum() < 1.35 * whole  # walls overlap with what was found
    return made, facts


def test_known_cameras_give_the_room(tmp_path, monkeypatch):
    """From exact cameras in a frame and unit of their own, which stands in for the search."""
    photographed(scene(tmp_path, room_height=2.6, detail=128, registration="off"), 20)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    exact = sparse_of(20).placed(turn, np.array([3.0, -1.0, 2.0]), 0.37)
    monkeypatch.setattr("workflow.stages.reconstruction.find_cameras", lambda *given: exact)
    capture = own.run(tmp_path, "reconstruction", "capture")
    made, facts = check_room(tmp_path, 20, 0.03)
    assert facts["scale"]["metres_per_unit"] == pytest.approx(1 / 0.37, rel=0.01)
    assert Image.open(made.path("overview.png")).width > 500
    assert len(capture.views) == 20
    for view, pose in zip(capture, poses(20), strict=True):
        depth, face = capture.gbuffer(view)
        _, truth = shot(pose)
        shown = truth.reshape(48, 5, 64, 5).mean((1, 3))
        assert (face >= 0).mean() > 0.98
        assert np.median(np.abs(depth / shown - 1)[face >= 0]) < 0.02
    assert any("source.room_height" in note for note in capture.facts["notes"])


@pytest.mark.parametrize(
    ("height", "held", "is_odd"), [(2.6, 1.4, False), (8.5, 4.7, True), (0.8, 0.45, True), (6.0, 2.4, False)]
)
def test_a_height_in_feet_is_doubted(height, held, is_odd):
    (said, *more) = scale_notes("room_height", height, held, None)
    assert f"{height:g} m" in said and f"{held:g} m" in said
    assert [note.startswith("WARNING") and "source.room_height" in note for note in more] == [True] * is_odd


@pytest.mark.long
def test_photographs_alone_give_the_room(tmp_path):
    """The same with the real search for cameras."""
    photographed(scene(tmp_path, room_height=2.6, detail=160), 24)
    own.run(tmp_path, "reconstruction", "capture")
    made, _ = check_room(tmp_path, 24, 0.05)
    document = json.loads(made.path("transforms.json").read_text())
    focal = np.array([frame["fl_x"] for frame in document["frames"]])
    np.testing.assert_allclose(focal, CAMERA.fx, rtol=0.02)
    found = np.array([frame["transform_matrix"] for frame in document["frames"]])[:, :3, 3]
    truth = np.array([pose[:3, 3] for pose in poses(24)])
    np.testing.assert_allclose(pdist(found), pdist(truth), atol=0.05)


@pytest.mark.long
def test_photographs_of_nothing_are_refused(tmp_path):
    folder = scene(tmp_path)
    folder.mkdir(parents=True)
    for i in range(4):
        own.save_png(folder / f"{i}.png", np.full((120, 160, 3), 0.5))
    with refused("data/own", "0 of 4", "texture"):
        with own.working_in(tmp_path):
            run_stage("reconstruction", "own", "draft", 2)


def test_a_camera_that_others_contradict_is_left_out(tmp_path, monkeypatch):
    photographed(scene(tmp_path, detail=128, camera_height=1.4), 16)
    exact = sparse_of(16)
    wrong = exact.camera_from_world.copy()
    wrong[4] = np.linalg.inv(look_at((3.5, 0.4, 2.2), (0.5, 2.5, 0.3), (0, 0, 1)))[:3]
    moved = Sparse(*[wrong if name == "camera_from_world" else getattr(exact, name) for name in Sparse.__dataclass_fields__])
    monkeypatch.setattr("workflow.stages.reconstruction.find_cameras", lambda *given: moved)
    with own.working_in(tmp_path):
        run_stage("reconstruction", "own", "draft", 2)
    made = StageReader(tmp_path / "results/own/reconstruction", "reconstruction", "own")
    facts = made.json("reconstruction.json")
    assert "004.png" in facts["left_out"] and facts["photographs"] >= 13
    assert facts["scale"]["from"] == "camera_height" and any("guessed" in note for note in facts["notes"])
    assert all(frame["file_path"] != "004.png" for frame in json.loads(made.path("transforms.json").read_text())["frames"])


# ---------------------------------------------------------------------------------------------------------------- its parts


def test_cameras_move_with_the_frame():
    exact = sparse_of(5)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = exact.placed(turn, np.array([1.0, 2.0, 3.0]), 2.0)
    np.testing.assert_allclose(moved.world_from_camera[:, :3, 3], 2 * (exact.world_from_camera[:, :3, 3] @ turn.T + [1, 2, 3]))
    for before, after in zip(exact.camera_from_world, moved.camera_from_world, strict=True):
        local = exact.points @ before[:, :3].T + before[:, 3]
        np.testing.assert_allclose(moved.points @ after[:, :3].T + after[:, 3], 2 * local, atol=1e-9)
    fewer = moved.without([1, 3], "why")
    assert fewer.names == ["000.png", "002.png", "004.png"] and fewer.left_out == {"001.png": "why", "003.png": "why"}
    for new, old in enumerate((0, 2, 4)):
        np.testing.assert_array_equal(fewer.point[fewer.view == new], moved.point[moved.view == old])


def test_cameras_are_written_as_nerfstudio_has_them(tmp_path):
    photographed(tmp_path / "images", 4)
    (tmp_path / "transforms.json").write_bytes(transforms_json(sparse_of(4, [f"images/{i:03d}.png" for i in range(4)])))
    tree = own.settings_of(tmp_path)
    listed = transforms.read(tree["source"], tree["capture"])
    for frame, pose in zip(listed.frames, poses(4), strict=True):
        np.testing.assert_allclose(frame.matrix @ np.diag([1, -1, -1, 1]), pose, atol=1e-12)
        assert frame.camera == CAMERA


def test_pictures_are_reduced_with_their_cameras(tmp_path):
    photographed(tmp_path, 1)
    small = picture_of(tmp_path, sparse_of(1), 0, 160, "file")
    assert small.grey.shape == (120, 160)
    np.testing.assert_allclose(small.intrinsics, [[130, 0, 80], [0, 130, 60], [0, 0, 1]])
    np.testing.assert_allclose(small.grey, shot(poses(1)[0])[0].reshape(120, 2, 160, 2).mean((1, 3)), atol=0.01)


def test_working_copies_keep_what_exif_says_of_the_lens_and_stand_upright(tmp_path):
    """One folder for each camera: another size, model or focal length is another one."""
    exif = Image.Exif()
    exif[274], exif[272] = 6, "Telephone"
    exif.get_ifd(0x8769)[41989] = 26
    values = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    for name, own_exif in (("a.jpg", exif), ("b.jpg", exif), ("c.jpg", Image.Exif())):
        Image.fromarray(values).save(tmp_path / name, exif=own_exif, quality=95, subsampling=0)
    known: Counter = Counter()
    sizes = [
        reconstruction._working_copy(tmp_path / n, tmp_path / "w", i, known, "file")
        for i, n in enumerate(("a.jpg", "b.jpg", "c.jpg"))
    ]
    assert sizes == [(30, 40), (30, 40), (40, 30)]
    written = sorted(path.relative_to(tmp_path / "w").as_posix() for path in (tmp_path / "w").rglob("*.jpg"))
    assert written == ["000/000000.jpg", "000/000001.jpg", "001/000002.jpg"]
    with Image.open(tmp_path / "w/000/000000.jpg") as copy:
        assert copy.getexif()[274] == 1 and copy.getexif().get_ifd(0x8769)[41989] == 26
        expected = images.TURNS[6](values)
        assert np.abs(np.asarray(copy, int) - expected).mean() < 12


def test_only_scenes_of_photographs_alone_need_the_stage(tmp_path):
    root = tmp_path
    photographed(scene(root), 3)
    own.project(root, scene="other")
    own.bare(root / "data/other")
    with own.working_in(root):
        alone, other = (fingerprint.parsed(fingerprint.resolved(name, "draft")) for name in ("own", "other"))
        assert STAGES["capture"].reads(alone) == ("reconstruction",) and STAGES["capture"].reads(other) == ()
        assert STAGES["plan"].reads(alone) == ("capture",)
        assert "reconstruction" in fingerprint.needed("own", "draft") and "reconstruction" not in fingerprint.needed(
            "other", "draft"
        )
        assert fingerprint.missing_stages("own", "draft")[0] == "reconstruction"
        made, before = (fingerprint.fingerprint(stage, "own", "draft") for stage in ("reconstruction", "capture"))
    scene(root, alignment="warn", close_holes=0.2)
    with own.working_in(root):  # what the capture alone reads does not find cameras again
        assert fingerprint.fingerprint("reconstruction", "own", "draft") == made
        assert fingerprint.fingerprint("capture", "own", "draft") != before
    scene(root)
    photographed(root / "data/own", 4)  # one more photograph changes everything
    with own.working_in(root):
        assert fingerprint.fingerprint("capture", "own", "draft") != before


def test_photographs_are_found_in_folders_and_masks_are_none(tmp_path):
    for name in ("b/2.png", "a/1.JPG", "masks/a/1.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("txt"):
            (tmp_path / name).write_text("x")
        else:
            Image.new("RGB", (8, 6)).save(tmp_path / name)
    Image.new("RGB", (8, 6)).save(tmp_path / "c.png")
    (tmp_path / "._c.png").write_bytes(b"of another system")
    assert photographs.chosen(tmp_path, 10) == ["a/1.JPG", "b/2.png", "c.png"]
    Image.new("RGB", (8, 6)).save(tmp_path / "a/1.webp")
    with refused("1.JPG", "1.webp", "two formats"):
        photographs.chosen(tmp_path, 10)
    (tmp_path / "a/1.webp").unlink()
    assert photographs.chosen(tmp_path, 2) == ["a/1.JPG", "c.png"]
    (tmp_path / "c.png").unlink()
    with refused(tmp_path, "2 photographs", "3"):
        photographs.chosen(tmp_path, 10)
    (tmp_path / "c.png").write_bytes(b"no picture")
    with refused("c.png"):
        photographs.chosen(tmp_path, 10)


def test_a_whole_disk_is_no_scene(tmp_path, monkeypatch):
    (tmp_path / "a/b").mkdir(parents=True)
    for i in range(3):
        Image.new("RGB", (8, 6)).save(tmp_path / f"a/b/{i}.png")
    monkeypatch.setattr(frames, "MOST_FILES", 5)  # two folders and three files
    assert len(photographs.chosen(tmp_path, 10)) == 3
    (tmp_path / "a/notes.txt").touch()
    with refused(tmp_path, "more than 5"):
        photographs.chosen(tmp_path, 10)
    with refused(tmp_path, "more than 5"):
        inputs.find_inputs({"path": str(tmp_path), "unit": "m", "cameras": None}, {}, False)


def test_a_height_that_no_room_has_is_refused():
    with misset("source.photographs.room_height", "less_than"):
        settings.SceneSettings.model_validate({"source": {"kind": "photographs", "path": "x", "room_height": 260}})


def test_range_and_kind_of_photographs_are_checked_before_work(tmp_path):
    folder = scene(tmp_path)
    photographed(folder, 3)
    document = settings.dump(settings.SceneSettings.model_validate({"source": {"kind": "photographs", "path": str(folder)}}))
    assert len(photographs.raw_inputs(document)) == 3
    with refused("hdr"):
        photographs.raw_inputs(document | {"capture": document["capture"] | {"dynamic_range": "hdr"}})


def test_exif_of_any_length_fits_into_a_working_copy(tmp_path):
    exif = Image.Exif()
    exif[274] = 1
    exif.get_ifd(0x8769)[37500] = bytes(80_000)
    exif.get_ifd(0x8769)[41989] = 28
    Image.fromarray(np.full((30, 40, 3), 90, np.uint8)).save(tmp_path / "a.png", exif=exif)
    reconstruction._working_copy(tmp_path / "a.png", tmp_path / "w", 0, Counter(), "file")
    with Image.open(tmp_path / "w/000/000000.jpg") as copy:
        assert copy.getexif().get_ifd(0x8769)[41989] == 28


@pytest.mark.long
def test_photographs_of_little_contrast_are_placed_by_fainter_features(tmp_path, monkeypatch):
    """A quarter of the contrast of the other tests, in 8 bits: COLMAP's own features are too few."""
    photographed(tmp_path / "p", 12)
    names = sorted(path.name for path in (tmp_path / "p").glob("*.png"))
    for name in names:
        levels = np.asarray(Image.open(tmp_path / "p" / name), np.float64)
        Image.fromarray(np.rint(128 + 0.25 * (levels - levels.mean())).astype(np.uint8)).save(tmp_path / "p" / name)
    assert len(reconstruction.find_cameras(tmp_path / "p", names, "file", lambda *_: None).names) >= 6
    monkeypatch.setattr(reconstruction, "FAINT", 0.0067)
    with refused("0 of 12 photographs hang together"):
        reconstruction.find_cameras(tmp_path / "p", names, "file", lambda *_: None)


@pytest.mark.parametrize(
    ("sizes", "kept", "tries"),
    [
        ([[18], [20]], 18, 1),  # nearly all: nothing else is tried
        ([[11, 7], [17, 3]], 17, 2),
        ([[], [15]], 15, 2),
        ([[13], [12, 8]], 13, 2),  # the better of the two
        ([[9], [8]], 0, 2),
    ],
)
def test_fainter_features_are_looked_for_where_too_few_photographs_hang_together(tmp_path, monkeypatch, sizes, kept, tries):
    pycolmap, asked = pytest.importorskip("pycolmap"), []

    def group(count):
        return SimpleNamespace(num_reg_images=lambda: count, num_points3D=lambda: 5, images={})

    def mapped(*_):
        return dict(enumerate(group(count) for count in sizes[len(asked) - 1]))

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapped)
    monkeypatch.setattr(reconstruction, "_working_copy", lambda *_: (8, 6))
    monkeypatch.setattr(reconstruction, "_compare", lambda database, work, count, faint, progress: asked.append(faint))
    monkeypatch.setattr(reconstruction, "_plain", lambda model, names, sizes: model.num_reg_images())
    names = [f"{i}.jpg" for i in range(20)]
    if kept:
        assert reconstruction.find_cameras(tmp_path, names, "file", lambda *_: None) == kept
    else:
        with refused("9 of 20 photographs hang together", "at least 10"):
            reconstruction.find_cameras(tmp_path, names, "file", lambda *_: None)
    assert asked == [False, True][:tries]


def test_photographs_that_fall_apart_are_told_by_groups():
    names = [f"{i}.jpg" for i in range(40)]

    def group(*places):
        images = {i: SimpleNamespace(name=f"000/{i:06d}.jpg", has_pose=True) for i in places}
        return SimpleNamespace(images=images | {99: SimpleNamespace(name="000/000039.jpg", has_pose=False)})

    told = reconstruction._told([group(0, 1, 2, 7), group(4, 5)], names)
    assert "2 groups: 0.jpg to 2.jpg, 7.jpg; 4.jpg to 5.jpg." in told and "39.jpg" not in told
    assert "These do: 3.jpg." in reconstruction._told([group(3)], names) and "These do" not in reconstruction._told([], names)
    many = reconstruction.ranges(range(0, 40, 2), names)
    assert many.endswith("14.jpg, 12 more") and reconstruction.ranges({0, 1}, names) == "0.jpg to 1.jpg"


@pytest.mark.long
def test_the_same_photographs_give_the_same_cameras_also_in_pairs_of_neighbours(tmp_path, monkeypatch):
    photographed(tmp_path / "p", 12)
    names = [f"{i:03d}.png" for i in range(12)]
    first, second = (reconstruction.find_cameras(tmp_path / "p", names, "file", lambda *_: None) for _ in range(2))
    np.testing.assert_array_equal(first.camera_from_world, second.camera_from_world)
    np.testing.assert_array_equal(first.points, second.points)
    monkeypatch.setattr(reconstruction, "EVERY_PAIR", 0)
    monkeypatch.setattr(reconstruction, "BESIDE", 4)
    assert len(reconstruction.find_cameras(tmp_path / "p", names, "file", lambda *_: None).names) >= 6


def test_a_side_that_was_built_is_not_hidden_behind_what_was_found():
    """Seen edge-on, what was found lies over what was built: the plan shows the share of each."""
    from workflow.reconstruction.files import _seen_edge_on

    points = np.repeat([[0.01, 1.01], [0.31, 1.01], [0.31, 2.01]], 10, axis=0)
    found = np.r_[np.ones(10, bool), np.arange(10) < 4, np.zeros(10, bool)]
    place, share = _seen_edge_on(points, found)
    np.testing.assert_allclose(place, [[0.025, 1.025], [0.325, 1.025], [0.325, 2.025]])
    np.testing.assert_allclose(share, [1.0, 0.4, 0.0])
