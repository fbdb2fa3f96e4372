"""Spheres, planes, their figures and decisions against clouds of known truth and independent evaluations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from calibration.acceptance import (
    BallBarArtefact,
    Figure,
    Limits,
    PlaneArtefact,
    PlaneBesideMirror,
    Quantity,
    SphereArtefact,
    SphereBesideMirror,
    Verdict,
    decide,
    overall,
)
from calibration.acceptance.evaluation import evaluate
from calibration.acceptance.fits import FitError, fit_plane, fit_sphere
from calibration.acceptance.interreflection import evaluate_beside_mirror, round_one_points
from calibration.acceptance.ranges import expected_range, reject
from calibration.acceptance.segmentation import ArtefactNotFoundError, find_plane
from calibration.observations import BoardPose
from drivers.libusb import load_libusb
from scanner.result import Flag, Maps
from scanner.rig import Lens, Rig

SIZE = (320, 240)
RIG = Rig(
    Lens(np.array([[625.0, 0, 159.5], [0, 625.0, 119.5], [0, 0, 1]]), np.zeros(5), SIZE),
    Lens(np.array([[1000.0, 0, 319.5], [0, 1000.0, 199.5], [0, 0, 1]]), np.zeros(5), (640, 400)),
    np.array([[0.957826, 0, 0.287348], [0, 1, 0], [-0.287348, 0, 0.957826]]),
    -np.array([[0.957826, 0, 0.287348], [0, 1, 0], [-0.287348, 0, 0.957826]]) @ [-180.0, 0, 0],
)


def cap(rng, count, radius=25.0, centre=(12.0, -7.0, 600.0), limit_deg=60.0, sigma=0.02):
    """Points of the part of a ball that one camera sees, with noise along the rays."""
    centre = np.array(centre)
    cosine = rng.uniform(np.cos(np.radians(limit_deg)), 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    axis = -centre / np.linalg.norm(centre)
    u = np.cross(axis, [0, 1, 0])
    u /= np.linalg.norm(u)
    v, sine = np.cross(axis, u), np.sqrt(1 - cosine**2)
    normal = cosine[:, None] * axis + sine[:, None] * (np.cos(azimuth)[:, None] * u + np.sin(azimuth)[:, None] * v)
    sigmas = np.full(count, sigma) * rng.uniform(0.5, 2, count)
    return noisy(rng, centre + radius * normal, sigmas), sigmas


def noisy(rng, points, sigma):
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return points + rays * (rng.normal(size=sigma.shape) * sigma)[..., None]


def board(rng, count, sigma=0.02):
    x, y = rng.uniform(-100, 100, count), rng.uniform(-70, 70, count)
    normal = np.array([0.2, -0.1, -0.97])
    normal /= np.linalg.norm(normal)
    z = (-590.0 - normal[0] * x - normal[1] * y) / normal[2]
    return noisy(rng, np.column_stack([x, y, z]), np.full(count, sigma)), np.full(count, sigma), normal


# Fits


@pytest.mark.parametrize("weighted", [True, False])
def test_sphere_of_a_cap_is_unbiased_and_its_covariance_true(weighted):
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(150):
        fit = fit_sphere(*cap(rng, 500), weighted=weighted)
        errors.append([*(fit.centre - [12, -7, 600]), fit.radius - 25])
    errors = np.array(errors)
    stated = np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose(errors.std(axis=0), stated, rtol=0.25)
    assert (np.abs(errors.mean(axis=0)) < 4 * stated / np.sqrt(150)).all()
    # The radius of a cap is known much worse than a coordinate across it, and hangs together with the depth.
    assert stated[3] > 2 * stated[0]
    assert fit.covariance[2, 3] / (stated[2] * stated[3]) > 0.9


def test_weights_gain_where_noise_differs():
    rng = np.random.default_rng(2)
    points, sigma = cap(rng, 2000)
    assert fit_sphere(points, sigma).u_radius < 0.9 * fit_sphere(points, sigma, weighted=False).u_radius


def test_geometric_sphere_is_the_minimum_that_another_method_finds():
    rng = np.random.default_rng(3)
    points, sigma = cap(rng, 300, sigma=0.3)
    fit = fit_sphere(points, sigma, weighted=False)

    def cost(p):
        # Nelder-Mead on the profile over the radius: its best value is the mean distance.
        return np.linalg.norm(points - p, axis=1).var()

    found = minimize(cost, [11, -6, 598], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-14}).x
    np.testing.assert_allclose(fit.centre, found, atol=1e-3)
    assert fit.radius == pytest.approx(np.linalg.norm(points - found, axis=1).mean(), abs=1e-3)


def test_fixed_radius():
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(100):
        fit = fit_sphere(*cap(rng, 200, limit_deg=25), radius=25.0)
        errors.append(fit.centre - [12, -7, 600])
    stated = np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose(np.std(errors, axis=0), stated[:3], rtol=0.3)
    assert fit.radius == 25.0
    assert fit.u_radius == 0
    assert fit_sphere(*cap(rng, 200, limit_deg=25)).covariance[2, 2] > 20 * fit.covariance[2, 2]


@pytest.mark.parametrize("weighted", [True, False])
def test_plane_and_its_covariance(weighted):
    rng = np.random.default_rng(5)
    distances, tilts = [], []
    for _ in range(150):
        points, sigma, normal = board(rng, 400)
        fit = fit_plane(points, sigma, weighted=weighted)
        distances.append(
            fit.centroid @ (fit.normal - normal) - fit.distance - 590.0 + 2 * (fit.centroid @ normal + 590)
        )
        tilts.append(fit.normal @ np.cross(normal, [0, 1, 0]))
    assert fit.normal @ normal > 0.999999
    # Slope error of n points of uniform spread w: σ_n √12 / (w √n).
    across = fit.sigma.mean()
    assert np.std(tilts) == pytest.approx(across * np.sqrt(12 / 400) / 200, rel=0.3)
    assert np.std(distances) == pytest.approx(across / 20, rel=0.3)
    assert np.sqrt(fit.covariance[0, 0]) == pytest.approx(across / 20, rel=0.05)
    assert np.sqrt(fit.covariance[1, 1]) == pytest.approx(across * np.sqrt(12 / 400) / 200, rel=0.1)


def test_plane_agrees_with_ransac_of_open3d():
    load_libusb()
    import open3d as o3d

    rng = np.random.default_rng(6)
    points, sigma, _ = board(rng, 3000)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.utility.random.seed(0)
    (a, b, c, d), _ = cloud.segment_plane(0.1, 3, 500)
    fit = fit_plane(points, sigma)
    assert abs(fit.normal @ [a, b, c]) > 1 - 1e-7
    assert abs(fit.distance) == pytest.approx(abs(d), abs=0.05)


def test_what_cannot_be_fitted_is_refused():
    rng = np.random.default_rng(7)
    flat = np.column_stack([rng.uniform(-9, 9, (50, 2)), np.full(50, 600.0)])
    with pytest.raises(FitError, match="one plane"):
        fit_sphere(flat, np.ones(50))
    with pytest.raises(FitError, match="3 points"):
        fit_sphere(flat[:3], np.ones(3))
    with pytest.raises(FitError, match="one line"):
        fit_plane(np.outer(np.arange(1.0, 6), [1, 2, 300]), np.ones(5))
    with pytest.raises(FitError, match="standard deviation"):
        fit_plane(flat, np.full(50, np.nan))


# Ranges


@pytest.mark.parametrize(
    ("count", "mean", "std"),
    [(2, 1.128, 0.853), (5, 2.326, 0.864), (10, 3.078, 0.797), (25, 3.931, 0.708), (100, 5.015, 0.605)],
)
def test_expected_range_has_the_published_values(count, mean, std):
    # d2 and d3 of the range chart, Montgomery, Statistical Quality Control, appendix VI.
    found = expected_range(np.full(count, 2.0))
    assert found == pytest.approx((2 * mean, 2 * std), rel=3e-3)


@pytest.mark.parametrize("sigma", [np.ones(1500), np.linspace(0.2, 2, 1500)], ids=["equal", "mixed"])
def test_expected_range_after_rejection(sigma):
    rng = np.random.default_rng(8)
    ranges = []
    for _ in range(1500):
        x = rng.normal(size=sigma.size) * sigma
        ranges.append(np.ptp(x[reject(x)]))
    mean, std = expected_range(sigma, 4)
    assert np.mean(ranges) == pytest.approx(mean, rel=0.01)
    assert np.std(ranges) == pytest.approx(std, rel=0.1)


def test_rejection_takes_at_most_three_of_a_thousand():
    x = np.linspace(-1, 1, 1999)
    x[7], x[1500] = 50.0, -60.0
    for count, going in ((1999, 5), (333, 0), (334, 1)):
        assert (~reject(x[:count])).sum() == going
    kept = x[reject(x)]
    assert np.abs(kept).max() < 1
    assert reject(np.append(x, 40.0))[[7, 1500, 1999]].sum() == 0


# Decisions


@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        (0.079, Verdict.PASS),
        (-0.079, Verdict.PASS),
        (0.081, Verdict.UNCERTAIN),
        (0.1, Verdict.UNCERTAIN),
        (0.119, Verdict.UNCERTAIN),
        (-0.121, Verdict.FAIL),
    ],
)
def test_decision_rule(value, verdict):
    assert decide(value, 0.01, 0.1) is verdict


def test_a_limit_without_a_figure_does_not_pass():
    limits = Limits(flatness_mm=0.1)
    good = Figure(Quantity.PROBING_FORM, "ball", 0.05, {"a": 0.003, "b": 0.004})
    assert good.u_mm == pytest.approx(0.005)
    missing = Figure(Quantity.FLATNESS, "plane", None, note="not scanned")
    assert overall([good.judged_by(limits)]) is Verdict.REPORTED
    assert overall([good.judged_by(limits), missing.judged_by(limits)]) is Verdict.MISSING
    passed = Figure(Quantity.FLATNESS, "plane", 0.05).judged_by(limits)
    failed = Figure(Quantity.FLATNESS, "plane", 0.2).judged_by(limits)
    assert overall([good, passed]) is Verdict.PASS
    assert overall([passed, missing.judged_by(limits), failed]) is Verdict.FAIL


# Whole scans


def rendered(rng, balls=(), planes=(), sigma=0.02, noise=True, form=None):
    """Maps of balls (centre, radius) and planes (normal, d, half-extent mm) with noise and smeared depth edges."""
    rays = RIG.camera.pixel_rays().astype(np.float64)
    depth = np.full(rays.shape[:2], np.inf)
    for normal, distance, extent in planes:
        z = distance / (rays @ normal)
        x = rays * z[..., None]
        inside = (np.abs(x[..., :2]) < extent).all(axis=2)
        depth = np.where(inside & (z < depth), z, depth)
    for centre, radius in balls:
        length2, along = (rays**2).sum(axis=2), rays @ np.array(centre)
        root = along**2 - length2 * (np.dot(centre, centre) - radius**2)
        with np.errstate(invalid="ignore"):
            z = (along - np.sqrt(root)) / length2
        depth = np.where(root > 0, np.fmin(z, depth), depth)
    seen = np.isfinite(depth)
    # Pixels on an edge see both surfaces: anything between their depths.
    edge = seen & (np.abs(np.diff(np.where(seen, depth, 9e3), axis=1, prepend=0)) > 15)
    depth[edge] -= rng.uniform(0, 30, edge.sum())
    sigmas = np.full(depth.shape, sigma, np.float32)
    points = rays * np.where(seen, depth, np.nan)[..., None]
    if form is not None:
        points += form(points)
    if noise:
        points = noisy(rng, points, sigmas.astype(float))
    return maps_of(points, sigmas)


def maps_of(points, sigmas, **more):
    shape = sigmas.shape
    return Maps(
        x_p=np.zeros(shape, np.float32),
        y_p=None,
        sigma_x=None,
        sigma_y=None,
        modulation=np.ones(shape, np.float32),
        brightness=np.ones(shape, np.float32),
        variation=None,
        misfit=np.ones(shape, np.float32),
        interreflection=more.pop("interreflection", np.zeros(shape, bool)),
        flags=more.pop("flags", np.where(np.isfinite(points[..., 2]), 0, Flag.LOW_MODULATION).astype(np.uint16)),
        depth=points[..., 2].astype(np.float32),
        points=points.astype(np.float32),
        sigma_point=sigmas,
        **more,
    )


def figure(evaluation, quantity):
    return next(f for f in evaluation.figures if f.quantity is quantity)


WALL = (np.array([0.1, 0.0, 0.995]), 690.0, np.inf)
BALL = ((-20.0, 10.0, 600.0), 30.0)


def test_sphere_before_a_wall():
    rng = np.random.default_rng(11)
    scans = [rendered(rng, [BALL], [WALL]) for _ in range(3)]
    found = evaluate(SphereArtefact(diameter_mm=60.0), scans, RIG, rng)
    size, form = figure(found, Quantity.PROBING_SIZE), figure(found, Quantity.PROBING_FORM)
    assert abs(size.value_mm) < 4 * size.u_mm
    assert size.u_mm < 0.01
    assert form.value_mm == pytest.approx(form.noise_mm, abs=5 * form.noise_std_mm)
    assert form.rejected == int(0.003 * form.points)
    repeated = figure(found, Quantity.REPEATABILITY)
    assert repeated.value_mm == pytest.approx(0.02, rel=0.05)
    assert repeated.value_mm == pytest.approx(repeated.noise_mm, abs=5 * repeated.noise_std_mm)
    assert figure(found, Quantity.REPEATABILITY_LENGTH).value_mm < 4 * size.u_mm
    # The outlined region is the cap up to 60°, nothing of the wall; its outline is 0.866 of the radius.
    pixels = np.pi * (0.866 * 30 * 625 / 600) ** 2
    assert found.pictures[0].region.sum() == pytest.approx(pixels, rel=0.15)


def test_a_biased_cloud_gives_the_bias():
    rng = np.random.default_rng(12)
    larger = rendered(rng, [(BALL[0], 30.05)], [WALL])
    figures = evaluate(SphereArtefact(diameter_mm=60.0), [larger], RIG, rng)
    size = figure(figures, Quantity.PROBING_SIZE)
    assert size.value_mm == pytest.approx(0.1, abs=4 * size.u_mm)
    assert figure(figures, Quantity.REPEATABILITY).verdict is Verdict.MISSING

    def trefoil(points):
        off = points - np.array(BALL[0])
        azimuth = np.arctan2(off[..., 1], off[..., 0])
        return off / 30 * (0.2 * np.cos(3 * azimuth))[..., None]

    dented = rendered(rng, [BALL], form=trefoil, noise=False)
    form = figure(evaluate(SphereArtefact(diameter_mm=60.0), [dented], RIG, rng), Quantity.PROBING_FORM)
    assert form.value_mm == pytest.approx(0.4, rel=0.1)
    assert form.value_mm - form.noise_mm > 10 * form.noise_std_mm


def test_a_scale_error_shows_in_size_and_spacing():
    rng = np.random.default_rng(13)
    bar = [((-45.0, 5.0, 610.0), 20.0), ((45.0, -5.0, 590.0), 20.0)]
    spacing = float(np.linalg.norm(np.subtract(bar[0][0], bar[1][0])))
    artefact = BallBarArtefact(
        diameter_mm=40.0, spacing_mm=spacing, spacing_uncertainty_mm=0.002, expansion_per_kelvin=11.5e-6
    )
    good = figure(evaluate(artefact, [rendered(rng, bar, [WALL])], RIG, rng), Quantity.SPHERE_SPACING)
    assert abs(good.value_mm) < 4 * good.u_mm
    assert good.budget["calibration of the artefact"] == 0.001
    scaled = [rendered(rng, bar, [WALL], form=lambda p: 0.08 * p)]
    found = figure(evaluate(artefact, scaled, RIG, rng), Quantity.SPHERE_SPACING)
    assert found.value_mm == pytest.approx(0.08 * spacing, abs=4 * found.u_mm)
    # At 30 °C the steel bar is longer by 10 K · 11.5e-6/K.
    warm = figure(
        evaluate(artefact, [rendered(rng, bar, [WALL])], RIG, rng, temperature_C=30.0), Quantity.SPHERE_SPACING
    )
    assert warm.value_mm == pytest.approx(-115e-6 * spacing, abs=4 * warm.u_mm)
    assert warm.u_mm > good.u_mm
    assert "30 °C" in warm.note
    assert "not noted" in good.note


def test_few_outliers_go_and_many_do_not():
    rng = np.random.default_rng(14)
    maps = rendered(rng, [BALL])
    cap_pixels = np.argwhere(evaluate(SphereArtefact(diameter_mm=60.0), [maps], RIG, rng).pictures[0].region)

    def with_outliers(count):
        points = maps.points.copy()
        rows, columns = cap_pixels[rng.choice(len(cap_pixels), count, replace=False)].T
        points[rows, columns] *= 1.05
        spoilt = maps_of(points, maps.sigma_point)
        found = evaluate(SphereArtefact(diameter_mm=60.0), [spoilt], RIG, rng)
        return figure(found, Quantity.PROBING_FORM), found.pictures[0].sigma

    form, sigma = with_outliers(4)
    # Six of the 2000 points go: the four, and the two largest of noise.
    assert form.rejected == 6
    mean, std = expected_range(sigma, 2)
    assert form.value_mm == pytest.approx(mean, abs=4 * std)
    assert with_outliers(20)[0].value_mm > 10


def test_flatness_of_a_bowed_board_before_a_wall():
    rng = np.random.default_rng(15)
    plane = (np.array([0.05, -0.1, 0.994]), 590.0, np.array([100.0, 75.0]))

    def bowed(points):
        bow = 0.15 * (np.square(points[..., :2]).sum(axis=2) / 100**2)
        return bow[..., None] * np.array([0, 0, 1.0])

    artefact = PlaneArtefact(width_mm=200, height_mm=150)
    flat = figure(evaluate(artefact, [rendered(rng, planes=[plane])], RIG, rng), Quantity.FLATNESS)
    assert flat.value_mm == pytest.approx(flat.noise_mm, abs=5 * flat.noise_std_mm)
    maps = rendered(rng, planes=[plane, WALL], form=bowed, noise=False)
    found = evaluate(artefact, [maps], RIG, rng)
    # The wall fills more of the picture, but it is larger than the board can be.
    region = found.pictures[0].region
    element = fit_plane(maps.points[region], maps.sigma_point[region], weighted=False)
    value = figure(found, Quantity.FLATNESS).value_mm
    assert value == pytest.approx(np.ptp(element.residuals[reject(element.residuals)]), rel=0.02)
    assert 0.15 < value < 0.25
    assert abs(element.normal @ plane[0]) > 0.999


def test_what_is_not_there_is_said():
    rng = np.random.default_rng(16)
    only_wall = rendered(rng, planes=[WALL])
    found = evaluate(SphereArtefact(diameter_mm=60.0), [only_wall], RIG, rng)
    assert {f.verdict for f in found.figures} == {Verdict.MISSING}
    assert {f.quantity for f in found.figures} == {
        Quantity.PROBING_FORM,
        Quantity.PROBING_SIZE,
        Quantity.REPEATABILITY,
        Quantity.REPEATABILITY_LENGTH,
    }
    assert all("no sphere of 60 mm" in f.note for f in found.figures)
    one_ball = evaluate(BallBarArtefact(diameter_mm=60.0), [rendered(rng, [BALL])], RIG, rng)
    assert "only 1 of 2 spheres" in one_ball.figures[0].note
    small = evaluate(PlaneArtefact(width_mm=100, height_mm=80), [only_wall], RIG, rng)
    assert "Something else that is flat" in small.figures[0].note
    with pytest.raises(ArtefactNotFoundError):
        find_plane(rendered(rng, balls=[((0.0, 0.0, 600.0), 5.0)]), rng)


@pytest.mark.parametrize("shape", ["plane", "sphere"])
def test_bounce_region_before_and_after(shape):
    rng = np.random.default_rng(17)
    board_plane = (np.array([0.05, -0.1, 0.994]), 590.0, np.array([100.0, 75.0]))
    scene = {"planes": [board_plane]} if shape == "plane" else {"balls": [((0.0, 0.0, 600.0), 60.0)]}
    artefact = (
        PlaneBesideMirror(width_mm=200, height_mm=150) if shape == "plane" else SphereBesideMirror(diameter_mm=120)
    )
    truth, clean, removed = rendered(rng, noise=False, **scene), rendered(rng, **scene), rendered(rng, **scene)
    region = np.zeros(truth.flags.shape, bool)
    region[80:160, 140:190] = True
    uv = RIG.projector.project(RIG.to_projector_frame(truth.points.astype(float)))
    u = uv[..., 0] + np.where(region, 2.0 * np.sin(np.arange(SIZE[0]) / 3), 0)
    beside = maps_of(
        clean.points,
        clean.sigma_point,
        interreflection=region,
        x_p_round1=u.astype(np.float32),
        y_p_round1=uv[..., 1].astype(np.float32),
    )
    found = evaluate_beside_mirror(artefact, beside, removed, RIG, rng)
    one, both, without = (
        figure(found, q) for q in (Quantity.BOUNCE_STD_ROUND_ONE, Quantity.BOUNCE_STD, Quantity.BOUNCE_STD_REMOVED)
    )
    assert len(found.pictures) == 3
    # The region with a rim of four pixels; of the sphere, what projector and camera see under the limit.
    assert 0.95 * 88 * 58 < both.points <= 88 * 58
    assert both.value_mm == pytest.approx(both.noise_mm, abs=5 * both.noise_std_mm)
    assert without.value_mm == pytest.approx(both.value_mm, rel=0.1)
    # 2 px · sin has a standard deviation of √2 px; a column is z² / (f b) ≈ 2 mm deep here.
    assert one.value_mm > 50 * both.value_mm
    assert one.noise_mm is None
    assert figure(found, Quantity.BOUNCE_RANGE).value_mm == pytest.approx(
        figure(found, Quantity.BOUNCE_RANGE).noise_mm, rel=0.1
    )
    alone = evaluate_beside_mirror(artefact, beside, None, RIG, rng)
    assert figure(alone, Quantity.BOUNCE_STD).value_mm == pytest.approx(both.value_mm, rel=0.05)
    assert "mirror removed" in figure(alone, Quantity.BOUNCE_STD_REMOVED).note
    no_bounce = evaluate_beside_mirror(artefact, removed, None, RIG, rng)
    assert {f.verdict for f in no_bounce.figures} == {Verdict.MISSING}


# The simulated bench

SMALL = {
    "camera": {"width_px": 320, "height_px": 240},
    "projector": {"width_px": 640, "height_px": 400},
    "transport": {"photons": 200_000, "supersample": 2},
}


def test_simulated_sphere_has_the_size_and_form_of_its_truth(scan_simulated):
    artefact = SphereArtefact(diameter_mm=110.0)
    scene = artefact.scene(BoardPose(600.0, offset_x_mm=8.0))
    maps, truth = scan_simulated(scene, options={"steps": 4}, seed=3, **SMALL)
    found = evaluate(artefact, [maps], truth.rig, np.random.default_rng(0))
    size, form = figure(found, Quantity.PROBING_SIZE), figure(found, Quantity.PROBING_FORM)
    centre = np.array([8.0, 0, 600.0])
    region = found.pictures[0].region
    true = np.linalg.norm(truth.points[region] - centre, axis=1)
    np.testing.assert_allclose(true, 55.0, atol=1e-3)
    assert abs(size.value_mm) < 4 * size.u_mm + 0.005
    assert form.value_mm == pytest.approx(form.noise_mm, rel=0.25)


def test_simulated_board_beside_a_mirror_and_without(scan_simulated):
    artefact, pose = PlaneBesideMirror(width_mm=230.0, height_mm=200.0), BoardPose(610.0, offset_x_mm=-25.0)
    options = {"options": {"steps": 6}, **SMALL, "camera": {**SMALL["camera"], "exposure_us": 14_000}}
    beside, truth = scan_simulated(artefact.scene(pose), seed=5, **options)
    removed, _ = scan_simulated(artefact.scene(pose, with_mirror=False), seed=6, **options)
    found = evaluate_beside_mirror(artefact, beside, removed, truth.rig, np.random.default_rng(0))
    # What is outlined is where the bounce truly is: the scene's own share of bounced light.
    true = (np.nan_to_num(truth.alpha) > 0.02) & (truth.object_id == 0) & ~truth.edge
    region = found.pictures[0].region
    assert (region & true).sum() > 0.9 * true.sum()
    # The figures are the errors against the true board, whatever they are: a camera this coarse keeps wrong fringes.
    normal = fit_plane(truth.points[true], np.ones(true.sum())).normal
    errors = {
        Quantity.BOUNCE_STD_ROUND_ONE: round_one_points(beside, truth.rig) - truth.points,
        Quantity.BOUNCE_STD: beside.points - truth.points,
        Quantity.BOUNCE_STD_REMOVED: removed.points - truth.points,
    }
    for quantity, error in errors.items():
        across = (error @ normal)[region]
        assert figure(found, quantity).value_mm == pytest.approx(np.nanstd(across), rel=0.01)
        assert figure(found, quantity).points == np.isfinite(across).sum()
    without = figure(found, Quantity.BOUNCE_STD_REMOVED)
    assert without.value_mm == pytest.approx(without.noise_mm, rel=0.1)
    assert figure(found, Quantity.BOUNCE_STD).value_mm < figure(found, Quantity.BOUNCE_STD_ROUND_ONE).value_mm
