"""Artefacts are as large as they say, and the mirror beside the ball is worth measuring."""

import numpy as np
import pytest
from pydantic import ValidationError

from sim_backend.scenes import BallBarScene, SphereMirrorScene

POSE = {"yaw_deg": 12.0, "pitch_deg": -8.0, "roll_deg": 5.0, "offset_x_mm": -6.0, "offset_y_mm": 9.0}


def _ball(points):
    """Centre and radius by linear least squares: |p|² = 2 c·p + r² - |c|²."""
    system = np.column_stack((2 * points, np.ones(len(points))))
    solution, *_ = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)
    return solution[:3], np.sqrt(solution[3] + solution[:3] @ solution[:3])


def test_the_balls_of_a_ball_bar_are_as_far_apart_as_it_says(truth):
    found = truth(scene={"name": "ball_bar", "radius_mm": 25.0, "spacing_mm": 150.0, **POSE})
    centres = []
    for ball in (0, 1):
        points = found.points[(found.object_id == ball) & np.isfinite(found.x_p)]
        assert len(points) > 500
        centre, radius = _ball(points - [0, 0, 600])
        assert radius == pytest.approx(25.0, abs=1e-3)
        centres.append(centre)
    assert np.linalg.norm(centres[1] - centres[0]) == pytest.approx(150.0, abs=2e-3)
    np.testing.assert_allclose(np.mean(centres, axis=0), [-6, 9, 0], atol=2e-3)


@pytest.mark.parametrize(
    "wrong",
    [{"radius_mm": 80.0}, {"spacing_mm": 40.0}, {"distance_mm": 20.0}, {"distance_mm": 90.0, "yaw_deg": 70.0}],
)
def test_impossible_ball_bars_are_refused(wrong):
    with pytest.raises(ValidationError):
        BallBarScene(**wrong)


def test_a_good_part_of_the_ball_gets_a_strong_bounce(truth):
    found = truth(scene={"name": "sphere_mirror"})
    ball = (found.object_id == 0) & np.isfinite(found.x_p) & ~found.edge
    alpha = found.alpha[ball]
    region = alpha > 0.02
    assert ball.sum() > 3000
    assert 0.5 < region.mean() < 0.9
    assert ((alpha > 0.05) & (alpha < 1.3))[region].mean() > 0.9
    assert np.median(alpha[region]) > 0.25
    distance = np.abs(found.bounce_x - found.x_p)[ball][region] * 1280 / 640
    assert np.nanpercentile(distance, 5) > 40
    white = found.optics.grey([(1.0, np.full((400, 640), 255, np.uint8))])
    assert white.max() < 250


def test_without_its_mirror_the_ball_is_the_same(truth):
    with_mirror, without = (truth(scene={"name": "sphere_mirror", "with_mirror": m}) for m in (True, False))
    both = (with_mirror.object_id == 0) & np.isfinite(with_mirror.x_p)
    np.testing.assert_array_equal(with_mirror.depth[both], without.depth[both])
    np.testing.assert_array_equal(with_mirror.x_p[both], without.x_p[both])
    assert without.alpha[both].max() == 0
    assert not (without.object_id == 1).any()


def test_the_mirror_stands_off_the_ball():
    ball, mirror = SphereMirrorScene().surfaces()
    corners = mirror.mesh[0]
    assert (np.linalg.norm(corners - ball.centre, axis=1) > ball.radius + 10).all()
    with pytest.raises(ValidationError):
        SphereMirrorScene(distance_mm=40.0)
