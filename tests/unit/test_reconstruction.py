"""Cameras are known here: depth by plane sweep, what several agree on, the mesh of it, walls and the frame of the room."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from iif_core.camera.pinhole import up_axis
from iif_core.reconstruction.agreement import agreed, votes
from iif_core.reconstruction.flat import flat_depth, textured
from iif_core.reconstruction.frame import room_frame, upright, upward
from iif_core.reconstruction.fusing import fused_mesh, large_pieces
from iif_core.reconstruction.neighbours import neighbours
from iif_core.reconstruction.sweep import Picture, SweepOptions, _add_path, swept_depth
from iif_core.reconstruction.walls import flat_walls, turn_to_walls
from iif_core.surface.triangles import face_geometry
from tests.unit.test_enclosure import room

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
TEXTURE = gaussian_filter(np.random.default_rng(0).normal(size=(800, 800)), 2.0, mode="wrap")
TEXTURE = 0.5 + 0.15 * TEXTURE / TEXTURE.std()
SLOPE = np.array([0.15, -0.1, 1.0])  # the wall: SLOPE . x = 3


def depth_on(pose, normal=SLOPE, offset=3.0):
    """z-depth (H, W) of a plane normal . x = offset seen from a pose (3, 4) camera_from_world, and its points."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(INTRINSICS).T
    centre = -pose[:, :3].T @ pose[:, 3]
    world = rays @ pose[:, :3]
    depth = (offset - centre @ normal) / (world @ normal)
    return depth, centre + depth[..., None] * world


def photograph(pose, gain=1.0, **plane):
    """The textured wall, one texel a centimetre."""
    _, points = depth_on(pose, **plane)
    shown = map_coordinates(TEXTURE, np.moveaxis(points[..., :2] / 0.01, -1, 0), order=1, mode="grid-wrap")
    return Picture((gain * shown).astype(np.float32), INTRINSICS, pose)


def pose_at(x, y, turn=0.0):
    rotation = Rotation.from_euler("y", turn).as_matrix()
    return np.column_stack([rotation, -rotation @ [x, y, 0.0]])


POSES = [pose_at(0, 0), pose_at(0.3, 0.05, 0.08), pose_at(-0.3, 0.0, -0.08), pose_at(0.05, 0.25, 0.02)]


def test_depth_of_a_slanted_wall_between_exposures():
    """Other photographs are up to twice as bright; depth is right to a small part of a plane; one alone tells nothing."""
    pictures = [photograph(pose, gain) for pose, gain in zip(POSES, (1.0, 1.5, 0.7, 2.0), strict=True)]
    options = SweepOptions(planes=24)
    found = swept_depth(pictures[0], pictures[1:], 1.5, 6.0, options)
    truth, _ = depth_on(POSES[0])
    inner = np.s_[8:-8, 8:-8]
    step = (1 / 1.5 - 1 / 6.0) / 23
    error = np.abs(1 / found - 1 / truth)[inner]
    assert np.isfinite(found[inner]).mean() > 0.97
    assert np.nanmedian(error) < 0.04 * step and np.nanquantile(error, 0.95) < 0.15 * step
    coarse = swept_depth(pictures[0], pictures[1:], 1.5, 6.0, replace(options, finer=()))
    assert np.nanmedian(np.abs(1 / coarse - 1 / truth)[inner]) > 1.5 * np.nanmedian(error)
    one = swept_depth(pictures[0], pictures[1:2], 1.5, 6.0, options)
    assert not np.isfinite(one).any()


def gathered(cost, grey, dy, dx, step, jump, edge):
    """Eq. D.2 in one direction, written down pixel by pixel in double precision."""
    height, width, planes = cost.shape
    known = np.where(cost == 255, 127.0, cost)
    out = np.zeros(cost.shape)
    rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
    columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
    for y in rows:
        for x in columns:
            i, j = y - dy, x - dx
            out[y, x] = known[y, x]
            if 0 <= i < height and 0 <= j < width:
                before = out[i, j]
                limit = max(jump / (1 + abs(float(grey[y, x]) - float(grey[i, j])) / edge), step)
                beside = np.minimum(np.r_[np.inf, before[:-1]], np.r_[before[1:], np.inf]) + step
                out[y, x] += np.minimum(np.minimum(before, beside), before.min() + limit) - before.min()
    return out


@pytest.mark.parametrize("direction", [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_gathered_costs_are_those_of_the_formula(direction):
    rng = np.random.default_rng(2)
    cost = rng.integers(0, 256, (6, 7, 5), np.uint8)
    cost[2, 3] = 255
    grey = rng.random((6, 7)).astype(np.float32)
    total = np.zeros(cost.shape, np.uint16)
    _add_path(cost, grey, *direction, 12.0, 120.0, 0.2, total)
    expected = gathered(cost, grey, *direction, 12.0, 120.0, 0.2)
    assert np.abs(total - expected).max() <= 1.0  # whole levels are added


def test_a_camera_somewhere_else_tells_nothing():
    behind = np.column_stack([Rotation.from_euler("y", np.pi).as_matrix(), [0.0, 0.0, 0.0]])
    away = [Picture(photograph(POSES[0]).grey, INTRINSICS, behind)] * 2
    assert not np.isfinite(swept_depth(photograph(POSES[0]), away, 1.5, 6.0, SweepOptions(planes=16))).any()


def test_depth_on_which_others_do_not_agree_is_dropped():
    pictures = [photograph(pose) for pose in POSES]
    depths = [depth_on(pose)[0].astype(np.float32) for pose in POSES]
    spoilt = depths[0].copy()
    spoilt[20:30, 40:50] *= 1.1
    kept = agreed(spoilt, pictures[0], list(zip(depths[1:], pictures[1:], strict=True)), least=2)
    assert np.isnan(kept[20:30, 40:50]).all()
    inner = np.ones(kept.shape, bool)
    inner[20:30, 40:50] = False
    inner[:8], inner[-8:], inner[:, :16], inner[:, -16:] = False, False, False, False
    assert np.isfinite(kept[inner]).all()
    unknown = np.full_like(spoilt, np.nan)
    assert np.isnan(agreed(spoilt, pictures[0], [(unknown, pictures[1])], least=1)).all()


def two_walls():
    """Two regions of one grey, each on a plane of its own; grey, true depth, and the right one."""
    grey, right = np.full((HEIGHT, WIDTH), 0.3, np.float32), np.arange(WIDTH)[None] >= WIDTH // 2
    grey[:, WIDTH // 2 :] = 0.7
    depth = np.where(right, depth_on(POSES[0], normal=np.array([-0.3, 0.0, 1.0]), offset=4.0)[0], depth_on(POSES[0])[0])
    return grey, depth, np.broadcast_to(right, grey.shape)


def test_a_region_of_one_colour_has_the_plane_of_its_known_pixels():
    """Depth is known along the border of the picture, in noise of 0.3 %, a third of it of what stands in front. The other region
    is known on too few pixels, then on noise that is no plane."""
    grey, depth, right = two_walls()
    rng = np.random.default_rng(0)
    border = np.ones(grey.shape, bool)
    border[4:-4, 4:-4] = False
    known = np.where(border & ~right, depth * (1 + rng.normal(0, 0.003, grey.shape)), np.nan)
    front = border & (rng.random(grey.shape) < 0.35)
    known[front] *= 0.8
    few = np.flatnonzero((right & border).ravel())[:20]
    known.ravel()[few] = depth.ravel()[few]
    found = flat_depth(grey, known)
    assert found.dtype == np.float32 and np.isnan(found[right]).all()
    inner = np.s_[:, : WIDTH // 2 - 3]  # the border of the regions is not exact
    assert np.abs(found[inner] / depth[inner] - 1).max() < 0.002  # also where what stands in front was taken for it
    known[right] = rng.uniform(1.0, 5.0, grey.shape)[right]
    assert np.isnan(flat_depth(grey, known)[right]).all()


def test_planes_reach_as_far_as_their_pixels_tell():
    """A corner of 8 x 8 pixels tells the plane beside it, not at the other end; pixels on a line tell none."""
    grey = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth, _ = depth_on(POSES[0])
    noisy = depth * (1 + np.random.default_rng(0).normal(0, 0.003, depth.shape))
    known = np.full(depth.shape, np.nan)
    known[:8, :8] = noisy[:8, :8]
    found = flat_depth(grey, known)
    assert np.isfinite(found[2:6, 2:6]).all() and np.isnan(found[-20:, -20:]).all()
    assert np.nanmax(np.abs(found / depth - 1)) < 0.03
    known = np.full(depth.shape, np.nan)
    known[30] = depth[30]
    assert np.isnan(flat_depth(grey, known)).all()
    assert np.isnan(flat_depth(grey, np.full(depth.shape, np.nan))).all()
    # -------- and all of it where they lie around it, in any unit --------
    known = np.where(np.arange(WIDTH)[None] % 12 == 0, noisy, np.nan)
    for unit in (1e-3, 1.0, 1e4):
        assert np.abs(flat_depth(grey, unit * known) / (unit * depth) - 1).max() < 0.005


def test_texture_is_of_the_pixel_and_not_of_what_is_beside_it():
    grey = np.full((40, 40), 0.4, np.float32)
    grey[:, 20:] = 0.8
    grey[25:, :12] += 0.05 * np.random.default_rng(0).normal(size=(15, 12)).astype(np.float32)
    found = textured(grey)
    assert found[:, 19:21].all() and not found[:20, 16:18].any() and not found[:20, 22:24].any()
    assert not found[:20, :15].any() and found[28:-2, 2:8].mean() > 0.9


def test_depth_maps_speak_for_surface_and_against_it():
    pictures = [photograph(pose) for pose in POSES]
    depths = [depth_on(pose)[0].astype(np.float32) for pose in POSES]
    floats = depths[0].copy()
    floats[20:30, 40:50] *= 0.8
    unknown = np.full_like(floats, np.nan)
    others = [(depth, depth, picture) for depth, picture in zip(depths[1:], pictures[1:], strict=True)]
    same, through = votes(floats, pictures[0], others)
    inner = np.s_[10:-10, 18:-18]
    patch = np.zeros(floats.shape, bool)
    patch[20:30, 40:50] = True
    assert (same[inner][~patch[inner]] == 3).all() and (through[~patch] == 0).all()
    assert (same[patch] == 0).all() and (through[patch] == 3).all()
    # -------- one map may only speak for, another only against --------
    same, through = votes(floats, pictures[0], [(depths[1], unknown, pictures[1]), (unknown, depths[2], pictures[2])])
    assert (same[inner][~patch[inner]] == 1).all() and (through[patch] == 1).all()
    behind = votes(1.2 * depths[0], pictures[0], others)
    assert not behind[0].any() and not behind[1].any()  # surface in front hides it


def test_neighbours_show_the_same_from_a_little_aside():
    """Cameras on a line look at points 4 m away; 0.56 m aside is 8 degrees. The last one shows other points."""
    centres = np.array([[x, 0.0, 0.0] for x in (0.0, 0.05, 0.56, 1.1, 3.0)] + [[0.5, 0, 0]])
    points = np.column_stack([np.linspace(-0.2, 0.2, 20), np.zeros(20), np.full(20, 4.0)])
    points = np.concatenate([points, points + [0, 0, 3.0]])
    view = np.repeat(np.arange(6), 20)
    point = np.concatenate([np.arange(20)] * 5 + [np.arange(20, 40)])
    found = neighbours(point, view, points, centres, most=3)
    assert found[0].tolist()[0] == 2 and 1 not in found[0].tolist()[:2]
    assert len(found[5]) == 0 and all(5 not in own for own in found)


def test_a_mesh_of_depth_maps_lies_on_the_wall():
    pictures = [photograph(pose) for pose in POSES]
    depths = [depth_on(pose)[0].astype(np.float32) for pose in POSES]
    vertices, faces = fused_mesh(depths, pictures, 0.04)
    distance = np.abs(vertices @ SLOPE - 3.0) / np.linalg.norm(SLOPE)
    assert np.median(distance) < 0.005 and distance.max() < 0.08
    normal, area = face_geometry(vertices, faces)
    towards = -SLOPE / np.linalg.norm(SLOPE)
    assert np.average(normal @ towards, weights=area) > 0.98
    assert not len(fused_mesh([np.full((HEIGHT, WIDTH), np.nan, np.float32)], pictures[:1], 0.04)[1])


def test_small_loose_pieces_are_left_out():
    vertices, faces = room(((2, 1),))
    far = np.array([[9.0, 0, 0], [9.02, 0, 0], [9.0, 0.02, 0]])
    kept = large_pieces(np.concatenate([vertices, far]), np.concatenate([faces, [[0, 1, 2]] + np.array(len(vertices))]))
    assert len(kept[1]) == len(faces) and kept[0][:, 0].max() < 3


def looking(eye, at):
    from iif_core.camera.pinhole import look_at

    return np.linalg.inv(look_at(eye, at, (0, 0, 1)))[:3]


def looks_through_a_door():
    """Two cameras look at a wall of `room` with a door of 0.9 x 2 m, through which depth maps show what is far behind."""
    pictures, depths = [], []
    for x in (-0.4, 0.4):
        pose = looking((x, 1.5, 0.0), (0.0, -2.0, -0.2))
        pictures.append(Picture(np.zeros((HEIGHT, WIDTH), np.float32), INTRINSICS, pose))
        depth = np.full((HEIGHT, WIDTH), np.nan, np.float32)
        _, points = depth_on(pose, normal=np.array([0.0, -1.0, 0.0]), offset=2.0)
        depth[(np.abs(points[..., 0]) < 0.45) & (points[..., 2] < 0.75)] = 9.0
        depths.append(depth)
    return depths, pictures


def fine(vertices, faces):
    """The same mesh with edges of some 6 cm."""
    return trimesh.remesh.subdivide_to_size(vertices, faces, 0.08)


def test_walls_take_the_place_of_noisy_surface_and_close_what_is_missing():
    """Surface is off by 5 mm, and its normals by ten degrees. Of a wall nothing was found but its ends, another has a door, and
    a board stands 30 cm in front of a third."""
    vertices, faces = fine(*room())
    middle = vertices[faces].mean(1)
    gone = (middle[:, 0] > 2.49) & (np.abs(middle[:, 1]) < 0.9)
    door = (middle[:, 1] < -1.99) & (np.abs(middle[:, 0]) < 0.45) & (middle[:, 2] < 0.75)
    faces = faces[~(gone | door)]
    board = np.array([[-2.2, -0.5, -0.5], [-2.2, 0.5, -0.5], [-2.2, 0.5, 0.5], [-2.2, -0.5, 0.5]])
    rng = np.random.default_rng(0)
    noisy = vertices + rng.normal(0, 0.005, vertices.shape)
    every = np.concatenate([faces, np.array([[0, 1, 2], [0, 2, 3]]) + len(vertices)])
    built, flat = flat_walls(np.concatenate([noisy, board]), every, *looks_through_a_door())
    centre = built.vertices[built.faces].mean(1)
    normal, area = face_geometry(built.vertices, built.faces)
    # -------- six sides in the middle of the noise, at right angles, facing inward --------
    assert built.sides.from_plane.all() and len(built.error) == 6
    assert (0.002 < built.error).all() and (built.error < 0.01).all()
    away = np.abs(np.abs(centre) - np.array([2.5, 2.0, 1.25])).min(1)
    assert away.max() < 0.004
    inward = -np.sign(centre) * (np.abs(np.abs(centre) - np.array([2.5, 2.0, 1.25])) < 0.004)
    assert np.einsum("ij,ij->i", normal, inward).min() > 0.99
    # -------- all of them but the door; what was not found is told apart --------
    whole = 2 * (5 * 4 + 5 * 2.5 + 4 * 2.5)
    assert area.sum() == pytest.approx(whole - 0.9 * 2.0, rel=0.01)
    of_wall = (centre[:, 0] > 2.49) & (np.abs(centre[:, 1]) < 0.8) & (np.abs(centre[:, 2]) < 1.1)
    assert not built.found[of_wall].any() and area[~built.found].sum() == pytest.approx(1.8 * 2.5, rel=0.15)
    assert not ((np.abs(centre[:, 0]) < 0.4) & (centre[:, 1] < -1.99) & (centre[:, 2] < 0.7)).any()
    # -------- nothing else is taken away, and hardly anything is left --------
    assert not flat[-2:].any()
    assert flat[:-2].mean() > 0.97


def test_what_lies_behind_walls_goes_and_what_a_door_shows_stays():
    vertices, faces = fine(*room())
    middle = vertices[faces].mean(1)
    faces = faces[~((middle[:, 1] < -1.99) & (np.abs(middle[:, 0]) < 0.45) & (middle[:, 2] < 0.75))]
    piece = np.array([[-0.1, 0.0, -0.1], [0.1, 0.0, -0.1], [0.0, 0.0, 0.1]])
    places = np.array([[0.0, -3.0, 0.0], [1.5, -3.0, 0.0], [1.5, -2.03, 0.0], [0.0, 3.0, 0.0], [1.0, 1.0, 0.0], [4.0, -3.0, 0.0]])
    loose = np.concatenate([piece + place for place in places])
    every = np.concatenate([faces, np.arange(len(loose)).reshape(-1, 3) + len(vertices)])
    # A little of the surface may be behind a plane that bounds a room.
    _, gone = flat_walls(np.concatenate([vertices, loose]), every, *looks_through_a_door())
    shown, hidden, on_wall, behind_other, inside, aside = gone[len(faces) :]
    assert hidden and behind_other and aside and on_wall  # that one is of the wall
    assert not (shown or inside)


def test_walls_at_the_extent_close_a_room_behind_what_is_there():
    """One side of the room is so uneven that it is no plane, and part of it was not found."""
    vertices, faces = fine(*room(((0, 1),)))
    rng = np.random.default_rng(0)
    stones = rng.uniform([2.35, -2.0, -1.25], [2.5, 2.0, 1.25], (400, 3))
    stones = stones[np.abs(stones[:, 1]) > 0.7]
    chips = np.array([[0, 0.05, 0], [0, -0.05, 0], [0.05, 0, 0.05]])
    corners = (stones[:, None] + chips).reshape(-1, 3)
    every = np.concatenate([vertices, corners]), np.concatenate([faces, np.arange(len(corners)).reshape(-1, 3) + len(vertices)])
    picture = Picture(np.zeros((4, 4), np.float32), INTRINSICS, looking((0.1, 0.2, 0.0), (1.0, 0.0, 0.0)))
    built, flat = flat_walls(*every, [np.full((4, 4), np.nan, np.float32)], [picture])
    open_side = int(np.argmin(built.sides.normal[:, 0]))
    assert not built.sides.from_plane[open_side] and built.sides.from_plane.sum() == 5
    assert np.isnan(built.error[open_side]) and flat[len(faces) :].mean() < 0.1 < 0.9 < flat[: len(faces)].mean()
    own = built.side == open_side
    assert not built.found[own].any()
    ends = built.vertices[np.unique(built.faces[own])]
    place = ends[:, 0].min()
    near = np.abs(ends[:, 1]) > 0.75
    assert 2.4 < place < 2.6
    assert (ends[near, 0] > place + 0.01).mean() > 0.3  # behind the stones
    assert (np.abs(ends[(np.abs(ends[:, 1]) < 0.5), 0] - place) < 1e-6).all()


@pytest.mark.parametrize("angle", [0.0, 17.0, -33.0])
def test_a_wall_without_texture_is_found_by_what_hangs_on_it(angle):
    """All that is found of four walls and the ceiling are pieces of 60 cm, less than 2 % of the surface each."""
    vertices, faces = fine(*room())
    middle = vertices[faces].mean(1)
    side = np.abs(np.abs(middle) - [2.5, 2.0, 1.25]).argmin(1)
    beside = np.delete(np.arange(3)[None].repeat(len(faces), 0), np.arange(len(faces)) * 3 + side).reshape(-1, 2)
    hangs = (np.abs(np.take_along_axis(middle, beside, 1) - [0.4, 0.3]) < 0.3).all(1)
    faces = faces[hangs | (middle[:, 2] < -1.24)]
    rng = np.random.default_rng(0)
    board = np.array([[-0.8, -0.2, -1.2], [-0.2, 0.4, -1.2], [-0.2, 0.4, -0.7], [-0.8, -0.2, -0.7]])  # at 45 degrees to the walls
    found = np.concatenate([vertices + rng.normal(0, 0.001, vertices.shape), board])
    every = np.concatenate([faces, np.array([[0, 1, 2], [0, 2, 3]]) + len(vertices)])
    turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    picture = Picture(np.zeros((4, 4), np.float32), INTRINSICS, looking(turn @ (0.1, 0.2, 0.0), turn @ (1.0, 0.0, 0.0)))
    built, _ = flat_walls(found @ turn.T, every, [np.full((4, 4), np.nan, np.float32)], [picture])
    assert built.sides.from_plane.all() and len(built.sides.normal) == 6
    back = built.vertices[built.faces].mean(1) @ turn
    assert np.abs(np.abs(back) - [2.5, 2.0, 1.25]).min(1).max() < 0.03
    assert np.abs(built.sides.normal @ turn).max(1).min() > np.cos(np.radians(0.5))
    area = face_geometry(built.vertices, built.faces)[1]
    assert area.sum() == pytest.approx(2 * (5 * 4 + 5 * 2.5 + 4 * 2.5), rel=0.02)


@pytest.mark.parametrize("tilt, upright", [(2.0, True), (6.0, False)])
def test_a_wall_leans_only_if_it_leans_by_more_than_noise(tilt, upright):
    vertices, faces = fine(*room())
    wall = vertices[:, 0] > 2.49
    vertices[wall, 0] -= np.tan(np.radians(tilt)) * (vertices[wall, 2] + 1.25)
    picture = Picture(np.zeros((4, 4), np.float32), INTRINSICS, looking((0.1, 0.2, 0.0), (1.0, 0.0, 0.0)))
    built, _ = flat_walls(vertices, faces, [np.full((4, 4), np.nan, np.float32)], [picture])
    leaning = np.degrees(np.arcsin(np.abs(built.sides.normal[np.argmin(built.sides.normal[:, 0]), 2])))
    assert built.sides.from_plane.all()
    assert leaning == pytest.approx(0.0 if upright else tilt, abs=0.3)
    assert built.height() == pytest.approx(2.5, abs=1e-3)
    larger = built.scaled(2.0)
    assert larger.height() == pytest.approx(5.0, abs=2e-3)
    np.testing.assert_allclose(larger.vertices, 2 * built.vertices)
    np.testing.assert_allclose(larger.error, 2 * built.error)


def test_a_room_without_a_ceiling_has_no_height():
    vertices, faces = fine(*room(((2, 1),)))
    picture = Picture(np.zeros((4, 4), np.float32), INTRINSICS, looking((0.1, 0.2, 0.0), (1.0, 0.0, 0.0)))
    assert flat_walls(vertices, faces, [np.full((4, 4), np.nan, np.float32)], [picture])[0].height() is None


def test_most_of_a_room_is_not_made_up():
    """Of six sides two were found: the others stay open."""
    vertices, faces = fine(*room(((0, 1), (0, -1), (1, 1), (2, 1))))
    picture = Picture(np.zeros((4, 4), np.float32), INTRINSICS, looking((0.1, 0.2, 0.0), (1.0, 0.0, 0.0)))
    built, flat = flat_walls(vertices, faces, [np.full((4, 4), np.nan, np.float32)], [picture])
    assert flat.mean() > 0.97 and np.isfinite(built.error).sum() == 2
    assert np.isfinite(built.error[built.side]).all() and built.found.mean() > 0.95


def test_squares_leave_no_crack_along_slanted_borders():
    from iif_core.reconstruction.walls import _tiles

    outline = np.array([[0.0, 0, 0], [3.0, 0, 0], [1.0, 1.7, 0]])
    corners, quads = _tiles(outline, np.array([0.0, 0, 1]), 0.1)
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 500)
    points = weights @ outline
    low, high = corners[quads].min(1), corners[quads].max(1)
    covered = ((points[:, None, :2] >= low[None, :, :2] - 1e-9) & (points[:, None, :2] <= high[None, :, :2] + 1e-9)).all(2).any(1)
    assert covered.mean() > 0.995


@pytest.mark.parametrize("angle", [0.0, 0.06, -0.2, 0.7])
def test_walls_are_turned_to_the_axes(angle):
    vertices, faces = room(((2, 1),))
    c, s = np.cos(angle), np.sin(angle)
    turned = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    picture = Picture(np.zeros((4, 4), np.float32), INTRINSICS, looking((0.1, 0.2, 0.0), (1.0, 0.0, 0.0)))
    walls, _ = flat_walls(turned, faces, [np.full((4, 4), np.nan, np.float32)], [picture])
    back = turned @ turn_to_walls(walls).T
    np.testing.assert_allclose(np.sort(np.ptp(back, axis=0)), [2.5, 4.0, 5.0], atol=5e-3)  # 0.05 degrees


def test_cameras_that_all_look_down_the_same_way_do_not_tilt_the_floor():
    """Their mean vertical leans by 15 degrees, and so does a board of 4 m²; the floor is larger."""
    vertices, faces = room()
    poses = np.array([np.linalg.inv(np.vstack([looking((-2.0, y, 1.0), (1.7, y, 0.0)), [0, 0, 0, 1]])) for y in (-0.5, 0.0, 0.5)])
    up = -poses[:, :3, 1].mean(0)
    across = np.array([0.0, 1.0, 0.0])
    along = np.cross(across, up)
    board = np.array([along + across, -along + across, -along - across, along - across])
    every = np.concatenate([faces, np.array([[0, 1, 2], [0, 2, 3]]) + len(vertices)])
    assert 10 < np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 20
    frame = room_frame(np.concatenate([vertices, board]), every, poses)
    assert frame.turn[2, 2] > np.cos(np.radians(0.5))


def test_the_vertical_of_cameras_that_look_down():
    """They look down by 45 degrees, into a quarter of the room: what is up in their pictures leans, what is right does not."""
    eyes = [(x, -1.5, 1.0) for x in (-1.0, 0.0, 1.0)]
    poses = np.array([np.linalg.inv(np.vstack([looking(eye, (0.0, -0.3, -0.4)), [0, 0, 0, 1]])) for eye in eyes])
    up = -poses[:, :3, 1].mean(0)
    assert np.degrees(np.arccos(up[2] / np.linalg.norm(up))) > 35
    assert upright(poses)[2] > 0.9999
    same = np.repeat(poses[1:2], 3, 0)  # one direction tells no more than its picture
    np.testing.assert_allclose(upright(same), -same[0, :3, 1])


@pytest.mark.parametrize(("deep", "has_floor"), [(0.0, True), (1.0, False)])
def test_a_table_with_the_room_below_it_is_no_floor(deep, has_floor):
    """Walls go on below the lowest level surface, which nothing of the floor itself joins."""
    vertices, faces = room()
    level = np.abs(face_geometry(vertices, faces)[0][:, 2]) > 0.9
    is_floor = level & (vertices[faces].mean(1)[:, 2] < vertices[:, 2].mean())
    bottom = vertices[:, 2].min()
    table = np.array([[-0.6, -0.5, bottom], [0.6, -0.5, bottom], [0.6, 0.5, bottom], [-0.6, 0.5, bottom]])
    lower = vertices - [0, 0, deep] * (vertices[:, 2:] < bottom + 1e-6)
    every = np.concatenate([faces[~is_floor], np.array([[0, 1, 2], [0, 2, 3]]) + len(vertices)])
    frame = room_frame(np.concatenate([lower, table]), every, _eyes())
    assert (frame.has_floor, frame.has_ceiling) == (has_floor, True)
    assert frame.floor == pytest.approx(bottom - 2 / 3 * deep, abs=0.06)  # the middle of the lowest faces


def _eyes():
    eyes = [(-1.0, 0.5, 0.2), (1.0, -0.5, 0.3), (0.3, 1.0, 0.1)]
    return np.array([np.linalg.inv(np.vstack([looking(eye, (0.2, 0.1, -0.5)), [0, 0, 0, 1]])) for eye in eyes])


@pytest.mark.parametrize("angle", [3.0, 12.0, 40.0])
def test_what_is_up_in_a_room_that_leans(angle):
    vertices, faces = room(((1, 1),))
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(np.radians(angle) * np.array([0.6, -0.8, 0.0])).as_matrix()
    poses = moved @ _eyes()
    up = upward(vertices @ moved[:3, :3].T, faces, poses, up_axis(poses))
    assert np.degrees(np.arccos(min(up @ moved[:3, 2], 1.0))) < 0.2


def test_an_axis_is_up_unless_the_floor_says_otherwise():
    """Exactly so, with noise and a roof that slopes: it is larger than the floor, which is level all the same."""
    vertices, faces = room(((1, 1),))
    noisy = vertices + np.random.default_rng(0).normal(0, 0.01, vertices.shape)
    np.testing.assert_array_equal(upward(noisy, faces, _eyes(), np.array([0.0, 0, 1])), [0, 0, 1])
    roof = np.array([[-4.0, -3, 1.3], [4, -3, 1.3], [4, 3, 3.4], [-4, 3, 3.4]])  # 15 degrees
    every = np.concatenate([faces, np.array([[0, 2, 1], [0, 3, 2]]) + len(vertices)])
    assert room_frame(np.concatenate([vertices, roof]), every, _eyes()).turn[2, 2] < 0.98  # the roof is taken for level
    np.testing.assert_array_equal(upward(np.concatenate([vertices, roof]), every, _eyes(), np.array([0.0, 0, 1])), [0, 0, 1])


@pytest.mark.parametrize("seed", range(3))
def test_the_frame_of_a_room_is_found_whichever_way_it_lies(seed):
    vertices, faces = room(((1, 1),))
    turn = Rotation.random(random_state=seed).as_matrix()
    eyes = [(-1.0, 0.5, 0.2), (1.0, -0.5, 0.3), (0.3, 1.0, 0.1)]
    poses = np.array([np.linalg.inv(np.vstack([looking(eye, (0.2, 0.1, -0.5)), [0, 0, 0, 1]])) for eye in eyes])
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = turn, [3.0, -8.0, 1.0]
    frame = room_frame(vertices @ turn.T + moved[:3, 3], faces, moved @ poses)
    own = (vertices @ turn.T + moved[:3, 3]) @ frame.turn.T
    assert np.linalg.det(frame.turn) == pytest.approx(1.0)
    np.testing.assert_allclose(np.sort(np.ptp(own, axis=0)), [2.5, 4.0, 5.0], atol=1e-3)
    assert np.ptp(own[:, 2]) == pytest.approx(2.5, abs=1e-3)  # z is up
    assert (frame.turn @ turn @ [0, 0, 1])[2] > 0.999
    assert frame.ceiling - frame.floor == pytest.approx(2.5, abs=0.02)
