"""Two-path separation against synthetic phasors of known paths and the Cramér-Rao bound computed here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from scanner.paths import (
    SeparationPlanError,
    TwoPaths,
    choose_direct,
    separate_two_paths,
    separate_two_paths_twin,
)

EXTENT = 1280
FREQUENCY = (80 + np.arange(9)) / EXTENT
B, STEPS = 80.0, 12


@dataclass(frozen=True)
class Truth:
    u: NDArray[np.float64]  # (2, P), the direct path first
    amplitude: NDArray[np.float64]  # (2, P)
    z: NDArray[np.complex128]  # (T, P)
    sigma_z: NDArray[np.float64]  # (P,)
    bound: NDArray[np.float64]  # (2, P), px


def phasors(f, u, amplitude, gain=1.0):
    """(T, P) phasors of paths u (K, P), method.md §1."""
    turns = np.exp(2j * np.pi * f[:, None, None] * u)
    return np.broadcast_to(gain, f.shape)[:, None] * np.sum(amplitude * turns, axis=1)


def scene(rng, count, near, far, alpha=0.4, sigma=2.0, f=FREQUENCY, extent=EXTENT, gain=1.0):
    """Direct path of 80 DN and a bounce ``near``..``far`` px away on either side, anywhere in the picture."""
    distance = rng.uniform(near, far, count) * rng.choice([-1, 1], count)
    lowest, highest = np.maximum(0, -distance) - 0.5, extent - 0.5 - np.maximum(0, distance)
    direct = rng.uniform(lowest, highest)
    u = np.stack([direct, direct + distance])
    amplitude = np.stack([np.full(count, B), np.broadcast_to(alpha * B, count)])
    sigma_z = np.full(count, sigma * np.sqrt(2 / STEPS))
    clean = phasors(f, u, amplitude, gain)
    noise = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
    return Truth(u, amplitude, clean + sigma_z * noise, sigma_z, cramer_rao(f, u, amplitude, sigma_z, gain))


def cramer_rao(f, u, amplitude, sigma_z, gain=1.0):
    """(2, P) least standard deviation of u, from the Fisher matrix of (a₁, u₁, a₂, u₂)."""
    slopes = []
    for k in range(2):
        one = phasors(f, u[k : k + 1], np.ones((1, u.shape[1])), gain)
        slopes += [one, 2j * np.pi * f[:, None] * amplitude[k] * one]
    jacobian = np.stack(slopes, axis=-1)  # (T, P, 4)
    fisher = np.einsum("tpa,tpb->pab", jacobian.conj(), jacobian).real / sigma_z[:, None, None] ** 2
    return np.sqrt(np.linalg.inv(fisher)[:, [1, 3], [1, 3]].T)


def direct_first(paths: TwoPaths, truth: Truth):
    """u and σ with the direct path first: by amplitude, and by nearness where both are alike."""
    swap = (truth.amplitude[0] < truth.amplitude[1]) | (
        (truth.amplitude[0] == truth.amplitude[1]) & (np.abs(paths.u[0] - truth.u[0]) > np.abs(paths.u[1] - truth.u[0]))
    )
    return np.where(swap, paths.u[::-1], paths.u), np.where(swap, paths.sigma_u[::-1], paths.sigma_u)


def wrong(error):
    """Gross: by more than a quarter of a fringe."""
    return ~(np.abs(error) < 4)


@pytest.mark.parametrize(
    ("near", "far", "alpha", "limit"),
    [
        # The limits of method.md §6.
        pytest.param(142, 640, 0.4, 0.005, id="far apart"),
        pytest.param(640, 640, 0.4, 0.005, id="where the modulation is blind"),
        pytest.param(60, 142, 0.4, 0.005, id="less than a period of variation"),
        pytest.param(20, 60, 0.4, 0.03, id="close"),
        pytest.param(142, 640, 1.0, 0.005, id="bounce as strong as the direct light"),
        pytest.param(142, 640, 2.0, 0.005, id="bounce twice as strong"),
        pytest.param(60, 142, 2.0, 0.005, id="bounce twice as strong, nearer"),
        pytest.param(142, 640, 0.1, 0.005, id="weak bounce"),
    ],
)
def test_direct_path_reaches_the_cramer_rao_bound(near, far, alpha, limit):
    truth = scene(np.random.default_rng(2019), 20_000, near, far, alpha)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    u, sigma = direct_first(found, truth)
    error = u - truth.u
    assert wrong(error[0]).mean() <= limit
    right = ~wrong(error).any(axis=0)
    for k in range(2):
        # Sampling error of an rms over 20 000 pixels: 0.5 %; of a median: 0.8 %.
        normalised = error[k, right] / truth.bound[k, right]
        assert np.sqrt(np.mean(normalised**2)) == pytest.approx(1, abs=0.03)
        assert np.median(np.abs(normalised)) == pytest.approx(stats.norm.ppf(0.75), rel=0.04)
        assert np.sqrt(np.mean((error[k] / sigma[k])[right] ** 2)) == pytest.approx(1, abs=0.03)
    if near >= 142 and alpha == 0.4:
        assert np.median(np.abs(error[0])) == pytest.approx(0.0056, rel=0.05)  # 0.0083 px standard deviation


def test_chi2_is_distributed_as_its_degrees_of_freedom_say():
    truth = scene(np.random.default_rng(1), 5000, 142, 640)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    assert found.dof == 2 * 9 - 4
    assert stats.kstest(found.chi2, stats.chi2(found.dof).cdf).pvalue > 0.01


def test_sigma_amplitude_is_the_spread_of_the_amplitudes():
    truth = scene(np.random.default_rng(2), 10_000, 60, 640)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    right = ~wrong(found.u - truth.u).any(axis=0)
    normalised = ((found.amplitude - truth.amplitude) / found.sigma_amplitude)[:, right]
    assert normalised.std(axis=1) == pytest.approx(1, abs=0.03)


def test_third_path_shows_in_chi2():
    rng = np.random.default_rng(3)
    truth = scene(rng, 5000, 142, 640)
    limit = stats.chi2.isf(1e-3, 14)
    two = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    assert np.mean(two.chi2 > limit) < 3e-3
    # A third path at least 60 px from either, a fifth of the direct light.
    third = rng.uniform(-0.5, EXTENT - 0.5, 5000)
    apart = (np.abs(third - truth.u) > 60).all(axis=0)
    with_third = truth.z + phasors(FREQUENCY, third[None], np.full((1, 5000), 0.2 * B))
    three = separate_two_paths(with_third[:, apart], FREQUENCY, truth.sigma_z[apart], EXTENT)
    assert np.mean(three.chi2 > limit) > 0.99


def test_small_margin_marks_the_fringe_orders_in_doubt():
    truth = scene(np.random.default_rng(4), 20_000, 20, 60)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    gross = wrong(found.u[0] - truth.u[0])
    assert gross[found.margin > 10].mean() < 0.2 * gross.mean()


def test_common_modulation_trend_is_divided_out():
    trend = np.linspace(1.12, 0.88, 9)
    truth = scene(np.random.default_rng(5), 10_000, 142, 640, gain=trend)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT, gain=trend)
    error = found.u - truth.u
    assert not wrong(error).any()
    assert np.sqrt(np.mean((error / truth.bound) ** 2, axis=1)) == pytest.approx(1, abs=0.03)
    assert found.chi2.mean() == pytest.approx(14, abs=4 * np.sqrt(28 / 10_000))
    ignored = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    assert np.median(ignored.chi2) > 50


@pytest.mark.parametrize(
    ("f", "extent", "near"),
    [
        pytest.param((80 + np.arange(5)) / 1280, 1280, 260, id="five frequencies"),
        pytest.param((80 + np.arange(8)) / 1280, 1280, 160, id="even number"),
        pytest.param((80 + np.arange(16)) / 1280, 1280, 80, id="sixteen"),
        pytest.param((80 + np.arange(9)) / 1280, 800, 142, id="shorter axis"),
        pytest.param(1 / 16.3 + np.arange(9) / 1400, 1280, 155, id="fringes that never coincide"),
    ],
)
def test_other_plans(f, extent, near):
    truth = scene(np.random.default_rng(6), 4000, near, min(640, extent - 100), f=f, extent=extent)
    found = separate_two_paths(truth.z, f, truth.sigma_z, extent)
    error = found.u - truth.u
    assert wrong(error).mean() < 0.002
    right = ~wrong(error).any(axis=0)
    # Sampling error of an rms over 4000 pixels: 1.1 %.
    assert np.sqrt(np.mean((error / truth.bound)[:, right] ** 2, axis=1)) == pytest.approx(1, abs=0.045)


def test_order_of_the_frequencies_does_not_matter():
    truth = scene(np.random.default_rng(7), 50, 142, 640)
    shuffled = np.random.default_rng(8).permutation(9)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)
    again = separate_two_paths(truth.z[shuffled], FREQUENCY[shuffled], truth.sigma_z, EXTENT)
    np.testing.assert_array_equal(again.u, found.u)


@pytest.mark.parametrize(("first", "second"), [(0.0, 1100.0), (1279.0, 640.0), (1279.2, 200.0)])
def test_ends_of_the_picture_do_not_change_sides(first, second):
    rng = np.random.default_rng(9)
    u = np.broadcast_to([[first], [second]], (2, 500))
    z = phasors(FREQUENCY, u, np.array([[80.0], [32.0]]))
    z = z + 0.8 * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape))
    found = separate_two_paths(z, FREQUENCY, np.full(500, 0.8), EXTENT)
    assert np.abs(found.u - u).max() < 0.15  # five standard deviations


def test_pure_noise_stays_inside_the_picture():
    rng = np.random.default_rng(10)
    z = rng.standard_normal((9, 2000)) + 1j * rng.standard_normal((9, 2000))
    found = separate_two_paths(z, FREQUENCY, np.ones(2000), 800)
    sound = found.converged
    np.testing.assert_array_equal(np.isfinite(found.u).all(axis=0), sound)
    assert (found.u[:, sound] >= -0.5).all()
    assert (found.u[:, sound] <= 799.5).all()
    assert (found.amplitude[0, sound] >= found.amplitude[1, sound]).all()
    assert (found.amplitude[:, sound] > 0).all()


def test_unusable_pixels_are_nan_and_leave_the_others_alone():
    truth = scene(np.random.default_rng(11), 6, 142, 640)
    z, sigma = truth.z.copy(), truth.sigma_z.copy()
    z[4, 0], z[:, 1], z[0, 2], sigma[3], sigma[4] = np.nan, 0, np.inf, 0, np.nan
    found = separate_two_paths(z, FREQUENCY, sigma, EXTENT)
    np.testing.assert_array_equal(found.converged, [False, False, False, False, False, True])
    for values in (found.u, found.amplitude, found.sigma_u, found.sigma_amplitude, found.chi2, found.margin):
        assert np.isnan(values[..., :5]).all()
    assert found.u[:, 5] == pytest.approx(truth.u[:, 5], abs=0.2)


def test_no_pixels():
    assert separate_two_paths(np.zeros((9, 0), complex), FREQUENCY, np.zeros(0), EXTENT).u.shape == (2, 0)


@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.7])
@pytest.mark.parametrize("gain", [1.0, np.linspace(1.1, 0.9, 9)], ids=["flat", "trend"])
def test_kernel_equals_twin(alpha, gain):
    truth = scene(np.random.default_rng(12), 4, 160, 640, alpha, gain=gain)
    trend = np.broadcast_to(gain, 9)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT, trend)
    for p in range(4):
        twin = separate_two_paths_twin(truth.z[:, p], FREQUENCY, truth.sigma_z[p], EXTENT, trend)
        # Both stop well within 1/100 of a standard deviation of the minimum.
        assert (np.abs(found.u[:, p] - twin.u[:, 0]) < 0.02 * twin.sigma_u[:, 0]).all()
        assert (np.abs(found.amplitude[:, p] - twin.amplitude[:, 0]) < 0.02 * twin.sigma_amplitude).all()
        assert found.sigma_u[:, p] == pytest.approx(twin.sigma_u[:, 0], rel=1e-3)
        assert found.sigma_amplitude[p] == pytest.approx(twin.sigma_amplitude[0], rel=1e-3)
        assert found.chi2[p] == pytest.approx(twin.chi2[0], abs=2e-3)


def test_close_paths_fit_no_worse_than_the_exhaustive_twin():
    truth = scene(np.random.default_rng(13), 20, 25, 100)
    found = separate_two_paths(truth.z, FREQUENCY, truth.sigma_z, EXTENT)

    def criterion(paths, p):
        return paths.chi2[p] + 2 * np.log(paths.amplitude[:, p].sum())

    for p in range(20):
        twin = separate_two_paths_twin(truth.z[:, p], FREQUENCY, truth.sigma_z[p], EXTENT)
        assert criterion(found, p) <= criterion(twin, 0) + 2e-3


@pytest.mark.parametrize(
    ("f", "extent", "says"),
    [
        (FREQUENCY[:4], 1280, "4 frequencies"),
        ([1 / 14.57, 1 / 16.09, 1 / 16.24, 1 / 16.67, 1 / 16.60], 1280, "not equidistant"),
        (np.full(5, 1 / 16), 1280, "not equidistant"),
        (FREQUENCY, 1920, "1/1280 per px repeats within 1920 px"),
    ],
)
def test_plans_that_do_not_separate_say_what_to_do(f, extent, says):
    with pytest.raises(SeparationPlanError, match=says) as caught:
        separate_two_paths(np.ones((len(f), 1), complex), f, np.ones(1), extent)
    assert caught.value.remedy


@pytest.mark.parametrize(
    "change",
    [{"z": np.ones((8, 3), complex)}, {"sigma_z": np.ones(2)}, {"gain": np.ones(5)}, {"gain": np.zeros(9)}],
)
def test_arguments_that_do_not_belong_together(change):
    arguments = {"z": np.ones((9, 3), complex), "frequency": FREQUENCY, "sigma_z": np.ones(3), "extent": 1280}
    with pytest.raises(ValueError, match="gain"):
        separate_two_paths(**{**arguments, **change})


def two_paths(u, amplitude, sigma_u=0.02, sigma_amplitude=0.3):
    """What a separation would have found."""
    u, amplitude = np.asarray(u, np.float32), np.asarray(amplitude, np.float32)
    order = np.argsort(-amplitude, axis=0)
    u, amplitude = np.take_along_axis(u, order, 0), np.take_along_axis(amplitude, order, 0)
    one = np.ones(u.shape[1], np.float32)
    spread = np.broadcast_to(np.float32(sigma_u), u.shape)
    return TwoPaths(u, amplitude, spread, sigma_amplitude * one, 14 * one, 100 * one, one > 0, 14), order


def test_larger_amplitude_is_direct_in_nine_of_ten():
    paths, _ = two_paths([[100.0], [400.0]], [[80.0], [32.0]])
    choice = choose_direct(paths)
    assert choice.ix[0] == choice.iy[0] == 0
    assert choice.confidence[0] == pytest.approx(np.log(9), rel=1e-5)


def test_equal_amplitudes_decide_nothing():
    paths, _ = two_paths([[100.0], [400.0]], [[50.0], [50.0]])
    assert choose_direct(paths).confidence[0] == pytest.approx(0, abs=1e-6)


def test_neighbours_overrule_the_amplitude():
    paths, _ = two_paths([[100.0, 100.0], [400.0, 400.0]], [[80.0, 80.0], [32.0, 32.0]])
    choice = choose_direct(paths, near_x=[401.5, np.nan])
    np.testing.assert_array_equal(choice.ix, [1, 0])


def test_one_path_has_one_amplitude_on_both_axes():
    # Only the x axis knows its neighbours; the y axis follows by the amplitude.
    x, _ = two_paths([[100.0], [400.0]], [[80.0], [32.0]])
    y, _ = two_paths([[300.0], [500.0]], [[80.5], [31.8]])
    choice = choose_direct(x, y, near_x=[400.0])
    assert (choice.ix[0], choice.iy[0]) == (1, 1)


@pytest.mark.parametrize("alpha", [0.4, 1.0, 2.0])
def test_epipolar_line_tells_the_direct_path_from_the_bounce(alpha):
    rng = np.random.default_rng(14)
    count = 5000
    noisy = [[B], [alpha * B]] + 0.3 * rng.standard_normal((2, 2, count))
    x, order_x = two_paths(rng.uniform(0, 1280, (2, count)), noisy[0])
    y, order_y = two_paths(rng.uniform(0, 800, (2, count)), noisy[1])
    # The direct pair is off by its noise, every other by what chance makes of two scattered coordinates.
    distance = rng.uniform(-400, 400, (2, 2, count))
    distance[0, 0] = 0.05 * rng.standard_normal(count)
    found_as = np.stack([distance[i, j, np.arange(count)] for i in order_x for j in order_y])
    choice = choose_direct(x, y, distance_px=found_as, sigma_px=np.full((4, count), 0.05))
    column = np.arange(count)
    right = (order_x[choice.ix, column] == 0) & (order_y[choice.iy, column] == 0)
    # Within ±0.5 px of the line by chance: 3 pairs of 1 px in 800.
    assert right.mean() > 0.994
    sure = choice.confidence > 2
    assert sure.mean() > 0.98
    assert right[sure].mean() > 0.998


def test_unknown_paths_are_not_chosen():
    x, _ = two_paths([[100.0, 100.0, np.nan], [400.0, np.nan, np.nan]], np.full((2, 3), [[80.0], [32.0]]))
    y, _ = two_paths([[300.0, 300.0, 300.0], [500.0, 500.0, 500.0]], np.full((2, 3), [[80.0], [32.0]]))
    distance = np.full((4, 3), 200.0)
    distance[3] = 0  # (x₁, y₁) lies on the line,
    distance[:, 1:] = [[0, 50], [200, 50], [np.nan, np.nan], [np.nan, np.nan]]  # where x₁ is known.
    choice = choose_direct(x, y, distance_px=distance, sigma_px=np.where(distance == 0, np.nan, 0.1))
    np.testing.assert_array_equal(choice.ix[:2], [1, 0])
    assert (choice.confidence[:2] > 0).all()
    assert np.isnan(choice.confidence[2])


def test_agreement_of_weak_paths_counts_no_more_than_of_strong_ones():
    x, _ = two_paths([[100.0], [400.0]], [[80.0], [40.0]])
    y, _ = two_paths([[300.0], [500.0]], [[80.0], [40.0]])
    choice = choose_direct(x, y)
    assert (choice.ix[0], choice.iy[0]) == (0, 0)
    # Nothing but the order of the amplitudes speaks, and that once.
    assert choice.confidence[0] == pytest.approx(np.log(9), abs=0.02)


def test_epipolar_term_needs_both_axes_and_its_sigma():
    x, _ = two_paths([[100.0], [400.0]], [[80.0], [32.0]])
    with pytest.raises(ValueError, match="both axes"):
        choose_direct(x, distance_px=np.zeros((4, 1)), sigma_px=np.ones((4, 1)))
    with pytest.raises(ValueError, match="both axes"):
        choose_direct(x, x, distance_px=np.zeros((4, 1)))
    with pytest.raises(ValueError, match="1 pixels on the first"):
        choose_direct(x, two_paths([[1.0, 2.0], [3.0, 4.0]], [[8.0, 8.0], [3.0, 3.0]])[0])
