"""Groups of places that do not light each other, on graphs whose answer is known by construction.

The cell size and the limits were set on the simulated groove of opening 95°; none of these places was used for that.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from scanner.groups import group_places
from scanner.regions import between_paths, emitter_mask


def square(left, top, side=64, step=1.5):
    """Coordinates of a camera that samples a square of the projector's picture."""
    x, y = np.meshgrid(np.arange(left, left + side, step), np.arange(top, top + side, step))
    return x.ravel().astype(np.float32), y.ravel().astype(np.float32)


def scene(arrows, places, seed=0):
    """Squares at ``places``; square i is lit by square ``arrows[i]``, mirrored, or by none."""
    rng = np.random.default_rng(seed)
    x, y, bounce_x, bounce_y, part = [], [], [], [], []
    for number, (place, source) in enumerate(zip(places, arrows, strict=True)):
        u, v = square(*place)
        x.append(u)
        y.append(v)
        part.append(np.full(u.size, number))
        if source is None:
            bounce_x.append(np.full(u.size, np.nan))
            bounce_y.append(np.full(u.size, np.nan))
        else:
            left, top = places[source]
            bounce_x.append(left + 63 - (u - place[0]) + rng.normal(0, 1, u.size))
            bounce_y.append(top + (v - place[1]) + rng.normal(0, 1, u.size))
    return [np.concatenate(a).astype(np.float32) for a in (x, y, bounce_x, bounce_y)], np.concatenate(part)


PLACES = [(40, 40), (240, 40), (40, 240), (240, 240)]


@pytest.mark.parametrize(
    ("arrows", "fewest"),
    [
        ((None, None, None, None), 1),
        ((1, 0, None, None), 2),
        ((1, 0, 3, 2), 2),
        ((1, 2, 3, 0), 2),
        ((1, 2, 0, None), 3),
    ],
    ids=["nobody lights", "a pair", "two pairs", "a ring of four", "a ring of three"],
)
def test_the_fewest_groups_in_which_nobody_lights_another(arrows, fewest):
    coordinates, part = scene(arrows, PLACES)
    group = group_places(*coordinates, 8)
    assert len(set(group[group >= 0].tolist())) == fewest
    assert (group >= 0).mean() > 0.98
    # Who lies at the source of a pixel must be of another group; the nearest neighbour is asked, not a cell.
    x, y, bounce_x, bounce_y = coordinates
    lit = np.isfinite(bounce_x)
    if lit.any():
        _, there = KDTree(np.stack([x, y], axis=1)).query(np.stack([bounce_x, bounce_y], axis=1)[lit])
        assert (group[there] == group[lit]).mean() < 0.03
    if fewest < 3:
        # No square is cut up where it need not be.
        for k in range(4):
            counts = np.bincount(group[(part == k) & (group >= 0)])
            assert counts.max() / counts.sum() > 0.95


def test_both_faces_of_a_fold_take_turns_though_they_are_one_surface():
    # One sheet of coordinates, folded at x = 200: each side lights its mirror image on the other.
    x, y = square(100, 50, side=200)
    group = group_places(x, y, 400 - x, y + 3, 8)
    assert group.max() == 1
    left, right = x < 190, x > 210
    for side in (left, right):
        assert max((group[side] == k).mean() for k in (0, 1)) > 0.98
    assert np.median(group[left]) != np.median(group[right])


def test_no_more_groups_than_allowed_and_the_largest_first():
    coordinates, _ = scene((1, 2, 0, None), PLACES)
    assert group_places(*coordinates, 1).max() == 0
    group = group_places(*coordinates, 2)
    assert group.max() == 1
    sizes = np.bincount(group[group >= 0])
    assert sizes[0] >= sizes[1]


def test_bounces_from_outside_the_region_need_no_second_group():
    coordinates, _ = scene((None,) * 4, PLACES)
    x, y = coordinates[:2]
    assert group_places(x, y, x + 400, y, 8).max() == 0


def test_unknown_places_have_no_group():
    coordinates, _ = scene((1, 0, None, None), PLACES)
    coordinates[0][:50] = np.nan
    group = group_places(*coordinates, 4)
    assert (group[:50] == -1).all()
    nothing = np.full(3, np.nan, np.float32)
    assert (group_places(nothing, nothing, nothing, nothing, 4) == -1).all()


def test_an_emitter_is_where_many_bounces_come_from():
    x, y = square(100, 60, side=40, step=0.5)
    stray_x, stray_y = square(116, 60, side=40, step=2.4)
    stray = stray_x > 142
    both = np.append(x, stray_x[stray]), np.append(y, stray_y[stray])
    mask = emitter_mask(*both, (300, 200), 3)
    assert mask[60:98, 98:140].all()
    assert not mask[:, 148:].any()


def test_between_close_paths_others_meet_unseen():
    y, x = (a.ravel().astype(np.float32) for a in np.mgrid[50:90, 100:130])
    mask = between_paths(x, y, 260 - x, y, (300, 200), 32)
    assert mask[52:88, 122:138].all()
    # Farther than 32 px apart nothing is said of what lies between.
    assert not mask[:, :110].any()
    # Paths of this fold at 130 px are mirror images of each other: half of the way ends there.
    half = between_paths(x, y, 260 - x, y, (300, 200), 32, 0.5)
    assert half[52:88, 116:129].all()
    assert not half[:, 132:].any()


def with_faces(arrows, places, astray=0.0, seed=1):
    """`scene`, its squares as faces 1, 2, …; a share of all pixels takes another of the face for its source."""
    coordinates, part = scene(arrows, places, seed)
    rng = np.random.default_rng(seed)
    for number in range(len(places)):
        mine = np.flatnonzero(part == number)
        wrong = mine[rng.random(mine.size) < astray]
        other = rng.choice(mine, wrong.size)
        for k in (0, 1):
            coordinates[2 + k][wrong] = coordinates[k][other]
    return coordinates, part


def test_a_face_is_not_cut_for_bounces_that_seem_to_come_from_itself():
    coordinates, part = with_faces((1, 0, None, None), PLACES, astray=0.2)
    group = group_places(*coordinates, 8, (part + 1).astype(np.int32))
    assert [len(np.unique(group[part == k])) for k in range(4)] == [1, 1, 1, 1]
    assert np.median(group[part == 0]) != np.median(group[part == 1])
    # Without faces the same pixels fall into bits.
    assert len(np.unique(group_places(*coordinates, 8)[part == 2])) > 1


def test_a_hollow_face_is_cut():
    x, y = square(100, 50, side=200)
    group = group_places(x, y, 400 - x, y + 3, 8, np.ones(x.shape, np.int32))
    assert np.median(group[x < 190]) != np.median(group[x > 210])


@pytest.mark.parametrize("most", [4, 2])
def test_faces_that_suffer_least_share_a_sequence(most):
    # Two light each other, and the third one a little: the first less than the second.
    places = [(40, 40), (240, 40), (40, 240)]
    (x, y, bounce_x, bounce_y), part = scene((1, 0, None), places)
    third = np.flatnonzero(part == 2)
    for some, right in ((third[:200], 0), (third[200:800], 200)):
        bounce_x[some], bounce_y[some] = x[some] + right, y[some] - 200
    group = group_places(x, y, bounce_x, bounce_y, most, (part + 1).astype(np.int32))
    assert [len(np.unique(group[part == k])) for k in range(3)] == [1, 1, 1]
    assert len(np.unique(group)) == min(most, 3)
    assert group[part == 0][0] != group[part == 1][0]
    if most == 2:
        assert group[part == 2][0] == group[part == 0][0]


def test_at_a_crease_the_other_face_throws_the_bounce():
    # A cell along the fold holds pixels of both faces, more of the left one, which is lit from just beyond the fold.
    x, y = square(100, 50, side=200)
    left = x < 205.5
    near = left & (x > 199)
    bounce_x, bounce_y = np.where(near, 411 - x, np.nan), np.where(near, y + 7, np.nan)
    face = np.where(left, 1, 2).astype(np.int32)
    group = group_places(x, y, bounce_x.astype(np.float32), bounce_y.astype(np.float32), 8, face)
    assert group.max() == 1
    assert [set(group[side].tolist()) - {-1} for side in (left, ~left)] in ([{0}, {1}], [{1}, {0}])
