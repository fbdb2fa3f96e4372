"""What round two lights."""

from __future__ import annotations

import numpy as np

from scanner.patterns import Plan, phase_steps
from scanner.regions import continued, inside, lit_together, literal_mask, pitch, sound_mask

SIZE = (200, 120)


def patch(x0, x1, y0, y1, pitch=1.4):
    """Coordinates of a camera that samples the projector every ``pitch`` px."""
    x, y = np.meshgrid(np.arange(x0, x1, pitch), np.arange(y0, y1, pitch))
    return x.ravel().astype(np.float32), y.ravel().astype(np.float32)


def test_sound_lights_the_direct_coordinates_and_a_margin_and_nothing_else():
    x, y = patch(50, 90, 30, 70)
    lit = sound_mask(x, y, SIZE, 6)
    assert lit[30:70, 50:90].all()
    assert lit[50, 45]
    assert not lit[:, :40].any()
    assert not lit[:, 102:].any()
    assert not lit[:20].any()


def test_a_single_wrong_coordinate_lights_nothing():
    x, y = patch(50, 90, 30, 70)
    lit = sound_mask(np.append(x, 150).astype(np.float32), np.append(y, 100).astype(np.float32), SIZE, 6)
    assert not lit[90:, 140:].any()


def test_the_margin_does_not_grow_onto_emitters():
    x, y = patch(50, 90, 30, 70)
    lit = sound_mask(x, y, SIZE, 10, patch(93, 130, 30, 70))
    assert lit[50, 88]
    assert not lit[50, 95:].any()


def test_one_axis_lights_whole_columns_or_rows():
    x, _ = patch(50, 90, 30, 70)
    nothing = np.full(x.size, np.nan, np.float32)
    columns = sound_mask(x, nothing, SIZE, 0)
    assert columns[:, 52:88].all()
    # Camera pixels a projector pixel wide see 2.5 px beyond their places.
    assert not columns[:, :47].any()
    rows = sound_mask(nothing, x, SIZE, 0)
    assert rows[52:88].all()
    assert not rows[:47].any()


def test_literal_leaves_lit_what_no_camera_pixel_maps_to():
    x, y = patch(0, 100, 0, 120)
    lit = literal_mask(x, y, SIZE)
    assert not lit[5:115, 5:95].any()
    assert lit[:, 110:].all()


def test_touching_the_border_of_the_picture_is_no_loss():
    x, y = patch(0, 40, 0, 40)
    lit = sound_mask(x, y, SIZE, 0)
    assert lit[0, 0]
    assert inside(lit, np.array([0.0], np.float32), np.array([0.0], np.float32), 2).all()


def test_inside_keeps_clear_of_the_cut():
    lit = np.zeros((120, 200), bool)
    lit[20:60, 20:60] = True
    x = np.array([40, 21, 59, 100, np.nan], np.float32)
    y = np.array([40, 40, 40, 40, 40], np.float32)
    assert inside(lit, x, y, 3).tolist() == [True, False, False, False, False]


def test_masked_plan_is_black_where_not_lit_and_survives_json():
    mask = np.zeros((120, 200), bool)
    mask[10:50, 30:70] = True
    plan = Plan(SIZE, (phase_steps("x", 1 / 16, 4), phase_steps("y", 1 / 20, 4)), mask=mask)
    for sequence in range(2):
        pictures = plan.render(sequence)
        free = Plan(SIZE, plan.sequences).render(sequence)
        for lit, whole in zip(pictures, free, strict=True):
            assert (lit[~mask] == 0).all()
            assert (lit[mask] == whole[mask]).all()
    again = Plan.from_json(plan.to_json())
    assert again == plan
    assert (again.mask == mask).all()


def surfaces():
    """A (60 × 40 pixels) and B (30 × 40) each see the other's bounce; C (20 × 40) sees one from nowhere else."""
    shape = (40, 130)
    x, y, bounce_x, bounce_y = (np.full(shape, np.nan, np.float32) for _ in range(4))
    rows = np.arange(40, dtype=np.float32)[:, None]
    for left, right, at, source in ((0, 60, 100, 500), (70, 100, 500, 100), (108, 128, 800, 1000)):
        columns = np.arange(right - left, dtype=np.float32)
        x[:, left:right], y[:, left:right] = at + 1.2 * columns, 50 + 1.2 * rows
        # Mirrored, the bounces of a surface fill its emitter.
        bounce_x[:, left:right], bounce_y[:, left:right] = source + 1.2 * columns[::-1], 50 + 1.2 * rows
    return x, y, bounce_x, bounce_y


def test_of_two_surfaces_that_light_each_other_only_the_larger_is_lit():
    chosen = lit_together(*surfaces())
    assert chosen[:, 2:58].all()
    assert not chosen[:, 70:100].any()
    assert chosen[:, 110:126].all()


def test_strays_of_the_separation_are_no_surface():
    x, y, bounce_x, bounce_y = surfaces()
    x[20, 30] += 16
    assert not lit_together(x, y, bounce_x, bounce_y)[20, 30]


def test_pitch_is_the_step_between_neighbours():
    x, y, _, _ = surfaces()
    assert abs(pitch(x, y) - 1.2) < 1e-4


def test_a_plane_is_continued_exactly():
    rows, columns = np.mgrid[0:60, 0:80].astype(np.float32)
    u = 300 + 1.3 * columns - 0.4 * rows
    known = np.zeros(u.shape, bool)
    known[10:50, 10:40] = True
    known[20:25, 20:30] = False
    wanted = np.zeros_like(known)
    wanted[20:25, 20:30] = True
    wanted[30, 50] = True
    wanted[30, 79] = True
    found = continued(np.where(known, u, np.nan).astype(np.float32), known, wanted)
    truth = u[wanted]
    near = np.isfinite(found)
    # The ridge and single precision cost 1 % of the slope over the reach of the window.
    assert np.abs(found[near] - truth[near]).max() < 0.3
    assert near[:50].all()
    assert near.sum() == 51
