"""Lamps that no camera sees: which surface may hide them, how well light explains the photographs, and the search."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.gains import BaseAlbedo
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.hidden import MAX_HIDDEN, MIN_HITS, with_hidden_surface
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import EmissionProblem, reflecting_rows
from iif_core.light.emission.pruning import WhiteSurface
from iif_core.light.emission.rows import TracedTransport
from iif_core.light.emission.search import STEP, Candidates, Proposal, search
from tests.unit.emission_systems import rows_of


def _groups(of_face):
    of_face = np.asarray(of_face, np.int32)
    n = int(of_face.max(initial=-1)) + 1
    return EmitterGroups(of_face, np.where(of_face >= 0, 1, 0), *[np.ones(n)] * 2, np.ones((n, 3)), np.full(n, 50), [])


def test_hidden_objects_are_one_group_each_and_only_where_rays_arrive():
    """Faces: a lamp in sight and its far side, two unseen objects, one hardly in sight of others, one seen in part, no object."""
    groups = _groups([0, -1, -1, -1, -1, -1, -1, -1, -1])
    object_id = np.array([0, 0, 1, 1, 4, 2, 3, 3, -1])
    seen = np.array([True, False, False, False, False, False, True, False, False])
    hits = np.array([90, 5, 3, 4, 9, MIN_HITS - 1, 50, 50, 80])
    out = with_hidden_surface(groups, seen, object_id, np.arange(1.0, 10.0), hits)
    assert out.of_face.tolist() == [0, -1, 2, 2, 1, -1, -1, -1, -1]  # more rays meet object 4
    assert out.is_hidden.tolist() == [False, True, True] and out.faces.tolist() == [1, 1, 2] and out.area.tolist() == [1, 5, 7]
    assert (out.observed[1:] == 0).all() and (out.side[2:5] == 0).all()
    assert with_hidden_surface(groups, seen | True, object_id, np.ones(9), hits) is groups
    many = MAX_HIDDEN + 9
    out = with_hidden_surface(
        _groups(np.full(many, -1)), np.zeros(many, bool), np.arange(many), np.ones(many), 10 + np.arange(many)
    )
    assert out.size == MAX_HIDDEN and (out.of_face[:9] == -1).all()  # the least in sight are left out


def _problem(matrix, observed, cached=0.0, owner=0, anchor=False, pixels=1.0, bound=False):
    rows = rows_of(matrix, observed=observed, cached=(cached,))
    n = len(rows.observed)
    rows = replace(rows, lower_bound=np.broadcast_to(np.reshape(bound, (-1, 1)), (n, 3)))
    return EmissionProblem(rows, *(np.broadcast_to(part, (n,)) for part in (owner, anchor, np.asarray(pixels, float))))


def test_misfit_by_hand():
    """Two rows of 1 and 3 pixels, y = 1, predicted 1 and 3; the floor is a twentieth of the median."""
    matrix, one = np.ones((2, 1, 3)), np.ones((1, 3))
    problem = _problem(matrix, np.ones((2, 3)), cached=np.array([[0.0] * 3, [2.0] * 3]), pixels=[1, 3])
    expected = 0.75 * (2 / (0.5 * (1 + 3) + 0.05)) ** 2
    assert problem.misfit(one) == pytest.approx(expected)
    assert replace(problem, anchor=np.array([False, True])).misfit(one) == 0
    met = _problem(matrix, np.ones((2, 3)), cached=np.array([[0.0] * 3, [2.0] * 3]), bound=[False, True])
    assert met.misfit(one) == 0  # a lower bound that is met
    assert met.misfit(0 * one) == pytest.approx(0.5 * (1 / 0.55) ** 2)
    assert replace(problem, anchor=np.array([True, True])).misfit(one) == 0


def test_noise_of_the_traces_does_not_count_as_misfit():
    rng = np.random.default_rng(0)
    n, a = 40_000, 1.0
    noisy = [np.full((n, 1, 3), a) + 0.2 * rng.standard_normal((n, 1, 3)) for _ in range(2)]
    problem = _problem(tuple(noisy), np.full((n, 3), 2.0))
    assert abs(problem.misfit(np.full((1, 3), 2.0))) < 2e-3  # 0.04 if one trace were squared
    assert problem.misfit(np.full((1, 3), 3.0)) == pytest.approx((1 / 2.6) ** 2, rel=0.15)  # the scale is noisy


_RADIANCE = st.just(0.0) | st.floats(1e-6, 1e6)


@given(st.floats(1e-12, 1e12), _RADIANCE, _RADIANCE)
def test_misfit_has_no_units_and_is_bounded(scale, seen, light):
    scaled, plain = (
        _problem(np.ones((3, 1, 3)), np.full((3, 3), seen * k)).misfit(np.full((1, 3), light * k)) for k in (scale, 1)
    )
    assert 0 <= scaled <= 4 and scaled == pytest.approx(plain, rel=1e-4, abs=1e-9)


def test_rows_beside_one_another_and_some_of_them():
    rng = np.random.default_rng(1)
    first, second = (_problem(rng.random((n, 2, 3)), rng.random((n, 3)), owner=n, pixels=n) for n in (4, 3))
    both = first.beside(second)
    for part, rows in ((first, np.arange(4)), (second, np.arange(4, 7))):
        again = both.take(rows)
        np.testing.assert_array_equal(again.rows.matrix, part.rows.matrix)
        np.testing.assert_array_equal(again.rows.observed, part.rows.observed)
        assert again.owner.tolist() == part.owner.tolist() and again.pixels.tolist() == part.pixels.tolist()


def test_pixels_on_a_group_as_if_it_reflected():
    group, tile = np.array([0, 0, 1]), np.zeros(3, int)
    pixels = EmissionPixels(
        radiance=np.arange(9.0).reshape(3, 3),
        bound=np.zeros((3, 3), bool),
        object_id=np.full(3, 7),
        view=tile,
        tile=tile,
        group=group,
    )
    transport = TracedTransport(np.ones((2, 2, 3, 2, 3), np.float32), np.zeros((2, 2, 3, 3), np.float32))
    rows, of_group = reflecting_rows(pixels, transport, 2)
    assert of_group.tolist() == [0, 1] and rows.owner.tolist() == [7, 7] and not rows.anchor.any()
    assert rows.pixels.tolist() == [2, 1] and rows.rows.observed[0].tolist() == [1.5, 2.5, 3.5]


def _room(strip, reflects=0.1, seed=3):
    """A ceiling and four other objects under a lamp in sight (column 0) and a strip that no camera sees (column 2). Column 1 is a
    patch of the ceiling next to the strip; the patch looks like a lamp. Column 3 is unseen surface that is dark. The light of the
    patch on the other rows is what it reflects. A white surface in the place of hidden ones would show `reflects`."""
    rng = np.random.default_rng(seed)
    n, lamp, e = 4000, 6.0, 9.0 * strip
    owner = rng.integers(0, 5, n)
    albedo = np.array([0.8, 0.3, 0.5, 0.2, 0.6])
    form = rng.uniform(0.02, 0.1, (n, 4)) * [1.0, 0.3, 0.0, 0.1]
    near = (owner == 0) & (rng.random(n) < 0.3)
    form[near, 2], form[near, 1] = rng.uniform(0.05, 0.3, near.sum()), 0.0  # the strip lights the ceiling, its patch does not
    patch_form = np.array([0.05, 0.0, 0.4, 0.0])
    patch = 0.8 * (patch_form @ [lamp, 0, e, 0])
    light = form @ [lamp, patch, e, 0.0]
    y = albedo[owner] * light * np.exp(0.1 * rng.standard_normal(n))
    guess = albedo * np.exp(0.15 * rng.standard_normal(5))

    def columns(of, form, owner):
        a = (guess[owner][:, None] * form)[:, :, None] * np.ones(3)
        noise = [1 + 0.2 * rng.standard_normal(a.shape) for _ in range(2)]
        return _problem(tuple(a * k for k in noise), y_of(of), owner=owner)

    def y_of(values):
        return values[:, None] * np.ones(3)

    problem = columns(y, form, owner)
    seen = np.zeros((2, 4, 3))
    seen[[0, 1], [0, 1]] = 1.0
    anchors = _problem(seen, np.array([[lamp] * 3, [patch] * 3]), owner=-1, anchor=True)
    anchors = replace(anchors, rows=replace(anchors.rows, weight=np.full((2, 3), 1e4)))
    own = np.repeat([0, 1], 40)
    mine = np.where(own[:, None] == 0, [0.0, 0.1, 0.0, 0.0], patch_form)
    reflecting = columns(np.where(own == 0, lamp, patch), mine, np.where(own == 0, 1, 0))
    prior = EmissionPrior(np.array([lamp, patch, 0.1, 0.1])[:, None] * np.ones(3), np.array([5.0, 5.0, 300.0, 300.0]))
    shown = np.array([lamp, patch, 0.0, 0.0])[:, None] * np.ones(3)
    hidden = np.array([False, False, True, True])
    white = WhiteSurface(np.zeros((4, 3)), np.zeros((4, 4, 3)), np.full((4, 3), reflects))
    base, usual = BaseAlbedo(guess[:, None] * np.ones(3)), np.ones(4)
    return Candidates(problem.beside(anchors), reflecting, own, prior, np.arange(4), hidden, shown, white, base, 2.0, usual)


def _growth(candidates, *chosen, doubtful=()):
    """Proposals as families -> the growth of the misfit that they may have, in order."""
    found = candidates.proposals(frozenset(chosen), frozenset(doubtful))
    return {proposal.families: proposal.largest_growth for proposal in found}


def test_a_strip_that_no_camera_sees_takes_the_place_of_what_it_lights():
    proposals = [*_growth(_room(1.0), 0, 1)]
    assert proposals[0] in ({0, 2}, {0, 1, 2}) and {0, 2} in proposals
    assert not any(3 in families or 0 not in families for families in proposals)


def test_surface_no_brighter_than_white_may_be_taken_out_though_the_misfit_grows():
    """The patch shows 0.8 of what a white one would under lamp and strip; under the lamp alone it shows more than that."""
    assert _growth(_room(1.0), 0, 1, 2)[frozenset({0, 2})] == pytest.approx(1.5)
    assert _growth(_room(0.001), 0, 1, doubtful=[1])[frozenset({0})] == pytest.approx(1.5)
    dim, lamp = _room(1.0), frozenset({0})
    twice = replace(dim.reflecting, rows=replace(dim.reflecting.rows, observed=2 * dim.reflecting.rows.observed))
    assert _growth(replace(dim, reflecting=twice), 0, 1, 2).get(frozenset({0, 2}), 0.0) < 1.0
    assert lamp not in _growth(dim, 0)  # nothing else would shine


def _alone(candidates, *chosen, certain):
    """Families proposed in place of the chosen ones -> whether they may also shine with nothing in the place of others."""
    found = replace(candidates, certain=certain).proposals(frozenset(chosen), frozenset({1}))
    return {proposal.families: proposal.alone for proposal in found}


def test_surface_that_nothing_else_makes_so_bright_stays():
    """The patch shows 0.88 of what a white one would under lamp and strip, and 10.4 times that of the lamp alone."""
    room, lamp_and_strip = _room(1.0), frozenset({0, 2})
    assert lamp_and_strip in _alone(room, 0, 1, 2, certain=0.9) and lamp_and_strip not in _alone(room, 0, 1, 2, certain=0.8)
    # In the place of the patch the strip may shine, which lights it well enough; the lamp alone does not.
    assert _alone(room, 0, 1, certain=10.0)[lamp_and_strip] is False and _alone(room, 0, 1, certain=11.0)[lamp_and_strip] is True
    assert lamp_and_strip not in _alone(room, 0, 1, certain=0.8)


def test_what_no_camera_sees_may_go_again():
    """Nothing says how bright the strip and the wrong surface would look, so that they are no lamps for certain."""
    assert {frozenset({0, 2}), frozenset({0})} <= _alone(_room(1.0), 0, 3, certain=0.1).keys()


def test_the_only_family_stays_where_light_from_outside_does_not_make_it_so_bright():
    room = _room(1.0)
    outside = replace(room, family=np.array([-1, 0, 1, 2]))  # the light of the lamp comes from outside
    assert [_alone(outside, 0, certain=certain)[frozenset({1})] for certain in (10.0, 11.0)] == [False, True]


def test_what_cannot_go_alone_is_not_compared_with_nothing_in_its_place():
    every, alone, swapped = frozenset({0, 1}), frozenset({0}), frozenset({0, 2})
    values = {every: 1.0, alone: 0.01, swapped: 0.5}

    def chosen(**kind):
        return search(every, lambda now: [Proposal(swapped, **kind)] if now == every else [], values.__getitem__)[0]

    assert chosen() == alone and chosen(alone=False) == swapped


def test_saturated_surface_is_judged_by_a_trace_of_its_own():
    """Without the patch the misfit of the look grows, because how bright it is when it reflects is not known."""
    room = _room(1.0)
    bounds = replace(room.reflecting.rows, lower_bound=np.ones(room.reflecting.rows.lower_bound.shape, bool))
    dark = replace(room, shown=room.shown * [[1.0], [0.5], [1.0], [1.0]])
    assert frozenset({0, 2}) not in _growth(dark, 0, 1, 2)
    assert frozenset({0, 2}) in _growth(replace(dark, reflecting=replace(room.reflecting, rows=bounds)), 0, 1, 2)


def test_what_could_take_the_place_of_a_suspect_is_always_traced():
    """The look says that the room is worse without the lamp and with another family in its place; a trace has to say so."""
    room = _room(1.0)
    every = {p.families: p for p in room.proposals(frozenset({0, 1}), suspects=frozenset({0}))}
    always = {families for families, proposal in every.items() if proposal.always}
    assert always and all(0 not in families and 1 in families and len(families) == 2 for families in always)
    assert not any(p.always for p in room.proposals(frozenset({0, 1})))
    assert always - set(_growth(room, 0, 1))  # which the look alone would not have offered
    # Neither their number nor their rank matters to the search.
    traced: list[frozenset[int]] = []

    def misfit(families):
        traced.append(families)
        return 0.2 if families == {7} else 1.0

    first = [Proposal(frozenset({f})) for f in (3, 4, 5)]
    found, changes = search(frozenset({0}), lambda c: [*first, Proposal(frozenset({7}), always=True)] if c == {0} else [], misfit)
    assert found == {7} and len(changes) == 1 and frozenset({5}) not in traced


def test_all_that_is_unlikely_is_always_traced_as_gone():
    """The patch and dark unseen surface; the lamp is likely, or the patch shines for certain, or one alone is unlikely."""
    room = replace(_room(1.0), certain=11.0)

    def always(unlikely, chosen=(0, 1, 3), room=room):
        found = room.proposals(frozenset(chosen), unlikely=frozenset(unlikely))
        return {p.families: p.largest_growth for p in found if p.always}

    assert always({1, 3}) == {frozenset({0}): 1.0}
    assert always({1, 2, 3}) == always({1, 3})  # what does not shine counts for nothing
    assert not always({1}) and not always(())
    bright = replace(room, certain=2.0)  # the patch shines for certain, so the lamp alone is no proposal of any kind
    assert frozenset({0}) not in {p.families for p in bright.proposals(frozenset({0, 1, 3}), unlikely=frozenset({1, 3}))}
    assert not always({0, 1, 3})  # something in a closed room shines
    outside = replace(room, family=np.array([-1, 0, 1, 2]))
    assert always({0, 2}, (0, 2), outside) == {frozenset(): 1.0}


def test_unseen_surface_that_a_white_one_could_match_is_no_lamp():
    assert not any(2 in families for families in _growth(_room(1.0, reflects=1e3), 0, 1))


def test_a_room_that_is_explained_is_left_alone():
    assert _growth(_room(0.0), 0) == {}


def test_an_unlikely_family_must_explain_more_and_a_likely_one_less():
    """Family 2 may be added, but not if the misfit with it counts a hundredfold; family 1 may go, but not if it is likely."""
    room = _room(1.0)
    growth = next(value for families, value in _growth(room, 0, 1).items() if 2 in families)
    assert growth == 1 - STEP
    unlikely = replace(room, weights=np.array([1.0, 1.0, 100.0, 1.0]))
    assert not any(2 in families for families in _growth(unlikely, 0, 1))
    assert unlikely.weight(frozenset({1, 2})) == 100.0 and unlikely.weight(frozenset()) == 1.0
    gone = frozenset({0, 2})
    # White surface would be as bright as family 1, which makes it easier to take out, but not if it is likely.
    slightly = _growth(replace(room, weights=np.array([1.0, 1.0 - 1e-9, 1.0, 1.0])), 0, 1, 2)
    assert _growth(room, 0, 1, 2)[gone] == pytest.approx(1.5) and slightly[gone] == 1 - STEP
    likely = replace(room, weights=np.array([1.0, 1e-3, 1.0, 1.0]))
    assert gone in _growth(room, 0, 1, 2) and gone not in _growth(likely, 0, 1, 2)


def test_an_unseen_likely_lamp_that_white_surface_would_match_does_not_end_the_search():
    """Family 3 is dark and a white surface in its place bright: with it nothing else could be compared."""
    room = _room(1.0)
    cached = room.white.cached.copy()
    cached[3] = 100.0
    bright = replace(room, white=replace(room.white, cached=cached))
    assert not any(2 in families for families in _growth(bright, 0, 3))
    likely = replace(bright, weights=np.array([1.0, 1.0, 1.0, 0.86]))
    assert any(2 in families for families in _growth(likely, 0, 3))


def test_search_compares_weighted_misfits():
    misfit = {frozenset({0}): 1.0, frozenset({0, 1}): 0.9, frozenset({0, 2}): 0.8}.__getitem__
    proposed = [Proposal(frozenset({0, 1})), Proposal(frozenset({0, 2}))]

    def run(weights):
        return search(
            frozenset({0}),
            lambda now: proposed if now == {0} else [],
            misfit,
            lambda families: float(np.prod([weights.get(f, 1.0) for f in families])),
        )[0]

    assert run({}) == {0, 2}
    assert run({2: 1.2}) == {0, 1}  # 0.96 of 1.0 is not enough
    assert run({2: 1.2, 1: 1.1}) == {0}
    assert run({1: 0.8}) == {0, 1}
    assert run({0: 1e6}) == {0, 2}  # what both have does not matter


def test_search_takes_the_simplest_of_what_is_better():
    scores = {(0, 1): 1.0, (0,): 0.90, (0, 2): 0.89, (0, 3): 0.5, (0, 2, 3): 0.49, (1,): 0.97}
    misfit = {frozenset(key): value for key, value in scores.items()}.__getitem__
    start = frozenset({0, 1})

    def run(*proposed, growth=1 - STEP):
        found = [Proposal(frozenset(p), growth) for p in proposed]
        return search(start, lambda chosen: found if chosen == start else [], misfit)

    assert run() == (start, [])
    # What takes the place of family 1 is compared with nothing in its place, which no proposal named.
    assert run((0, 2)) == (frozenset({0}), [(frozenset({0}), 1.0, 0.90)])
    assert run((0, 2, 3), (0, 3))[0] == {0, 3}
    assert run((1,))[0] == start and scores[(1,)] > 1 - STEP
    assert run((1,), growth=1.0)[0] == {1} and run((1,), growth=0.96)[0] == start


def test_what_was_taken_out_although_the_misfit_grew_does_not_come_back():
    both, lamp = frozenset({0, 1}), frozenset({0})

    def proposals(chosen):
        return [Proposal(lamp, 1.5)] if chosen == both else [Proposal(both)]

    assert search(both, proposals, {both: 1.0, lamp: 1.4}.__getitem__) == (lamp, [(lamp, 1.0, 1.4)])
    assert search(both, proposals, {both: 1.0, lamp: 1.6}.__getitem__) == (both, [])


def test_search_ends():
    """Every proposal is better than the one before; the number of changes is limited."""

    def worth(families):
        return 0.5 ** max(families, default=-9)

    chosen, changes = search(frozenset({0}), lambda families: [Proposal(frozenset({max(families) + 1}))], worth)
    assert len(changes) == 4 and chosen == {4}


def alone(family):
    return frozenset({family})


def test_what_is_needed_is_what_others_cannot_explain():
    room = _room(1.0)
    needed = room.needed(frozenset({0, 2}), alone)
    assert set(needed) == {0, 2} and needed[2] > 0.3
    left, both = (room._look(frozenset(families)) for families in ([0], [0, 2]))
    assert needed[2] == pytest.approx(np.log(left.misfit / both.misfit))
    # Unseen surface that a white one could match cannot be a lamp; neither set can then, and nothing is known.
    assert _room(1.0, reflects=1e3).needed(frozenset({2, 3}), alone) == {2: 0.0, 3: 0.0}


def test_lamps_of_one_kind_are_needed_together():
    """Each of two halves of a lamp is hardly needed where the other is; together they are."""
    room = _room(1.0)
    one, both = (room.needed(frozenset({0, 2}), kind) for kind in (alone, lambda f: frozenset({0, 2})))
    assert both[0] == both[2] > max(one.values())
