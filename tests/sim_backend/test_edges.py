"""Printed edges through the camera's lens and pixels, against the edge-spread function in closed form."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from sim_backend.optics import Optics
from sim_backend.prints import Print
from sim_backend.settings import SimulatedSettings
from sim_backend.sheets import Sheet
from sim_backend.surfaces import Material, Rectangle
from sim_backend.transport import trace

LIGHT, DARK = 0.8, 0.05
OFFSET_PX = 0.13
WHITE = np.ones((200, 320), np.float32)
GRAINS = 6  # per pixel along each axis, of the grid near edges
CONTRAST_DN, NOISE_DN, FRAMES = 150.0, 1.5, 36


def _settings(blur_px, supersample=2):
    return SimulatedSettings.model_validate(
        {
            "camera": {"width_px": 96, "height_px": 64, "blur_px": blur_px, "field_of_view_deg": 8},
            "projector": {"width_px": 320, "height_px": 200, "field_of_view_deg": 20},
            "transport": {"supersample": supersample},
        }
    )


def _twice_integrated(x, sigma):
    """∫∫ of the normal distribution function."""
    return ((x**2 + sigma**2) * norm.cdf(x / sigma) + x * sigma * norm.pdf(x / sigma)) / 2


def _edge_spread(distance, angle, sigma):
    """A step blurred by a Gaussian and by a pixel's square, whose sides are ``angle`` to the step's normal."""
    c, s = (max(abs(f(angle)), 1e-3) for f in (math.cos, math.sin))
    corners = [(i, j) for i in (-1, 1) for j in (-1, 1)]
    return sum(i * j * _twice_integrated(distance + (i * c + j * s) / 2, sigma) for i, j in corners) / (c * s)


def _step(settings, angle):
    """The picture of a step (0 dark, 1 light) that faces the camera, as pixels see it and blurred after they did."""
    rig = settings.rig()
    normal, along = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    at = normal * OFFSET_PX * 600 / rig.camera.matrix[0, 0]
    ring = [at + along * 200, at - along * 200, at - along * 200 + normal * 200, at + along * 200 + normal * 200]
    pictures = []
    for polygons in ([[tuple(p) for p in ring]], []):
        sheet = Sheet(np.array([0, 0, 600.0]), np.eye(3), 300.0, 300.0, 0.0, Print.of(polygons, []), LIGHT, DARK)
        optics = Optics.of(settings, trace([sheet], rig, settings.transport, settings.camera.blur_px))
        after = optics.camera_blurred(optics.transport.direct_light(WHITE))
        pictures.append((optics.direct_picture(WHITE), after))
    (seen, after), (blank, _) = pictures
    as_step = lambda p: (LIGHT * p / blank - DARK) / (LIGHT - DARK)  # noqa: E731
    y, x = np.mgrid[: seen.shape[0], : seen.shape[1]]
    cx, cy = rig.camera.matrix[:2, 2]
    distance = OFFSET_PX - (x - cx) * normal[0] - (y - cy) * normal[1]
    inner = (slice(6, -6), slice(6, -6))
    return as_step(seen)[inner], as_step(after)[inner], distance[inner]


@pytest.mark.parametrize("degrees", [0.0, 4.0, 31.0])
@pytest.mark.parametrize("blur_px", [0.35, 0.5, 1.0])
def test_a_printed_edge_is_blurred_before_pixels_sample_it(blur_px, degrees):
    seen, after, distance = _step(_settings(blur_px), math.radians(degrees))
    expected = _edge_spread(distance, math.radians(degrees), blur_px)
    # Within grains of width h the edge-spread function is a polygon instead of a curve: |E''| h²/8 off at most. The
    # lens is cut off at four sigma.
    offset = np.linspace(-3, 3, 2001)
    bend = np.abs(norm.pdf(offset + 0.5, scale=blur_px) - norm.pdf(offset - 0.5, scale=blur_px)).max()
    bound = bend / GRAINS**2 / 8 + 2 * norm.cdf(-4)
    assert bound < 0.004
    error = seen - expected
    assert np.abs(error).max() < bound
    # Below the noise of the mean of as many frames as a calibration's pose has.
    at_edge = np.abs(distance) < 2
    assert np.sqrt((error[at_edge] ** 2).mean()) * CONTRAST_DN < NOISE_DN / math.sqrt(FRAMES) / 3
    # It would not be if pixels sampled first.
    assert np.abs(after - expected).max() > 5 * bound


def test_a_sharp_lens_leaves_pixels_their_squares():
    settings = _settings(0.0)
    seen, after, distance = _step(settings, math.radians(31))
    np.testing.assert_array_equal(seen, after)
    np.testing.assert_allclose(seen, _edge_spread(distance, math.radians(31), 1e-3), atol=3e-3)


def test_wide_blurs_are_done_in_two_parts():
    seen, after, distance = _step(_settings(1.6), math.radians(4))
    expected = _edge_spread(distance, math.radians(4), 1.6)
    # A Gaussian among pixels is not quite one: its excess kurtosis 1/σ² of the second part, in the whole's cumulants.
    kurtosis = (1.6**2 - 1) / (1.6**2 + 1 / 12) ** 2
    x = np.linspace(-4, 4, 801)
    bound = 1.5 * kurtosis / 24 * np.abs((x**3 - 3 * x) * norm.pdf(x)).max()
    assert np.abs(seen - expected).max() < bound
    assert np.sqrt(((seen - expected) ** 2).mean()) < 0.6 * np.sqrt(((after - expected) ** 2).mean())


def test_an_edge_of_a_surface_is_blurred_before_pixels_sample_it():
    """Rays either meet a surface or not: its edge is a staircase of as many steps as rays lie across it."""
    settings, angle = _settings(0.5, supersample=4), math.radians(20)
    rig = settings.rig()
    normal, along = np.array([math.cos(angle), math.sin(angle), 0]), np.array([-math.sin(angle), math.cos(angle), 0])
    at = np.array([0, 0, 600.0]) + normal * (OFFSET_PX * 600 / rig.camera.matrix[0, 0] - 150)
    half, whole = (Rectangle(p, 150 * normal, 150 * along, Material(LIGHT)) for p in (at, at + 150 * normal))
    seen = []
    for surface in (half, whole):
        optics = Optics.of(settings, trace([surface], rig, settings.transport, 0.5))
        seen.append(optics.direct_picture(WHITE))
    y, x = np.mgrid[: seen[0].shape[0], : seen[0].shape[1]]
    cx, cy = rig.camera.matrix[:2, 2]
    distance = OFFSET_PX - (x - cx) * normal[0] - (y - cy) * normal[1]
    error = (seen[0] / seen[1] - _edge_spread(distance, angle, 0.5))[6:-6, 6:-6]
    # Each of the rays across the kernel's main ridge decides for itself: some 16 of weight 1/16.
    assert np.abs(error).max() < 0.02


def test_light_is_neither_lost_nor_made():
    """Away from the picture's border what an edge loses on its one side it gains on the other."""
    settings = _settings(0.5)
    seen, after, _ = _step(settings, math.radians(31))
    assert np.abs(seen - after).max() > 0.03
    assert seen.sum() == pytest.approx(after.sum(), abs=0.02 * seen.shape[0])
