"""A few pixels tell their own noise badly, and the limits of the check know how badly.

Compared with the distributions of F and of the normal; no limit was set on these scenes or seeds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, f, kstest, norm

from scanner.integrity.sampling import Noise, grid, noise_of
from scanner.integrity.significance import highest_by_chance, normal_deviate
from scanner.integrity.waveform import Reference, fit, other_mean
from scanner.patterns import phase_steps

SHAPE = (48, 64)
STEPS, SIGMA, DARK, GAIN = 6, 2.0, 12.0, 90.0


@pytest.mark.parametrize("probability", [1e-2, 1e-7, 4e-11])
@pytest.mark.parametrize("above", [40, 500, 3000])
@pytest.mark.parametrize("below", [50, 130, 2000, np.inf])
def test_a_ratio_of_variances_as_a_normal_variable(probability, above, below):
    finite = np.isfinite(below)
    ratio = f.isf(probability, above, below) if finite else chi2.isf(probability, above) / above
    assert normal_deviate(ratio, above, below) == pytest.approx(norm.isf(probability), rel=0.025)


def test_energy_by_chance():
    assert highest_by_chance(1e-9, 4, Noise(2.0, np.inf)) == pytest.approx(chi2.isf(1e-9, 4))
    # Four parts of a noise that is known from thirty values.
    random = np.random.default_rng(70)
    parts, noise = random.standard_normal((100_000, 4)), random.chisquare(30, 100_000) / 30
    beyond = np.square(parts).sum(axis=1) / noise > highest_by_chance(1e-2, 4, Noise(1.0, 30))
    assert beyond.mean() == pytest.approx(1e-2, abs=4 * np.sqrt(1e-2 / 100_000))


def test_measured_twice_is_known_better():
    random = np.random.default_rng(71)
    sigmas = 3 * np.sqrt(np.stack([random.chisquare(n, 20_000) / n for n in (40, 120)], axis=1))
    joined = [Noise(a, 40).joined(Noise(b, 120)) for a, b in sigmas]
    assert {one.freedom for one in joined} == {160}
    variance = np.square([one.sigma_dn for one in joined])
    assert kstest(160 * variance / 9, chi2(160).cdf).pvalue > 1e-3
    certain = Noise(2.0, np.inf)
    assert Noise(3.0, 40).joined(certain) == certain.joined(Noise(3.0, 40)) == certain


@pytest.mark.parametrize(("frames", "height", "width"), [(1, 20, 27), (1, 12, 18), (5, 12, 18)])
def test_noise_is_as_uncertain_as_it_says(frames, height, width):
    random, cells = np.random.default_rng([72, frames, height]), grid(SHAPE)
    lit = (cells.rows_px < height) & (cells.columns_px < width)
    found = [noise_of(random.normal(0, 3, (frames, lit.size)).astype(np.float32), lit, lit, 0.0) for _ in range(800)]
    sigmas, freedom = np.array([one.sigma_dn for one in found]), found[0].freedom
    scatter = 1 / np.sqrt(2 * freedom)
    # The scatter of 800 values is known to 2.5 %.
    assert sigmas.std() / 3 == pytest.approx(scatter, rel=0.1)
    assert sigmas.mean() == pytest.approx(3, rel=4 * scatter / np.sqrt(800) + 0.01)


def small_region(random, height, width):
    """Sampled (6, P) frames of a lit rectangle, their steps, and their mean; all around is cut off at black."""
    cells, plan = grid(SHAPE), phase_steps("x", 1 / 16, STEPS)
    rows, columns = cells.rows_px, cells.columns_px
    lit = (rows >= 9) & (rows < 9 + height) & (columns >= 15) & (columns < 15 + width)
    # Whole windows, lest dark pixels should be asked for the noise of light.
    lit = np.repeat(lit[::9], 9)
    gain = GAIN * random.uniform(0.6, 1.0, lit.size) * lit
    phase = 2 * np.pi / 16 * (3.1 * columns + 0.2 * rows)
    light = DARK + gain * np.stack([0.5 + 0.5 * np.cos(phase + s) for s in plan.steps_rad])
    values = (lit * (light + random.normal(0, SIGMA, light.shape))).astype(np.float32)
    mean = (lit * (DARK + gain / 2 + random.normal(0, SIGMA / np.sqrt(8 * STEPS), lit.size))).astype(np.float32)
    return values, plan.steps_rad, Reference(mean, np.ones(lit.size, bool), 1 / (8 * STEPS))


def of_the_mean(values, steps, reference, known=None):
    everywhere = np.ones(values.shape[1], bool)
    waveform = fit(values, everywhere, steps, reference, round_noise=known)
    return waveform, other_mean(waveform, reference, STEPS, grid(SHAPE))


def test_the_mean_of_a_small_region_is_what_noise_makes_of_it():
    random, aware, unaware = np.random.default_rng(73), [], []
    for _ in range(400):
        values, steps, reference = small_region(random, 20, 27)
        waveform, _ = of_the_mean(values, steps, reference)
        off = (waveform.mean - reference.mean)[waveform.usable]
        ratio = np.square(off).mean() / (waveform.sigma_dn * reference.noise_gain(STEPS)) ** 2
        aware.append(normal_deviate(ratio, off.size, waveform.noise.freedom))
        unaware.append(normal_deviate(ratio, off.size, np.inf))
    assert kstest(aware, norm.cdf).pvalue > 1e-3
    # As if the noise were known: more than twice as far off as it says.
    assert np.std(unaware) > 2


@pytest.mark.parametrize(("height", "width"), [(20, 27), (12, 18)])
def test_no_small_region_is_refused_for_its_own_noise(height, width):
    random = np.random.default_rng([74, height])
    worst, unaware = [], []
    for _ in range(500):
        values, steps, reference = small_region(random, height, width)
        waveform, found = of_the_mean(values, steps, reference)
        worst.append(found.max())
        certain = replace(waveform, noise=Noise(waveform.sigma_dn, np.inf))
        unaware.append(other_mean(certain, reference, STEPS, grid(SHAPE)).max())
    assert max(worst) < 1
    if height == 12:
        assert max(unaware) > 1


def test_what_the_round_has_shown_makes_a_wrong_mean_certain():
    # One frame off by 1.6 times what moves the phase by its noise: of a first sequence its mean leaves that open.
    random = np.random.default_rng(75)
    alone, later = [], []
    for _ in range(40):
        values, steps, reference = small_region(random, 12, 18)
        values[2, reference.mean > 0] += 1.6 * SIGMA * np.sqrt(STEPS)
        alone.append(of_the_mean(values, steps, reference)[1].max())
        later.append(of_the_mean(values, steps, reference, Noise(SIGMA, 600.0))[1].max())
    assert min(later) > 1
    assert np.median(alone) < 1
