"""Light against optics that can be written down: projections, the image method, form factors, energy."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sim_backend.kernels import spread_spots
from sim_backend.projector_paths import Photons, follow
from sim_backend.raycasting import RayCaster
from sim_backend.settings import SimulatedSettings, TransportSettings
from sim_backend.surfaces import Material, Rectangle, Sphere
from sim_backend.transport import trace

WHITE = np.ones((400, 640), np.float32)
MIRROR = Rectangle(
    np.array([100.0, 0.0, 560.0]), np.array([3.0, 0, -30.0]), np.array([0, 40.0, 0]), Material(0.0, 0.9, 0.0)
)


def _pixel_rays(lens):
    """(h, w, 3) rays with z = 1, by OpenCV."""
    width, height = lens.size
    px = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    xy = cv2.undistortPoints(px, lens.matrix, lens.distortion, None, None, None, criteria)
    return np.dstack((xy.reshape(height, width, 2), np.ones((height, width))))


def _on_plane(rays, rectangle):
    """Where rays from the origin meet a rectangle's plane."""
    return rays * (rectangle.centre @ rectangle.normal / (rays @ rectangle.normal))[..., None]


def _projected(rig, points):
    rotation, _ = cv2.Rodrigues(rig.rotation)
    px, _ = cv2.projectPoints(
        points.reshape(-1, 3), rotation, rig.translation, rig.projector.matrix, rig.projector.distortion
    )
    return px.reshape(*points.shape[:-1], 2)


def _reflected(points, rectangle):
    """Mirror images of points in a rectangle's plane."""
    return points - 2 * ((points - rectangle.centre) @ rectangle.normal)[..., None] * rectangle.normal


def _pinhole_irradiance(rig, points, normal):
    """Flux per mm² from a projector whose pixels send out 1 each: I cos θ / r² with I = fx fy / cos³ φ."""
    in_projector = points @ rig.rotation.T + rig.translation
    r = np.linalg.norm(in_projector, axis=-1)
    intensity = rig.projector.matrix[0, 0] * rig.projector.matrix[1, 1] / (in_projector[..., 2] / r) ** 3
    to_light = (rig.projector_centre_cam - points) / r[..., None]
    return intensity * np.abs(to_light @ normal) / r**2


def _pixel_areas(rig, points, normal):
    """mm² of surface that one pixel of a camera without distortion sees."""
    r = np.linalg.norm(points, axis=-1)
    solid_angle = (points[..., 2] / r) ** 3 / (rig.camera.matrix[0, 0] * rig.camera.matrix[1, 1])
    return solid_angle * r**2 / np.abs((points / r[..., None]) @ normal)


def test_spots_add_up_to_one_and_keep_the_phase():
    rng = np.random.default_rng(0)
    n, width, height = 500, 200, 40
    u, v = rng.uniform(20, 180, n).astype(np.float32), rng.uniform(5, 35, n).astype(np.float32)
    rows = spread_spots(np.arange(n + 1), np.arange(n, dtype=np.int32), np.ones(n, np.float32), u, v, (width, height))
    np.testing.assert_allclose(rows @ np.ones(width * height, np.float32), 1, rtol=1e-5)
    for period in (12, 16, 14.5):
        fringe = np.exp(2j * np.pi * np.arange(width) / period)
        phasor = sum(
            factor * (rows @ np.tile(part, (height, 1)).astype(np.float32).ravel())
            for factor, part in ((1, fringe.real), (1j, fringe.imag))
        )
        error_px = np.angle(phasor * np.exp(-2j * np.pi * u.astype(np.float64) / period)) * period / (2 * np.pi)
        assert np.abs(error_px).max() < 1e-3


@pytest.mark.parametrize(
    ("pose", "lenses"),
    [
        ({}, {}),
        ({"yaw_deg": -25.0, "pitch_deg": 20.0, "distance_mm": 640.0, "offset_y_mm": -12.0}, {}),
        ({}, {"camera": {"distortion_k1": -0.12}, "projector": {"distortion_k1": 0.08}}),
    ],
)
def test_direct_coordinates_of_a_tilted_plane(truth, pose, lenses):
    found = truth(scene={"name": "plane", **pose}, **lenses)
    (board,) = SimulatedSettings.model_validate({"scene": {"name": "plane", **pose}}).scene.surfaces()
    points = _on_plane(_pixel_rays(found.rig.camera), board)
    px = _projected(found.rig, points)
    lit = np.isfinite(found.x_p)
    assert lit.mean() > 0.3
    np.testing.assert_allclose(found.x_p[lit], px[lit, 0], atol=2e-4)
    np.testing.assert_allclose(found.y_p[lit], px[lit, 1], atol=2e-4)
    np.testing.assert_allclose(found.points[lit], points[lit], atol=2e-3)
    # What is not lit lies beside the board or outside the projector's picture.
    offset = points - board.centre
    inside = np.ones(lit.shape, bool)
    for half in (board.half_width, board.half_height):
        inside &= np.abs(offset @ half) < half @ half
    inside &= (np.abs(px - [319.5, 199.5]) < [320, 200]).all(-1)
    assert (inside == lit)[~found.edge].all()


def test_direct_light_has_the_radiance_of_a_lambertian_surface(truth):
    found = truth(scene={"name": "plane"})
    (board,) = SimulatedSettings.model_validate({"scene": {"name": "plane"}}).scene.surfaces()
    points = _on_plane(_pixel_rays(found.rig.camera), board)
    expected = 0.8 / math.pi * _pinhole_irradiance(found.rig, points, board.normal)
    lit = np.isfinite(found.x_p) & ~found.edge
    np.testing.assert_allclose(found.optics.transport.direct_light(WHITE)[lit], expected[lit], rtol=3e-4)


def test_sphere_is_dark_beyond_the_terminator(truth):
    found = truth(scene={"name": "sphere", "radius_mm": 60.0}, baseline_mm=700.0)
    centre = np.array([0.0, 0.0, 600.0])
    rays = _pixel_rays(found.rig.camera)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ centre
    half_chord = np.sqrt(np.maximum(60.0**2 - (centre @ centre - along**2), 0))
    points = (along - half_chord)[..., None] * rays
    normal = (points - centre) / 60
    facing = np.einsum("...i,...i", found.rig.projector_centre_cam - points, normal) > 0
    seen = (half_chord > 0) & ~found.edge
    lit = np.isfinite(found.x_p)
    assert (lit == facing)[seen].all()
    assert 0.02 < (~facing & seen).sum() / seen.sum() < 0.5
    px = _projected(found.rig, points)
    np.testing.assert_allclose(found.x_p[lit & seen], px[lit & seen, 0], atol=5e-4)


def test_a_small_board_casts_its_shadow(small):
    settings = small()
    wall = Rectangle(np.array([0, 0, 650.0]), np.array([180.0, 0, 0]), np.array([0, 140.0, 0]), Material(0.8))
    screen = Rectangle(np.array([-10, 5, 560.0]), np.array([30.0, 0, 8.0]), np.array([0, 25.0, 0]), Material(0.8))
    rig = settings.rig()
    view = trace([wall, screen], rig, TransportSettings(photons=1000, supersample=1)).view
    points = _on_plane(_pixel_rays(rig.camera), wall)
    # Where the line from the projector to the wall crosses the screen's plane.
    start = rig.projector_centre_cam
    toward = points - start
    crossing = start + toward * (((screen.centre - start) @ screen.normal) / (toward @ screen.normal))[..., None]
    offset = crossing - screen.centre
    relative = [np.abs(offset @ h) / (h @ h) for h in (screen.half_width, screen.half_height)]
    shadow = np.maximum(*relative) < 1
    clear = np.abs(np.maximum(*relative) - 1) > 1e-3
    on_wall = view.surface == 0
    px = _projected(rig, points)
    in_picture = (np.abs(px - [319.5, 199.5]) < [320, 200]).all(-1)
    assert (shadow & on_wall).sum() > 100
    assert (np.isfinite(view.x_p) == (~shadow & in_picture))[on_wall & clear].all()


@pytest.mark.parametrize("changes", [{}, {"mirror_angle_deg": 93.0, "mirror_tilt_deg": -8.0, "yaw_deg": 6.0}])
def test_bounce_of_a_plane_mirror_is_light_of_the_mirrored_projector(truth, changes):
    found = truth(scene={"name": "mirror", **changes})
    scene = SimulatedSettings.model_validate({"scene": {"name": "mirror", **changes}}).scene
    board, mirror = scene.surfaces()
    points = _on_plane(_pixel_rays(found.rig.camera), board)
    images = _reflected(points, mirror)
    px = _projected(found.rig, images)
    # The straight line from the projector to a point's mirror image must pass through the mirror.
    start = found.rig.projector_centre_cam
    toward = images - start
    crossing = start + toward * (((mirror.centre - start) @ mirror.normal) / (toward @ mirror.normal))[..., None]
    offset = crossing - mirror.centre
    inside = np.maximum(*(np.abs(offset @ h) / (h @ h) for h in (mirror.half_width, mirror.half_height)))
    on_board = (found.object_id == 0) & ~found.edge
    region, outside = (inside < 0.93) & on_board, (inside > 1.1) & on_board

    assert region.mean() > 0.05
    assert np.isfinite(found.bounce_x[region]).all()
    assert np.isnan(found.bounce_x[outside]).all()
    error = np.stack((found.bounce_x, found.bounce_y), -1)[region] - px[region]
    # Photons 1/4 pixel apart, shared among four camera pixels of 3 projector pixels each.
    assert np.sqrt((error**2).mean(0)).max() < 0.15
    assert np.abs(error.mean(0)).max() < 0.02

    image_normal = board.normal - 2 * (board.normal @ mirror.normal) * mirror.normal
    irradiance = 0.6 * _pinhole_irradiance(found.rig, images, image_normal)
    radiance = found.optics.transport.bounced_light(WHITE)
    ratio = radiance[region] / (0.8 / math.pi * irradiance[region])
    assert ratio.mean() == pytest.approx(1, abs=0.005)
    assert ratio.std() < 0.06


def test_a_bounce_never_exceeds_what_arrived(small):
    """All light of a mirror that lands on a wall in view: flux in, flux out."""
    settings = small()
    rig = settings.rig()
    wall = Rectangle(np.array([-20, 0, 620.0]), np.array([160.0, 0, 0]), np.array([0, 125.0, 0]), Material(0.5))
    transport = trace([wall, MIRROR], rig, settings.transport)
    points = _on_plane(_pixel_rays(rig.camera), wall)
    area = _pixel_areas(rig, points, wall.normal)
    # Pixels at the mirror's rim see a little of what it shows.
    on_wall = (transport.view.surface == 0) & ~transport.view.mixed
    received = (transport.bounced_light(WHITE) * math.pi / 0.5 * area)[on_wall].sum()
    # Projector pixels whose centre rays meet the mirror, by geometry alone.
    px = np.stack(np.meshgrid(np.arange(640), np.arange(400)), -1) + 0.0
    rays = np.dstack(((px - [319.5, 199.5]) / rig.projector.matrix[0, 0], np.ones((400, 640)))) @ rig.rotation
    start = rig.projector_centre_cam
    at = rays * (((MIRROR.centre - start) @ MIRROR.normal) / (rays @ MIRROR.normal))[..., None] + start - MIRROR.centre
    on_mirror = np.maximum(*(np.abs(at @ h) / (h @ h) for h in (MIRROR.half_width, MIRROR.half_height))) < 1
    arrived = on_mirror.sum()
    assert arrived > 5000
    assert received == pytest.approx(0.9 * arrived, rel=0.01)
    # A lobe loses light past the wall's edges and makes none.
    rough = trace([wall, replace(MIRROR, material=Material(0.0, 0.9, 0.08))], rig, settings.transport)
    spread = (rough.bounced_light(WHITE) * math.pi / 0.5 * area)[on_wall].sum()
    assert spread == pytest.approx(received, rel=0.01)


def _perpendicular_form_factor(h, w):
    """From a rectangle of width w to one of height h at right angles, common edge 1 (Howell's catalogue, C-14)."""
    s = h * h + w * w
    log = math.log(
        (1 + w * w)
        * (1 + h * h)
        / (1 + s)
        * (w * w * (1 + s) / ((1 + w * w) * s)) ** (w * w)
        * (h * h * (1 + s) / ((1 + h * h) * s)) ** (h * h)
    )
    return (w * math.atan(1 / w) + h * math.atan(1 / h) - math.sqrt(s) * math.atan(1 / math.sqrt(s)) + log / 4) / (
        math.pi * w
    )


def _opposed_form_factor(x):
    """Between parallel squares of side x at distance 1 that face each other (Howell's catalogue, C-11)."""
    y = x * x
    root = math.sqrt(1 + y)
    return (
        2
        / (math.pi * y)
        * (math.log(math.sqrt((1 + y) ** 2 / (1 + 2 * y))) + 2 * x * root * math.atan(x / root) - 2 * x * math.atan(x))
    )


def _exchange(surfaces, source, normal, count=200_000):
    """Share of evenly spread flux on one rectangle that arrives at the other after one diffuse reflection."""
    rng = np.random.default_rng(11)
    rectangle = surfaces[source]
    a, b = 2 * rng.random((2, count, 1)) - 1
    photons = Photons(
        u=np.zeros(count),
        v=np.zeros(count),
        flux=np.full(count, 1 / count),
        point=rectangle.centre + a * rectangle.half_width + b * rectangle.half_height,
        normal=np.tile(normal, (count, 1)),
        direction=np.tile(-normal, (count, 1)),
        surface=np.full(count, source, np.int16),
        lobe_mm=np.zeros(count),
        choice=rng.random((count, 2)),
    )
    (arrived,) = follow(RayCaster(surfaces), [s.material for s in surfaces], photons, rng, bounces=1, diffuse=True)
    assert (arrived.surface == 1 - source).all()
    return arrived.flux.sum()


def test_diffuse_exchange_of_perpendicular_patches_is_reciprocal_and_as_the_form_factor_says():
    edge, w, h = 100.0, 50.0, 150.0
    floor = Rectangle(np.array([0, 0, w / 2]), np.array([edge / 2, 0, 0]), np.array([0, 0, w / 2]), Material(0.5))
    wall = Rectangle(np.array([0, -h / 2, 0]), np.array([edge / 2, 0, 0]), np.array([0, h / 2, 0]), Material(0.8))
    up, front = np.array([0, -1.0, 0]), np.array([0, 0, 1.0])
    to_wall, to_floor = _exchange([floor, wall], 0, up), _exchange([floor, wall], 1, front)
    expected = _perpendicular_form_factor(h / edge, w / edge)
    # Binomial counting error of 200 000 photons; the clearance above a surface is 1e-4 of the patches.
    assert to_wall / 0.5 == pytest.approx(expected, abs=4 * math.sqrt(expected / 200_000) + 5e-4)
    assert to_wall / 0.5 * w == pytest.approx(to_floor / 0.8 * h, rel=0.015)


def test_diffuse_exchange_of_opposed_squares_is_as_the_form_factor_says():
    side, gap = 80.0, 100.0
    half = np.array([side / 2, 0, 0]), np.array([0, side / 2, 0])
    near = Rectangle(np.array([0, 0, 500.0]), *half, Material(0.9))
    far = Rectangle(np.array([0, 0, 500.0 + gap]), *half, Material(0.4))
    expected = _opposed_form_factor(side / gap)
    for source, normal, reflectance in ((0, [0, 0, 1.0], 0.9), (1, [0, 0, -1.0], 0.4)):
        share = _exchange([near, far], source, np.array(normal)) / reflectance
        assert share == pytest.approx(expected, abs=4 * math.sqrt(expected / 200_000))


def test_diffuse_bounce_in_a_groove_carries_the_radiance_of_its_patches(truth):
    """The right face gets light of the left one only: E = Σ ρ/π E_i cos θ cos θ_i / r² dA_i over its patches."""
    matt = {"reflectance": 0.7, "gloss": 0.0}
    scene = {"name": "v_groove", "finish": matt, "opening_deg": 90.0, "pitch_deg": 0.0}
    found = truth(scene=scene, transport={"diffuse_bounces": 1, "photons": 1_500_000})
    left, right = SimulatedSettings.model_validate({"scene": scene}).scene.surfaces()
    rig, transport = found.rig, found.optics.transport
    steps = (np.arange(60) + 0.5) / 30 - 1
    a, b = (g.ravel()[:, None] for g in np.meshgrid(steps, steps))
    patches = left.centre + a * left.half_width + b * left.half_height
    patch_area = 4 * np.linalg.norm(left.half_width) * np.linalg.norm(left.half_height) / 3600
    patch_flux = _pinhole_irradiance(rig, patches, left.normal) * patch_area
    points = _on_plane(_pixel_rays(rig.camera), right)
    inside = transport.view.surface == 1
    # Off the fold, where patches of 2 mm are coarse, and off the edges.
    fold_distance = np.abs((points - right.centre) @ right.half_width / (right.half_width @ right.half_width) + 1)
    chosen = inside & (fold_distance > 0.3) & ~found.edge
    some = np.flatnonzero(chosen)[::37]
    target = points.reshape(-1, 3)[some]
    line = target[:, None] - patches[None]
    r2 = (line**2).sum(-1)
    cosines = np.abs(line @ left.normal) * np.abs(line @ right.normal) / r2
    irradiance = (0.7 / math.pi * patch_flux * cosines / r2).sum(1)
    expected = 0.7 / math.pi * irradiance
    found_light = transport.bounced_light(WHITE).ravel()[some]
    assert found_light.sum() == pytest.approx(expected.sum(), rel=0.02)
    assert np.abs(found_light / expected - 1).mean() < 0.06


@pytest.mark.parametrize(("roughness", "period"), [(0.1, 16), (0.15, 32)])
def test_a_lobe_blurs_fringes_as_its_breadth_says(small, roughness, period):
    """A mirror of roughness r dims a fringe of the bounce by the Gaussian's transfer function."""
    settings = small(transport={"photons": 250_000})
    rig = settings.rig()
    wall = Rectangle(np.array([-20, 0, 620.0]), np.array([160.0, 0, 0]), np.array([0, 125.0, 0]), Material(0.5))
    points = _on_plane(_pixel_rays(rig.camera), wall)
    images = _reflected(points, MIRROR)
    start = rig.projector_centre_cam
    toward = images - start
    part = ((MIRROR.centre - start) @ MIRROR.normal) / (toward @ MIRROR.normal)
    offset = start + toward * part[..., None] - MIRROR.centre
    inside = np.maximum(*(np.abs(offset @ h) / (h @ h) for h in (MIRROR.half_width, MIRROR.half_height))) < 0.5
    # A ray that the lobe turns by δ where it meets the mirror, at the part s of its way, seems to come from a
    # direction (1 - s) δ beside the true one.
    sigma_px = math.sqrt(2) * roughness**2 * (1 - part[inside]) * rig.projector.matrix[0, 0]
    dimmed = np.exp(-2 * (math.pi * sigma_px / period) ** 2)
    fringe = np.cos(2 * np.pi * np.arange(400) / period), np.sin(2 * np.pi * np.arange(400) / period)
    amplitudes = []
    for material in (Material(0.0, 0.9), Material(0.0, 0.9, roughness)):
        transport = trace([wall, replace(MIRROR, material=material)], rig, settings.transport)
        c, s = (transport.bounced_light(np.repeat(f[:, None], 640, 1).astype(np.float32))[inside] for f in fringe)
        amplitudes.append(np.hypot(c, s))
    ratio = (amplitudes[1] / amplitudes[0]).mean()
    # The exponent to 20 %, the breadth to 10 %: cells and blocks of one size stand for a lobe that is no circle there.
    assert np.log(ratio) == pytest.approx(np.log(dimmed.mean()), rel=0.2)
    assert dimmed.mean() < 0.85


def test_sphere_mesh_lies_within_the_shadow_clearance():
    ball = Sphere(np.array([3.0, -2.0, 500.0]), 80.0, Material(0.5))
    vertices, triangles = ball.mesh
    middles = vertices[triangles].mean(1)
    depth = 80.0 - np.linalg.norm(middles - ball.centre, axis=1)
    assert 0 <= depth[np.isfinite(depth)].max() < 0.01
