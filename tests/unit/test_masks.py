"""Objects from 2D masks: view consensus by hand, against loops, on known objects, and through the stage with files."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.sparse import csr_matrix

from iif_core.objects import mask_clustering as mc
from iif_core.objects.mask_votes import (
    Sightings,
    elect_labels,
    join_objects,
    label_faces,
    merge_votes,
    part_objects,
    sightings,
    split_apart,
    view_votes,
)
from iif_core.surface.cells import pack_keys
from iif_core.surface.segments import fill_within, partition_agreement
from tests.errors import refused
from tests.unit import own_scene as own
from tests.unit.spoilt_masks import purity, spoil_masks
from workflow.artifacts import StageReader
from workflow.segmentations import masks


def planted(labels, visible=None):
    """MaskPoints of label arrays (E,) a view, 0 = no mask."""
    count = len(labels[0])
    seen = []
    for view, label in enumerate(labels):
        rows = np.arange(count) if visible is None else np.flatnonzero(visible[view])
        seen.append((rows, np.asarray(label)[rows]))
    return mc.gather_masks(seen, count, 1)


# ------------------------------------------------------------------------------------------------------- points and masks


def test_small_masks_lie_on_large_ones():
    whole, part, same = np.ones((3, 4), bool), np.zeros((3, 4), bool), np.zeros((3, 4), bool)
    part[0, :2] = same[0, 1:3] = True
    np.testing.assert_array_equal(mc.flatten_masks([part, whole, same])[0], [1, 3, 3, 2])
    assert (mc.flatten_masks([part, whole, same])[1:] == 2).all()
    with refused("(2, 4), (3, 4)"):
        mc.flatten_masks([whole, whole[:2]])


def test_points_behind_something_are_not_seen():
    depth = np.array([[2.0, 0.0], [1.0, 2.0]])
    labels = np.array([[5, 6], [7, 8]])
    # Through the four pixel centres at z = 2, and one behind the camera.
    points = np.array([[-1, -1, 2], [1, -1, 2], [-1, 1, 2], [1, 1, 2.03], [-1, -1, -2]], float)
    rows, found = mc.masks_at(points, labels, depth, (1.0, 1.0, 1.0, 1.0), np.eye(4), 0.0)
    np.testing.assert_array_equal(rows, [0, 3])  # a miss at 1, an occluder at 2, 1.5 % off at 3
    np.testing.assert_array_equal(found, [5, 8])


def test_gathered_masks_drop_the_tiny_and_the_unlabelled():
    seen = [(np.array([0, 1, 2, 4]), np.array([9, 9, 3, 0])), (np.array([0, 1]), np.array([4, 4]))]
    masks = mc.gather_masks(seen, 5, 2)
    np.testing.assert_array_equal(masks.in_mask.toarray(), [[1, 1, 0, 0, 0], [1, 1, 0, 0, 0]])
    np.testing.assert_array_equal(masks.visible.toarray(), [[1, 1, 1, 0, 1], [1, 1, 0, 0, 0]])
    assert masks.view.tolist() == [0, 1] and masks.label.tolist() == [9, 4]


# ------------------------------------------------------------------------------------------------------------- consensus


def containment_by_loops(masks, options):
    inside, seen = masks.in_mask.toarray() > 0, masks.visible.toarray() > 0
    container = np.full((len(inside), len(seen)), -1)
    split = np.zeros(container.shape, bool)
    for m, mask in enumerate(inside):
        for f, visible in enumerate(seen):
            here = mask & visible
            mine = np.flatnonzero(masks.view == f)
            shared = [int((here & inside[n]).sum()) for n in mine]
            if here.sum() < options.visible * mask.sum() or not shared or sum(shared) < 0.5 * here.sum():
                continue
            if sum(shared) == 0:
                continue
            if max(shared) > options.contained * sum(shared):
                container[m, f] = mine[int(np.argmax(shared))]
            else:
                split[m, f] = True
    return container, split


def test_votes_equal_loops_whatever_the_block(monkeypatch):
    rng = np.random.default_rng(0)
    things = np.sort(rng.integers(1, 7, 120))
    labels = [np.where(rng.random(120) < 0.15, rng.integers(0, 8, 120), things) for _ in range(9)]
    masks = planted(labels, rng.random((9, 120)) < 0.6)
    options = mc.ConsensusOptions()
    whole = mc.containment(masks, options)
    container, split = containment_by_loops(masks, options)
    np.testing.assert_array_equal(whole.container, container)
    np.testing.assert_array_equal(whole.split, split)
    clusters = mc.cluster_masks(masks, options)
    monkeypatch.setattr(mc, "BLOCK_MASKS", 7)
    np.testing.assert_array_equal(mc.containment(masks, options).container, container)
    np.testing.assert_array_equal(mc.cluster_masks(masks, options), clusters)


def joined_by_loops(container, consensus):
    """Eq. O.11 and O.12 with sets: the minima of observers fall, and each joins all pairs that agree at once."""
    nodes = [({f for f, m in enumerate(row) if m >= 0}, {m for m in row if m >= 0}, {i}) for i, row in enumerate(container)]

    def pairs():
        for i, (views, held, _) in enumerate(nodes):
            for j, (others, theirs, _) in enumerate(nodes[:i]):
                if held & theirs and views & others:
                    yield j, i, len(views & others), len(held & theirs)

    found = np.floor(np.percentile([observers for *_, observers, _ in pairs()], mc.PERCENTILES)).astype(int)
    for least in sorted({max(n, mc.MIN_OBSERVERS) for n in found.tolist()}, reverse=True):
        owner = list(range(len(nodes)))
        for i, j, observers, supporters in list(pairs()):
            if observers >= least and supporters >= consensus * observers:
                owner = [owner[i] if o == owner[j] else o for o in owner]
        nodes = [
            tuple(set().union(*(nodes[n][part] for n in range(len(nodes)) if owner[n] == o)) for part in range(3))
            for o in dict.fromkeys(owner)
        ]
    label = np.empty(len(container), int)
    for number, node in enumerate(sorted(nodes, key=lambda node: min(node[2]))):
        label[list(node[2])] = number
    return label


def test_joining_of_masks_equals_loops():
    for seed in range(2):
        rng = np.random.default_rng(seed)
        things = np.repeat(np.arange(6), 20)
        labels = [
            1 + np.where(rng.random(120) < 0.3, rng.integers(0, 6, 120), things // rng.choice([1, 1, 2])) for _ in range(12)
        ]
        container = mc.containment(planted(labels, rng.random((12, 120)) < 0.5), mc.ConsensusOptions()).container
        expected = joined_by_loops(container, 0.8)
        assert 3 < expected.max() < len(container) - 9
        np.testing.assert_array_equal(mc._join(container, len(container), 0.8), expected)


def test_a_mask_that_views_split_is_dropped_and_its_opinion_with_it():
    a, b = np.repeat([1, 0], 20), np.repeat([0, 2], 20)
    labels = [a + b, a + b, a + b, np.ones(40, int)]  # the last view holds both together
    masks = planted(labels)
    np.testing.assert_array_equal(mc.cluster_masks(masks), [0, 1, 0, 1, 0, 1, -1])
    votes = mc.containment(masks, mc.ConsensusOptions())
    assert votes.split[6].tolist() == [True, True, True, False]
    assert (votes.container[:6, 3] == 6).all()
    # If most views hold them together they are one thing, and it is the two halves of one view that join it.
    together = mc.cluster_masks(planted([np.ones(40, int)] * 3 + [a + b]))
    np.testing.assert_array_equal(together, [0, 0, 0, 0, 0])


def test_masks_that_share_no_view_stay_apart():
    """Two halves of a wall with cameras of their own: no view contains both in one mask, and none splits them."""
    label = np.ones(40, int)
    visible = np.array([np.arange(40) < 20] * 3 + [np.arange(40) >= 20] * 3)
    np.testing.assert_array_equal(mc.cluster_masks(planted([label] * 6, visible)), [0, 0, 0, 1, 1, 1])


def test_no_masks_and_options_out_of_range():
    assert len(mc.cluster_masks(planted([np.zeros(5, int)] * 2))) == 0
    with refused("consensus", "1.5", 0, 1):
        mc.cluster_masks(planted([np.ones(5, int)]), mc.ConsensusOptions(consensus=1.5))


def test_more_than_64_views():
    """The observers of a pair are counted over several words."""
    a, b = np.repeat([1, 0], 20), np.repeat([0, 2], 20)
    clusters = mc.cluster_masks(planted([a + b] * 70))
    np.testing.assert_array_equal(clusters, np.tile([0, 1], 70))


# ---------------------------------------------------------------------------------------------------------------- votes


def test_parts_that_lie_apart_are_two():
    ijk = np.array([[5, 5, 5], [6, 6, 5], [9, 5, 5], [6, 5, 5]])
    keys = np.sort(pack_keys(ijk, [0, 0, 0, 1]))
    part, cluster = split_apart(keys)
    assert len(cluster) == 3 and sorted(cluster.tolist()) == [0, 0, 1]
    where = {key: p for key, p in zip(keys.tolist(), part.tolist(), strict=True)}
    key = pack_keys(ijk, [0, 0, 0, 1]).tolist()
    assert where[key[0]] == where[key[1]] != where[key[2]] and cluster[where[key[3]]] == 1


def test_election_by_hand():
    face = np.array([0, 0, 1, 2, 2])
    label = np.array([0, 1, 1, 0, 1])
    weight = np.array([2.0, 1.0, 1.0, 0.5, 0.5])
    alone = np.arange(5)
    np.testing.assert_array_equal(elect_labels(face, label, weight, weight, alone), [0, 1, 0, -1, -1])  # a tie: the lowest
    # One piece of 5 views, 2.5 each way: no help. Then label 1 gets one more face there: 2 views x 4.5 / 7 outweigh it.
    piece = np.zeros(5, int)
    np.testing.assert_array_equal(elect_labels(face, label, weight, weight, piece, 2.0), [0, 1, 0, -1, -1])
    more = (np.r_[face, 3], np.r_[label, 1], np.r_[weight, 2.0])
    np.testing.assert_array_equal(elect_labels(*more, more[2], piece, 2.0), [0, 1, 1, 1, -1])
    np.testing.assert_array_equal(elect_labels(*more, more[2], piece, 100.0), [1, 1, 1, 1, -1])
    assert (elect_labels(face[:0], label[:0], weight[:0], weight[:0], piece) == -1).all()


def test_small_things_win_against_what_they_stand_on():
    """A face that is once in its own mask and twice in the mask of the table, whose masks are 100 times as large."""
    face = np.zeros(3, int)
    views = [
        view_votes(face, pack_keys(np.full((3, 3), 4), cluster), np.ones(3, bool), np.ones(3, bool), 2) for cluster in (0, 0, 1)
    ]
    votes = merge_votes(views)
    assert votes.pixels.tolist() == [3, 3, 3] and votes.share.tolist() == [1, 1, 1]
    label, bare, agreement = label_faces(votes, np.array([400.0, 4.0]), np.array([2, 2]), np.arange(2))
    assert label.tolist() == [1, -1] and not bare.any() and agreement[1] == pytest.approx(1 / 3)
    label, _, _ = label_faces(votes, np.array([400.0, 4.0]), np.array([2, 1]), np.arange(2))
    assert label[0] == 0  # a cluster of one mask counts only where no other does


def test_faces_outside_masks_do_not_vote():
    clustered = np.array([True, False, False])
    votes = view_votes(np.zeros(3, int), pack_keys(np.ones((3, 3), int), 0), clustered, clustered, 2)
    label, bare, _ = label_faces(votes, np.ones(1), np.full(1, 2), np.zeros(2, int))
    assert label.tolist() == [-1, -1] and bare.tolist() == [True, False]


def test_the_mesh_settles_the_rest():
    pairs = np.stack([np.arange(9), np.arange(1, 10)], 1)  # a strip of ten faces
    label = np.array([4, -1, -1, -1, -1, -1, 2, -1, -1, -1])
    piece = np.array([0, 0, 0, 1, 1, 0, 0, 0, 0, 0])
    closed = np.zeros(10, bool)
    closed[8] = True
    np.testing.assert_array_equal(fill_within(label, piece, closed, pairs), [4, 4, 4, 6, 6, 2, 2, 2, 5, 5])


def seen_as(*views):
    """Sightings of views, each a list of (fragment, mask, pixels)."""
    return sightings(
        tuple(np.repeat(np.array(column), [n for *_, n in rows]) for column in list(zip(*rows, strict=True))[:2])
        for rows in views
    )


def test_what_most_views_hold_apart_is_parted():
    """A thing of 4 pixels (fragment 1) on a table of 100 (fragment 0), of which fragment 2 is another piece."""
    joint, apart = [(0, 1, 100), (2, 1, 50), (1, 1, 4)], [(0, 1, 100), (2, 1, 50), (1, 2, 4)]
    one = np.zeros(3, int)
    np.testing.assert_array_equal(part_objects(one, seen_as(joint, joint, apart, apart, apart)), [0, 1, 0])  # 1 + 2 to 3
    np.testing.assert_array_equal(part_objects(one, seen_as(joint, joint, joint, apart, apart, apart)), [0, 0, 0])
    np.testing.assert_array_equal(part_objects(one, seen_as(apart)), [0, 1, 0])
    # Three of its four pixels with the table, in each of two views: 1 + 1.5 of 3. One of four: 1 + 0.5 of 3.
    np.testing.assert_array_equal(part_objects(one, seen_as(*[[(0, 1, 100), (1, 1, 3), (1, 2, 1)]] * 2)), [0, 0, 0])
    np.testing.assert_array_equal(part_objects(one, seen_as(*[[(0, 1, 100), (1, 1, 1), (1, 2, 3)]] * 2)), [0, 1, 0])


def test_what_is_parted_stays_together_itself():
    """Two things of two pieces each in one object, and a piece that no view shows with either."""
    views = [[(0, 1, 90), (1, 1, 40), (2, 2, 60), (3, 2, 30)]] * 3 + [[(4, 7, 5)]]
    np.testing.assert_array_equal(part_objects(np.full(5, 8), seen_as(*views)), [8, 8, 9, 9, 8])
    # Piece 3 is never seen with 0 and 1, only with 2, which is parted: nobody said that 3 is.
    views = [[(0, 1, 190), (1, 1, 40), (2, 2, 60)]] * 3 + [[(2, 4, 60), (3, 4, 30)]] * 2
    np.testing.assert_array_equal(part_objects(np.zeros(4, int), seen_as(*views)), [0, 0, 1, 0])
    np.testing.assert_array_equal(part_objects(np.arange(4), seen_as(*views)), np.arange(4))  # never joins objects


def grown_by_loops(home, rows):
    """`part_objects` as its docstring says, with dictionaries."""
    home, waits = list(home), set(range(len(home)))
    pixels = {}
    for view, fragment, mask, n in rows:
        pixels.setdefault((fragment, view), {})[mask] = n
    size = [sum(sum(seen.values()) for (f, _), seen in pixels.items() if f == i) for i in range(len(home))]

    def start():
        for o in {home[i] for i in waits}:
            waits.discard(min((i for i in waits if home[i] == o), key=lambda i: (-size[i], i)))

    start()
    while waits:
        held = {}
        for (f, view), seen in pixels.items():
            if f not in waits:
                for mask, n in seen.items():
                    place = held.setdefault((home[f], view), {})
                    place[mask] = place.get(mask, 0) + n
        together, views = dict.fromkeys(waits, 0.0), dict.fromkeys(waits, 0)
        for (f, view), seen in pixels.items():
            if f in waits and (home[f], view) in held:
                place = held[home[f], view]
                chosen = min(place, key=lambda m: (-place[m], m))
                together[f] += seen.get(chosen, 0) / sum(seen.values())
                views[f] += 1
        joins = {i for i in waits if views[i] and 1 + together[i] > (1 + views[i]) / 2 + 1e-6}
        joins = joins or {i for i in waits if not views[i]}
        waits -= joins
        if not joins:
            new = {o: max(home) + 1 + k for k, o in enumerate(sorted({home[i] for i in waits}))}
            for i in waits:
                home[i] = new[home[i]]
            start()
    return home


def test_keeping_together_equals_loops():
    rng = np.random.default_rng(3)
    for count in (12, 40):
        home = rng.integers(0, 4, count)
        rows = [(v, f, m, rng.integers(1, 9)) for v in range(6) for f in range(count) for m in (1, 2, 3) if rng.random() < 0.25]
        seen = Sightings(*np.array(rows, np.int64).T[:3], np.array([n for *_, n in rows], float))
        found = part_objects(home, seen)
        np.testing.assert_array_equal(found, grown_by_loops(home.tolist(), rows))
        assert len(np.unique(found)) > len(np.unique(home))


def test_what_the_views_hold_together_is_joined():
    joint, apart = [(0, 1, 100), (1, 1, 4), (2, 2, 30)], [(0, 1, 100), (1, 3, 4), (2, 2, 30)]
    np.testing.assert_array_equal(join_objects([5, 7, 6], seen_as(joint, joint, joint)), [5, 5, 6])
    np.testing.assert_array_equal(join_objects([5, 7, 6], seen_as(joint, joint)), [5, 7, 6])  # two views are too few
    np.testing.assert_array_equal(join_objects([5, 7, 6], seen_as(joint, joint, joint, joint, apart)), [5, 5, 6])
    np.testing.assert_array_equal(join_objects([5, 7, 6], seen_as(joint, joint, joint, apart)), [5, 7, 6])  # 0.75
    # A view in which an object is cut in two halves, or not seen, has no opinion.
    cut, gone = [(0, 1, 100), (1, 1, 2), (1, 3, 2), (2, 2, 30)], [(0, 1, 100), (2, 2, 30)]
    np.testing.assert_array_equal(join_objects([5, 7, 6], seen_as(joint, joint, joint, cut, gone)), [5, 5, 6])


def test_joining_goes_on_with_what_was_joined():
    """0 and 1 share a mask in views 0-2; 2 shares it with both, but was seen with 0 twice and with 1 twice only."""
    views = [[(0, 1, 9), (1, 1, 3)]] * 3 + [[(0, 1, 9), (2, 1, 4)]] * 2 + [[(1, 1, 3), (2, 1, 4)]] * 2
    np.testing.assert_array_equal(join_objects(np.arange(3), seen_as(*views)), [0, 0, 0])
    np.testing.assert_array_equal(join_objects(np.arange(3), seen_as(*views[2:])), [0, 1, 2])
    np.testing.assert_array_equal(join_objects(np.arange(4), seen_as(*views)), [0, 0, 0, 3])  # never seen: stays


def test_joining_equals_loops():
    rng = np.random.default_rng(8)
    things = rng.integers(0, 6, 30)
    rows = [
        (v, f, things[f] + 1 if rng.random() < 0.9 else 9, rng.integers(1, 9))
        for v in range(7)
        for f in range(30)
        if rng.random() < 0.6
    ]
    seen = Sightings(*np.array(rows, np.int64).T[:3], np.array([n for *_, n in rows], float))

    def main(objects, view):
        held = {}
        for v, f, m, n in rows:
            if v == view and f in objects:
                held[m] = held.get(m, 0) + n
        best = min(held, key=lambda m: (-held[m], m)) if held else None
        return best if held and held[best] > 0.5 * sum(held.values()) else None

    groups = [{f} for f in range(30)]
    while True:
        mains = [[main(group, v) for v in range(7)] for group in groups]
        links = []
        for a in range(len(groups)):
            for b in range(a):
                both = [(x, y) for x, y in zip(mains[a], mains[b], strict=True) if x is not None and y is not None]
                if len(both) >= 3 and sum(x == y for x, y in both) >= 0.8 * len(both):
                    links.append((a, b))
        if not links:
            break
        owner = list(range(len(groups)))
        for a, b in links:
            old, new = owner[a], owner[b]
            owner = [new if o == old else o for o in owner]
        groups = [set().union(*(g for g, o in zip(groups, owner, strict=True) if o == k)) for k in sorted(set(owner))]
    expected = np.empty(30, int)
    for group in groups:
        expected[list(group)] = min(group)
    assert 3 < len(groups) < 25
    np.testing.assert_array_equal(join_objects(np.arange(30), seen), expected)


# ------------------------------------------------------------------------------------------------------------- stability


def test_agreement_of_partitions():
    rng = np.random.default_rng(1)
    a, b, weight = rng.integers(0, 5, 400), rng.integers(0, 4, 400), rng.random(400)
    assert partition_agreement(a, (a + 2) % 5, weight)[0] == pytest.approx(1, abs=1e-12)
    assert abs(partition_agreement(a, b, weight)[0]) < 0.02
    assert partition_agreement(np.zeros(5, int), np.zeros(5, int), np.ones(5))[0] == 1
    # Against the definition over pairs of elements, self-pairs included (weights are masses, not counts).
    b = np.where(rng.random(400) < 0.3, b, a)
    w = np.outer(weight, weight)
    same_a, same_b = a[:, None] == a, b[:, None] == b
    both, p, q = (w[s].sum() for s in (same_a & same_b, same_a, same_b))
    expected = (both - p * q / w.sum()) / ((p + q) / 2 - p * q / w.sum())
    value, best = partition_agreement(a, b, weight)
    assert value == pytest.approx(expected, rel=1e-10)
    overlap = max(weight[(a == 2) & (b == j)].sum() / weight[(a == 2) | (b == j)].sum() for j in range(5))
    assert best[2] == pytest.approx(overlap, rel=1e-12)
    assert np.isnan(partition_agreement([0, 2], [0, 0], [1, 1])[1][1])
    with refused("weight"):
        partition_agreement(a, b, 0 * weight)


# ----------------------------------------------------------------------------------------------------- through the stage


def grid_box(low, high, inward, n):
    """A box whose sides have n x n squares: vertices, faces."""
    vertices, faces = [], []
    corners, triangles = own.box(low, high, inward)
    for quad in range(6):
        a, b, c = corners[triangles[2 * quad]]
        d = corners[np.setdiff1d(triangles[2 * quad + 1], triangles[2 * quad])[0]]
        o, s, t = (a, b - a, d - a) if np.allclose(a + c, b + d) else (b, c - b, a - b)
        u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
        first = sum(map(len, vertices))
        vertices.append(o + u.reshape(-1, 1) * s + v.reshape(-1, 1) * t)
        i = first + (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
        faces += [np.stack([i, i + n + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + 1], 1)]
    return np.concatenate(vertices), np.concatenate(faces)


def furnished():
    """A room with eight blocks, all of small faces; the thing of each face."""
    parts = [(grid_box(*own.ROOM, True, 24), 0)]
    rng = np.random.default_rng(5)
    for k in range(8):
        low = np.array([1.4 + 0.8 * (k % 4), -1.5 + 1.3 * (k // 4), 0.5])
        parts.append((grid_box(low, low + rng.uniform(0.3, 0.55, 3), False, 6), k + 1))
    vertices = np.concatenate([v for (v, _), _ in parts])
    offset = np.cumsum([0, *(len(v) for (v, _), _ in parts[:-1])])
    faces = np.concatenate([f + o for ((_, f), _), o in zip(parts, offset, strict=True)])
    return vertices, faces, np.concatenate([np.full(len(f), k) for (_, f), k in parts])


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """A furnished room seen by twelve cameras, capture done. Returns (root, things of faces, face map of every view)."""
    root = tmp_path_factory.mktemp("masks")
    path = own.project(root, segmentation={"kind": "masks", "colour": 0.0})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(own, "room_mesh", furnished)
        _, shots = own.photographed(path, 12, depth=False)
    things = furnished()[2]
    rng = np.random.default_rng(2)
    (path / "masks").mkdir()
    for i, (*_, face) in enumerate(shots):
        spoilt = spoil_masks(np.where(face >= 0, things[face], -1), rng)
        Image.fromarray(spoilt.astype(np.uint16)).save(path / f"masks/{i:03d}.png")
    capture = own.run(root, "capture", "segmentation")
    return root, path, things, capture


def segmentation_of(root):
    return StageReader(root / "results/own/segmentation", "segmentation", "own")


def test_what_was_parted_or_joined_is_of_masks_as_what_it_was_elected_into():
    home = np.array([0, 0, 0, 2, 2, 5])  # 5: a piece of the mesh that no mask sees
    label = np.array([0, 9, 9, 2, 2, 5])  # two faces of 0 were parted
    got, voted, agreement = masks._with_origin(label, home, np.array([0, 2]), np.array([0.5, 0.0, 0.9]))
    assert got.tolist() == [0, 3, 3, 1, 1, 2] and voted.tolist() == [True, True, False, True]
    np.testing.assert_allclose(agreement, [0.5, 0.9, 1.0, 0.5])
    _, voted, agreement = masks._with_origin(np.zeros(6, int), home, np.array([0, 2]), np.array([0.5, 0.0, 0.9]))
    assert voted.tolist() == [True] and agreement[0] == pytest.approx((3 * 0.5 + 2 * 0.9 + 1) / 6)


def test_faces_of_one_object_and_one_piece_are_parted_or_joined_as_one():
    """Three views hold objects 0 and 1 in one mask, and the two pieces of object 2 in two."""
    label, piece = np.array([0, 0, 1, 2, 2]), np.array([0, 0, 1, 0, 3])
    face, mask = np.array([[0, 1, 2, 3, 4, -1]]), np.array([[1, 1, 1, 2, 3, 2]])
    maps = SimpleNamespace(face=face, hit=face >= 0)
    surface = SimpleNamespace(decoded=SimpleNamespace(maps=lambda view, photograph: maps))
    united, parted, joined = masks._part_and_join(surface, [0, 1, 2], lambda view: mask, label, piece)
    assert united.tolist() == [0, 0, 0, 2, 3] and (parted, joined) == (1, 1)


@pytest.mark.long
def test_spoilt_masks_make_pure_objects(photographed):
    root, _, things, capture = photographed
    vertices, faces = capture.mesh()
    reader = segmentation_of(root)
    label = reader.table("faces.parquet")["object_id"]
    seen = np.zeros(len(faces), bool)
    for view in capture:
        face = capture.gbuffer(view)[1]
        seen[face[face >= 0]] = True
    pure, complete = purity(np.repeat(label[seen], 3), np.repeat(things[seen], 3))
    assert pure >= 0.95 and complete >= 0.9
    document = reader.json("segmentation.json")
    assert document["masks_undersegmented"] > 0 and document["objects_from_masks"] >= 9
    assert document["objects_parted"] == document["objects_joined"] == 0  # the clusters of this scene are complete
    assert 0.6 < document["stability"] <= 1 and len(document["stability_runs"]) == 3
    (item,) = document["plan"]
    assert item["component"] == "objects (masks)" and item["value"] == document["stability"]
    objects = reader.table("objects.parquet")
    assert ((objects["stability"] >= 0) == (objects["pixels"] > 0)).mean() > 0.9


def test_binary_masks_say_the_same_as_a_label_map(photographed, tmp_path):
    from workflow.segmentations.mask_files import mask_files

    _, path, _, capture = photographed
    settings = own.settings_of(path)
    maps = mask_files({"path": None}, settings["source"], settings["capture"])
    for view in list(capture)[:2]:
        stored = np.asarray(Image.open(path / f"masks/{view.name}.png"))
        np.testing.assert_array_equal(maps.labels(view), stored)
        corrected = replace(view, fx=1.01 * view.fx, cx=view.cx + 3)  # intrinsics that registration found: the same pixels
        np.testing.assert_array_equal(maps.labels(corrected), stored)
        here = tmp_path / "masks" / view.name
        here.mkdir(parents=True)
        for k in range(1, stored.max() + 1):
            Image.fromarray(np.where(stored == k, 255, 0).astype(np.uint8)).resize((128, 96), 0).save(here / f"{k:04d}.png")
    files = mask_files({"path": str(tmp_path)}, settings["source"], settings["capture"])
    for view in list(capture)[:2]:
        np.testing.assert_array_equal(files.labels(view), maps.labels(view))
    assert not files.labels(SimpleNamespace(**{**vars(capture.views[5])})).any()


def test_masks_follow_the_lens(tmp_path, monkeypatch):
    """Masks of a distorted photograph match the undistorted view of the mesh better than ids that capture resampled twice."""
    from iif_core.camera.distortion import Distortion
    from workflow.segmentations.mask_files import mask_files

    path = own.project(tmp_path, capture={"width": 64, "height": 48})
    monkeypatch.setattr(own, "room_mesh", furnished)
    square = np.arange(len(furnished()[1])) % 576  # patches of 6 x 6 squares of the walls
    patch = 1 + np.arange(len(square)) // 1152 * 16 + square // 24 // 6 * 4 + square % 24 // 6
    things = furnished()[2]
    patch = np.r_[np.where(things > 0, 1000 + things, patch), 0]  # the last: a miss
    path = own.project(tmp_path)
    document, shots = own.photographed(
        path, 2, depth=False, lens=Distortion("radial_tangential", (-0.4, 0, 0, 0), (0.002, -0.001))
    )
    own.write_transforms(path, {**document, "camera_model": "OPENCV", "k1": -0.4, "k2": 0, "p1": 0.002, "p2": -0.001})
    for folder in ("instances", "masks"):
        (path / folder).mkdir()
        for i, (*_, face) in enumerate(shots):
            Image.fromarray(patch[face].astype(np.uint16)).save(path / f"{folder}/{i:03d}.png")
    capture = own.run(tmp_path, "capture")
    settings = own.settings_of(path)
    files = mask_files({"path": None}, settings["source"], settings["capture"])
    for view in capture:
        there = patch[capture.gbuffer(view)[1]]
        found, given = (files.labels(view) == there).mean(), (np.maximum(capture.given_instances(view), 0) == there).mean()
        straight = np.asarray(Image.open(path / f"masks/{view.name}.png"))[: view.height, : view.width]
        assert found > 0.9 and found >= given and (straight == there).mean() < 0.85


@pytest.mark.parametrize(
    ("spoil", "names"),
    [
        (lambda p: [f.unlink() for f in p.iterdir()], ["masks", "masks/<view>.png", "masks/<view>/<n>.png"]),
        (
            lambda p: [f.unlink() for f in p.iterdir()] + [p.rmdir()],
            ["segmentation: {kind: masks}", "segmentation.path"],
        ),
        (lambda p: (p / "000.png").rename(p / "kitchen.png"), ["masks", "kitchen", "000", "mask_path"]),
        (lambda p: own.save_png(p / "001/0.png", np.ones((48, 64, 3))), ["masks", "001/", "001.png"]),
        (lambda p: (p / "001.png").rename(p / "001.tif"), ["masks/001.tif", "<view>.png", "<view>.exr"]),
        (lambda p: [(p / "001.png").unlink(), (p / "001").mkdir()], ["masks/001", ".png"]),
        (lambda p: Image.new("L", (64, 64)).save(p / "001.png"), ["masks/001.png", "64x64", "64x48"]),
        (lambda p: Image.new("RGB", (64, 48)).save(p / "001.png"), ["masks/001.png", "16-bit", "EXR"]),
        (lambda p: (p / "001.png").write_bytes(b"no"), ["masks/001.png", "PNG, JPEG"]),
    ],
)
def test_what_is_refused(tmp_path, spoil, names):
    from workflow.segmentations.mask_files import mask_files

    own.bare(tmp_path, 3)
    (tmp_path / "masks").mkdir()
    for i in range(3):
        Image.new("I;16", (64, 48)).save(tmp_path / f"masks/{i:03d}.png")
    spoil(tmp_path / "masks")
    settings = own.settings_of(tmp_path)
    with refused(*names):
        files = mask_files({"path": None}, settings["source"], settings["capture"])
        for name in files.maps:  # what only pixels can tell
            from workflow.scene.normal_form import View

            files.labels(View(0, name, 64, 48, 60.0, 62.0, 33.0, 23.0, np.eye(4)))


def test_masks_without_a_single_mask_are_refused(photographed, tmp_path):
    root, path, _, _ = photographed
    import shutil

    shutil.copytree(root, tmp_path / "copy")
    for file in (tmp_path / "copy/data/own/masks").iterdir():
        Image.new("I;16", (64, 48)).save(file)
    with refused("segmentation: {kind: masks}", 4):
        own.run(tmp_path / "copy", "capture", "segmentation")


def test_a_given_segmentation_of_faces_has_nothing_to_perturb(tmp_path):
    path = own.project(tmp_path, segmentation={"kind": "given"})
    own.photographed(path, 2, depth=False)
    vertices, faces, thing = own.room_mesh()
    own.save_mesh(path / "mesh.ply", vertices, faces, thing)
    own.run(tmp_path, "capture", "segmentation")
    document = segmentation_of(tmp_path).json("segmentation.json")
    assert document["stability"] is None and document["plan"][0]["measure"] == "ids taken as they are"
    assert (segmentation_of(tmp_path).table("objects.parquet")["stability"] == -1).all()


def test_sparse_matrices_are_what_they_say():
    """`planted` and `gather_masks` make rows sorted by view: containment relies on it."""
    masks = planted([[1, 2, 2], [3, 3, 0]])
    assert isinstance(masks.in_mask, csr_matrix) or masks.in_mask.format == "csr"
    assert (np.diff(masks.view) >= 0).all() and masks.in_mask.shape == (3, 3)
