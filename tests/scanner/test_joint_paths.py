"""Both axes separated together, against signals whose paths are known exactly.

The product's parameters were set on seeds 0 and 1 of `path_signals` and on mirror scenes that are drawn elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from path_signals import FREQUENCY, signals
from scipy.stats import chi2 as chi2_distribution

from scanner.paths import (
    AxisPhasorsOf,
    Coupling,
    DirectPaths,
    PathPair,
    ask_neighbours,
    measure_coupling,
    separate_jointly,
)
from scanner.paths.rotation import angle_of, rotation
from scanner.paths.twin import refine_jointly_twin
from scanner.rig import Rig
from scanner.triangulation import epipolar_crossings

COUPLING = Coupling(line_px=0.05, log_ratio=float(np.log(0.97)), ratio=0.02)
DECIDED = np.log(100)


def separated(s, coupling=COUPLING):
    return separate_jointly(s.rig, s.pixels, s.axes, coupling)


def decided(found):
    return (found.best.chi2 < chi2_distribution.isf(1e-4, found.dof)) & (found.confidence > DECIDED)


@pytest.mark.parametrize(
    ("sigma", "near", "far", "hit", "share", "gross"),
    [
        (2, 20, 60, 0.98, 0.95, 0.003),
        (2, 60, 142, 0.99, 0.98, 0.001),
        (2, 142, 640, 0.99, 0.98, 0.001),
        (5, 60, 142, 0.98, 0.97, 0.003),
        (10, 142, 640, 0.98, 0.97, 0.002),
    ],
)
def test_direct_path_for_every_strength_of_the_bounce(sigma, near, far, hit, share, gross):
    s = signals(np.random.default_rng([77, sigma, near]), 1500, (0.05, 1.5), sigma, (near, far))
    found = separated(s)
    off = np.abs(found.best.direct - s.u[0])
    right = (off < 4).all(axis=0)
    for low, high in ((0.05, 0.5), (0.5, 1.0), (1.0, 1.5)):
        # The number promised is 0.95 wherever the bounce is off the line by more than 3 px.
        assert right[(s.alpha >= low) & (s.alpha < high)].mean() >= hit
    clear = decided(found)
    assert clear.mean() >= share
    assert (~right)[clear].mean() <= gross
    z = ((found.best.direct - s.u[0]) / found.best.sigma)[:, clear & right]
    assert np.sqrt(np.mean(z[0] ** 2)) == pytest.approx(1, abs=0.25)


def test_direct_path_where_noise_is_large_and_the_paths_are_close():
    s = signals(np.random.default_rng([77, 10, 20]), 4000, (0.05, 1.5), 10, (20, 60))
    found = separated(s)
    right = (np.abs(found.best.direct - s.u[0]) < 4).all(axis=0)
    # The number promised is 0.95; two standard deviations of a share of 4000.
    assert right.mean() >= 0.95 - 2 * np.sqrt(0.95 * 0.05 / right.size)
    # What is called decided is right in 97 of 100 even here.
    assert right[decided(found)].mean() >= 0.97


def test_points_of_the_unit_circle():
    angles = np.concatenate([np.random.default_rng(82).uniform(-1e5, 1e5, 2000), np.arange(-16, 17) * np.pi / 8])
    assert max(abs(rotation(a) - np.exp(1j * a)) for a in angles) < 1e-10


def test_angles_of_complex_numbers():
    angles = np.concatenate([np.random.default_rng(83).uniform(-np.pi, np.pi, 2000), np.arange(-3, 5) * np.pi / 4])
    scales = np.logspace(-6, 6, angles.size)
    assert max(abs(angle_of(complex(z)) - a) for z, a in zip(scales * np.exp(1j * angles), angles, strict=True)) < 3e-8
    assert angle_of(0j) == 0


def test_larger_bounce_is_not_taken_for_direct_light():
    s = signals(np.random.default_rng(78), 1500, (1.1, 1.5), 4, (60, 640))
    found = separated(s)
    nearer = np.abs(found.best.direct - s.u[0]).sum(axis=0) < np.abs(found.best.direct - s.u[1]).sum(axis=0)
    assert nearer.mean() >= 0.99


def test_paths_of_one_row_are_separated_with_the_amplitudes_of_the_columns():
    # By itself the axis across sees paths half a fringe apart as one.
    s = signals(np.random.default_rng(79), 1500, (0.2, 0.8), 2, (142, 640), (3, 8))
    found = separated(s)
    clear = decided(found)
    assert clear.mean() > 0.97
    off = found.best.direct[1] - s.u[0, 1]
    assert (np.abs(off[clear]) < 0.2).mean() > 0.99
    assert np.sqrt(np.mean((off / found.best.sigma[1])[clear] ** 2)) < 1.2


def test_refinement_equals_its_twin():
    s = signals(np.random.default_rng(80), 12, (0.3, 0.6), 2, (142, 640), (100, 400))
    found = separated(s)
    other, slope = epipolar_crossings(s.rig, s.pixels, s.u[:1, 0], "x")
    for p in range(12):
        start = np.concatenate([s.u[:, k, p].tolist() + s.amplitude[:, k, p].tolist() for k in range(2)])
        line_sigma = COUPLING.line_px * np.hypot(1, slope[0, p])
        parameters, sigma, chi2 = refine_jointly_twin(
            tuple(s.axes[a].z[:, p] for a in "xy"),
            (FREQUENCY, FREQUENCY),
            tuple(float(s.axes[a].sigma_z[p]) for a in "xy"),
            start,
            (s.u[0, 0, p], other[0, p], slope[0, p], line_sigma),
            (COUPLING.log_ratio, COUPLING.ratio, 0.15),
        )
        best = found.best
        mine = [best.direct[0, p], best.bounce[0, p], best.direct[1, p], best.bounce[1, p]]
        # Both stop within 1/30 of a standard deviation; the line is taken about another place of the same line.
        assert np.abs(mine - parameters[[0, 1, 4, 5]]).max() < 0.05 * sigma[[0, 1, 4, 5]].max() + 1e-3
        assert best.chi2[p] == pytest.approx(chi2, abs=0.05)
        assert best.sigma[:, p] == pytest.approx(sigma[[0, 4]], rel=0.02)
        assert best.amplitude[:, :, p].T.ravel() == pytest.approx(parameters[[2, 3, 6, 7]], abs=0.05)


def test_third_path_is_flagged_and_two_are_not():
    rng = np.random.default_rng(81)
    s = signals(rng, 800, (0.3, 0.6), 2, (142, 500))
    assert separated(s).third.mean() < 0.002
    third = np.stack([rng.uniform(0, 1279, 800), rng.uniform(0, 799, 800)])
    apart = (np.abs(third - s.u) > 60).all(axis=(0, 1))
    axes = {
        a: replace(v, z=(v.z + 16 * np.exp(2j * np.pi * FREQUENCY[:, None] * third[k])).astype(np.complex64))
        for k, (a, v) in enumerate(s.axes.items())
    }
    found = separate_jointly(s.rig, s.pixels, axes, COUPLING)
    assert found.third[apart].mean() > 0.98
    assert decided(found)[apart].mean() < 0.02


def test_pixels_that_see_two_bounces_and_nothing_direct_are_not_decided():
    s = signals(np.random.default_rng(82), 600, (0.4, 0.8), 2, (142, 640), (60, 400))
    # Other pixels' rays: the pairs lie on somebody else's line.
    elsewhere = np.roll(s.pixels, 300)
    found = separate_jointly(s.rig, elsewhere, s.axes, COUPLING)
    line = s.rig.epipolar_line(np.stack(np.divmod(elsewhere, s.rig.camera.size[0])[::-1], -1).astype(float)).T
    pairs = [s.u[i, 0] * line[0] + s.u[j, 1] * line[1] + line[2] for i in range(2) for j in range(2)]
    off = np.min(np.abs(pairs), axis=0) > 3
    assert off.mean() > 0.8
    assert decided(found)[off].mean() < 0.02
    assert not found.third[off].any()


def test_vertical_baseline_swaps_the_axes():
    s = signals(np.random.default_rng(83), 400, (0.2, 1.2), 2, (142, 640))
    turn = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
    camera, projector = s.rig.camera, s.rig.projector

    def turned(lens):
        matrix = turn @ lens.matrix @ turn
        return type(lens)(matrix, lens.distortion, lens.size[::-1])

    # Mirroring both pictures along their diagonal exchanges x and y everywhere.
    rig = Rig(turned(camera), turned(projector), turn @ s.rig.rotation @ turn, turn @ s.rig.translation)
    rows, columns = np.divmod(s.pixels, camera.size[0])
    pixels = columns * camera.size[1] + rows
    swapped = separate_jointly(
        rig, pixels, {"x": s.axes["y"], "y": s.axes["x"]}, replace(COUPLING, log_ratio=-COUPLING.log_ratio)
    )
    straight = separated(s)
    assert (straight.along, swapped.along) == (0, 1)
    same = np.isclose(swapped.best.direct[::-1], straight.best.direct, atol=1e-3).all(axis=0)
    assert same.mean() > 0.995


def test_different_numbers_of_frequencies():
    s = signals(np.random.default_rng(84), 300, (0.3, 0.6), 2, (200, 600), (200, 400))
    y = s.axes["y"]
    fewer = AxisPhasorsOf(y.z[:7], FREQUENCY[:7], y.sigma_z, y.extent, np.ones(7))
    found = separate_jointly(s.rig, s.pixels, {"x": s.axes["x"], "y": fewer}, COUPLING)
    assert found.dof == 2 * 16 - 8 + 3
    assert (np.abs(found.best.direct - s.u[0]) < 0.2).all(axis=0).mean() > 0.98


def test_even_number_of_frequencies_and_a_trend_of_their_modulation():
    s = signals(np.random.default_rng(87), 1000, (0.3, 0.6), 2, (142, 600), (100, 400))
    trend = np.linspace(1, 0.5, 8)
    axes = {}
    for a, v in s.axes.items():
        k = "xy".index(a)
        clean = np.sum(s.amplitude[:, k] * np.exp(2j * np.pi * FREQUENCY[:8, None, None] * s.u[:, k]), axis=1)
        # The noise stays as it is where the fringes are weaker.
        z = trend[:, None] * clean + (v.z[:8] - clean)
        axes[a] = AxisPhasorsOf(z.astype(np.complex64), FREQUENCY[:8], v.sigma_z, v.extent, trend)
    found = separate_jointly(s.rig, s.pixels, axes, COUPLING)
    assert found.dof == 2 * 16 - 8 + 3
    clear = decided(found)
    assert clear.mean() > 0.95
    z = ((found.best.direct - s.u[0]) / found.best.sigma)[:, clear]
    assert (np.abs(z) < 3).mean() >= 0.99
    # The signals keep to the line and to the ratios more closely than the three priors ask; 3 standard errors.
    slack = 3 * np.sqrt(2 * found.dof / clear.sum())
    assert found.dof - 3 - slack < found.best.chi2[clear].mean() < found.dof + slack


def test_no_pixels():
    s = signals(np.random.default_rng(85), 4, (0.3, 0.6), 2, (200, 600))
    none = {a: AxisPhasorsOf(v.z[:, :0], v.frequency, v.sigma_z[:0], v.extent, v.gain) for a, v in s.axes.items()}
    assert separate_jointly(s.rig, s.pixels[:0], none, COUPLING).best.direct.shape == (2, 0)


def test_coupling_is_measured_on_clean_pixels():
    rng = np.random.default_rng(86)
    s = signals(rng, 4000, (0.3, 0.6), 2, (142, 640))
    noise = 0.01
    x = s.u[0, 0] + noise * rng.standard_normal(4000)
    y = s.u[0, 1] + np.hypot(noise, 0.2) * rng.standard_normal(4000)
    skew = 0.9 * np.exp(0.03 * rng.standard_normal(4000))
    found = measure_coupling(s.rig, s.pixels, x, y, np.full(4000, noise), np.full(4000, 50.0), 50 * skew)
    # The sampling error of a 95 % point of 4000 values is 2.5 %.
    assert found.line_px == pytest.approx(0.2, rel=0.1)
    assert found.log_ratio == pytest.approx(np.log(0.9), abs=0.003)
    assert found.ratio == pytest.approx(0.03, rel=0.1)
    few = slice(0, 50)
    assert measure_coupling(s.rig, s.pixels[few], x[few], y[few], x[few], x[few], y[few]) == Coupling()


def flat_pair(x, y):
    one = np.ones(len(x), np.float32)
    place = np.array([x, y], np.float32)
    amplitude = np.ones((2, 2, len(x)), np.float32)
    return PathPair(place, 0.01 * np.stack([one, one]), place, place, amplitude, amplitude, one)


def test_neighbours_are_asked_only_in_doubt():
    shape, row = (40, 60), 20
    x, y = np.mgrid[0:40, 0:60][1] * 2.0 + 100, np.mgrid[0:40, 0:60][0] * 2.0 + 50
    pixels = row * 60 + np.arange(10, 50)
    at_x, at_y = x[row, 10:50], y[row, 10:50]
    right, wrong = flat_pair(at_x, at_y), flat_pair(at_x + 16, at_y)
    confidence = np.where(np.arange(40) < 20, 0.5, 9.0).astype(np.float32)
    # All are taken for the wrong place; of the second half the data leave no doubt.
    found = DirectPaths(wrong, right, confidence, np.zeros(40, bool), 31, 0)
    known = np.ones(shape, bool)
    known[row] = False
    asked = ask_neighbours(found, pixels, known, x.astype(np.float32), y.astype(np.float32), 4.6)
    np.testing.assert_array_equal(asked.best.direct[0, :20], right.direct[0, :20])
    np.testing.assert_array_equal(asked.best.direct[0, 20:], wrong.direct[0, 20:])
    assert (asked.confidence[:20] > 4.6).all()
    np.testing.assert_array_equal(asked.confidence[20:], confidence[20:])
