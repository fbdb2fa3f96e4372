"""Matt things on a table: weak bounces from close by, and what faces that take turns make of them.

Pose, finish and seed were chosen for this file; nothing was set on them.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

SCENE = {
    "name": "objects",
    "distance_mm": 640.0,
    "pitch_deg": 26.0,
    "block_turn_deg": 12.0,
    "finish": {"reflectance": 0.7, "gloss": 0.15, "roughness": 0.15},
}
BENCH = {
    "seed": 53,
    "camera": {"width_px": 384, "height_px": 288},
    "projector": {"width_px": 768, "height_px": 480},
    "transport": {"photons": 150_000, "supersample": 1},
}


@pytest.fixture(scope="module")
def table(scan_simulated):
    """Maps, truth, and the measured pixels of the table whose bounces come from so near that one mask can hold both."""
    maps, truth = scan_simulated(SCENE, options={"max_regional_sequences": 4, "steps": 6}, **BENCH)
    away = np.hypot(truth.bounce_x - truth.x_p, truth.bounce_y - truth.y_p)
    near = (
        truth.places["table"] & (truth.alpha > 0.04) & (away > 8) & (away < 48) & ~truth.edge & np.isfinite(truth.x_p)
    )
    return maps, truth, near


def test_the_table_is_lit_up_to_what_stands_on_it_and_nothing_else_is(table):
    maps, truth, near = table
    seen = near & (maps.sequence > 0)
    assert near.sum() > 1000
    assert seen[near].mean() >= 0.95
    row, column = (np.rint(u[seen]).astype(int) for u in (truth.bounce_y, truth.bounce_x))
    taken = maps.sequence[seen].astype(int) - 1
    # Two pixels beyond its end a face is lit so that its fringes are whole; the true emitter is not, or among those.
    inner = np.stack([cv2.erode((maps.lit_by >> k) & 1, np.ones((7, 7), np.uint8)) for k in range(8)])
    assert (inner[taken, row, column] > 0).mean() <= 0.02


def test_there_coordinates_are_better_than_those_of_round_one(table):
    maps, truth, near = table
    one, both = (np.sqrt(np.nanmean(np.square(u - truth.x_p)[near])) for u in (maps.x_p_round1, maps.x_p))
    # α ≥ 0.04 moves a coordinate by up to α/(2πf) = 0.1 px, σ being 0.02 px.
    assert one > 0.08
    assert both < 0.5 * one
    assert np.isfinite(maps.x_p[near]).mean() >= 0.98
