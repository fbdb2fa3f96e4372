import numpy as np
import pytest

FULL = {"width_px": 1280, "height_px": 800}


def _decoded(truth, axis, period=16, steps=12):
    """Projector coordinate modulo the period, px, from N-step pictures without noise, rounding or 8-bit patterns."""
    optics = truth.optics
    width, height = optics.transport.projector_size
    u = np.arange(width)[None] if axis == "x" else np.arange(height)[:, None]
    phasor = np.zeros(truth.x_p.shape, complex)
    for n in range(1, steps + 1):
        fringe = 0.5 + 0.5 * np.cos(2 * np.pi * (u / period + n / steps))
        out = optics.projector_blurred(np.broadcast_to(fringe, (height, width)).astype(np.float32))
        light = optics.direct_picture(out) + optics.bounced_picture(out)
        phasor += optics.gain * light * np.exp(-2j * np.pi * n / steps) * 2 / steps
    return phasor


@pytest.mark.parametrize("axis", ["x", "y"])
def test_clean_plane_decodes_to_the_truth(truth, axis):
    found = truth(scene={"name": "plane"})
    phasor = _decoded(found, axis)
    coordinate = found.x_p if axis == "x" else found.y_p
    clean = np.isfinite(coordinate) & ~found.edge
    error = np.angle(phasor * np.exp(-2j * np.pi * coordinate.astype(float) / 16))[clean] * 16 / (2 * np.pi)
    assert clean.mean() > 0.3
    assert np.sqrt((error**2).mean()) < 0.002
    if axis == "x":
        np.testing.assert_allclose(np.abs(phasor)[clean], found.direct_amplitude[clean], rtol=1e-4)
    # A board beside nothing gets no bounce.
    assert found.alpha[clean].max() == 0
    assert np.isnan(found.bounce_x).all()


def test_default_mirror_scene_is_the_experiment_it_should_be(truth):
    """Region, strength and reach of the bounce; no saturation where both paths add up."""
    found = truth(scene={"name": "mirror"}, projector=FULL)
    region = found.alpha > 0.02
    inner = region & ~found.edge & np.isfinite(found.bounce_x)
    assert region.mean() > 0.08
    assert ((found.alpha > 0.2) & (found.alpha < 0.9))[region].mean() > 0.95
    distance = np.abs(found.bounce_x - found.x_p)
    assert ((distance > 40) & (distance < 600))[inner].mean() > 0.98
    width, height = found.optics.transport.projector_size
    white = found.optics.grey([(1.0, np.full((height, width), 255, np.uint8))])
    assert white.max() + 3 * found.optics.camera.read_noise_dn < 255

    emitters = np.zeros((height, width), bool)
    emitters[np.rint(found.bounce_y[inner]).astype(int), np.rint(found.bounce_x[inner]).astype(int)] = True
    own = np.zeros((height, width), bool)
    own[np.rint(found.y_p[inner]).astype(int), np.rint(found.x_p[inner]).astype(int)] = True
    assert own.sum() > 1000
    assert not (own & emitters).any()
    # The camera also sees the mirror, where no light is direct.
    assert np.isnan(found.x_p[found.object_id == 1]).all()


def test_matt_board_is_well_exposed_by_default(truth):
    """A and B of a fringe near 90 and 85 DN, in pixels as large as those of the default camera."""
    a_quarter = 2 * np.degrees(np.arctan(np.tan(np.radians(28.7 / 2)) / 4))
    found = truth(scene={"name": "mirror_removed"}, camera={"field_of_view_deg": a_quarter}, projector=FULL)
    white = found.optics.grey([(1.0, np.full((800, 1280), 255, np.uint8))]) - found.optics.camera.ambient_dn
    assert np.median(white) / 2 == pytest.approx(90, abs=4)
    assert np.median(found.direct_amplitude) == pytest.approx(85, abs=4)
    # Spot of a pixel sinc⁴(f), defocus exp(-2 π² σ² f²), and the camera's own blur and pixel in projector pixels, of
    # which the board, 626 mm from the projector and turned away from it by atan(180/600), has so many per mm:
    per_mm = found.rig.projector.matrix[0, 0] / 626 * np.cos(np.arctan(180 / 600))
    f, camera_px = 1 / 16, 600 / found.rig.camera.matrix[0, 0] * per_mm
    transfer = np.sinc(f) ** 4 * np.exp(-2 * (np.pi * f * 0.5) ** 2 * (1 + camera_px**2)) * np.sinc(f * camera_px)
    np.testing.assert_allclose(np.median(found.direct_amplitude / (white / 2)), transfer, rtol=0.005)


def test_two_paths_of_the_truth_are_what_the_picture_shows(truth):
    """In the bounce, the phasor of the picture is the sum of the truth's two paths."""
    found = truth(scene={"name": "mirror"})
    inner = (found.alpha > 0.3) & ~found.edge & np.isfinite(found.bounce_x)
    phasor = _decoded(found, "x")[inner]
    paths = [np.exp(2j * np.pi * u[inner].astype(float) / 16) for u in (found.x_p, found.bounce_x)]
    # Least squares of the two real amplitudes, pixel by pixel: z = a p + b q.
    system = np.stack([np.stack([p.real, p.imag], -1) for p in paths], -1)
    well = np.abs(np.linalg.det(system)) > 0.3
    direct, bounced = np.linalg.solve(system[well], np.stack([phasor.real, phasor.imag], -1)[well][..., None])[..., 0].T
    np.testing.assert_allclose(np.median(direct / found.direct_amplitude[inner][well]), 1, atol=0.01)
    along_x = bounced / direct
    # alpha is the larger of both axes, so it is not below that of x.
    assert np.median(along_x / found.alpha[inner][well]) == pytest.approx(0.99, abs=0.03)


def test_mirror_removed_is_the_same_scene_without_the_bounce(truth):
    with_mirror, without = truth(scene={"name": "mirror"}), truth(scene={"name": "mirror_removed"})
    both = np.isfinite(with_mirror.x_p) & np.isfinite(without.x_p) & ~with_mirror.edge
    assert both.mean() > 0.7
    np.testing.assert_array_equal(with_mirror.x_p[both], without.x_p[both])
    np.testing.assert_array_equal(with_mirror.depth[both], without.depth[both])
    assert without.alpha[both].max() == 0


def test_edges_are_where_surfaces_meet(truth):
    found = truth(scene={"name": "steps", "steps": 3, "step_depth_mm": 20.0})
    jumps = np.abs(np.diff(np.nan_to_num(found.depth), axis=1)) > 10
    left, right = found.edge[:, :-1], found.edge[:, 1:]
    assert jumps.any()
    assert (left & right)[jumps].all()
    assert found.edge.mean() < 0.2
    # Between edges the treads lie at the depths that the scene asks for.
    treads = np.isin(found.object_id, (0, 1, 2)) & ~found.edge
    np.testing.assert_allclose(found.depth[treads], 620.0 - 20.0 * found.object_id[treads], atol=1e-3)


def test_groove_faces_light_each_other(truth):
    found = truth(scene={"name": "v_groove"})
    for face in (0, 1):
        on_face = (found.object_id == face) & ~found.edge & np.isfinite(found.bounce_x)
        strong = on_face & (found.alpha > 0.1)
        assert strong.sum() > 500
        # Light that reached this face by the other started beyond the fold.
        fold = 319.5
        beyond = found.bounce_x[strong] > fold if face == 0 else found.bounce_x[strong] < fold
        assert beyond.mean() > 0.9
