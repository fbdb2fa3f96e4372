"""Coordinates and their σ against what was put in, and against the bound √(2/N) σ_I / (2π f B), frequencies fused."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import FrameFormat, NoiseModel
from scanner.patterns import Plan, phase_steps, unambiguous_range
from scanner.phasors import RoundPhasors
from scanner.unwrapping import modulation_trend, unwrap

PLANS = {
    "mfs": [(80 + t) / 1280 for t in range(9)],
    "tps": [1 / 16, 1 / 128, 1 / 1280],
    "mps": [1 / p for p in (14.57, 16.09, 16.24, 16.67, 16.60)],
}


def decode(u, frequencies, steps, sigma, seed, extent=1280, amplitude=80.0, trend=None):
    """Frames of one row of pixels at ``u`` through the product, and what comes out."""
    rng = np.random.default_rng(seed)
    plan = Plan((extent, 16), tuple(phase_steps("x", f, steps) for f in frequencies))
    collected = RoundPhasors(plan, FrameFormat(u.size, 1, 8))
    for i, sequence in enumerate(plan.sequences):
        b = amplitude * (1 if trend is None else trend[i])
        ideal = 110 + b * np.cos(2 * np.pi * frequencies[i] * u + sequence.steps_rad[:, None])
        frames = np.clip(np.rint(ideal + rng.normal(0, sigma, ideal.shape)), 0, 255).astype(np.uint8)
        collected.add(i, frames[:, None, :])
    phasors = collected.axis("x")
    noise = NoiseModel(float(np.sqrt(sigma**2 + 1 / 12)))
    sigma_z = phasors.sigma_z(noise, collected.mean)
    gain = modulation_trend(phasors, sigma_z)
    return unwrap(phasors, sigma_z, extent, gain), gain, collected


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("steps", [3, 4, 12])
def test_error_is_the_bound_and_sigma_says_so(name, steps):
    sigma = 1.5
    u = np.random.default_rng(11).uniform(0, 1279, 20_000)
    c, _, _ = decode(u, PLANS[name], steps, sigma, seed=steps)
    error = c.u[0] - u
    noise = np.sqrt(2 / steps * (sigma**2 + 1 / 12))
    bound = noise / (2 * np.pi * 80 * np.sqrt(np.sum(np.square(PLANS[name]))))
    assert (np.abs(error) < 4).all()
    # 20 000 pixels know their standard deviation to 0.5 %; 3 % leaves room for the estimated modulation.
    assert error.std() == pytest.approx(bound, rel=0.03)
    assert np.median(c.sigma) == pytest.approx(bound, rel=0.03)
    assert abs(error.mean()) < 5 * bound / np.sqrt(u.size) + 1e-4
    assert c.chi2.mean() == pytest.approx(c.dof, rel=0.05)


def test_wrong_orders_at_high_noise_are_as_rare_as_maximum_likelihood_allows():
    u = np.random.default_rng(1).uniform(0, 1279, 20_000)
    c, _, _ = decode(u, PLANS["mfs"], 12, 20.0, seed=2)
    wrong = np.abs(c.u[0] - u) > 4
    # method.md §3: 1 % at σ = 20 DN, where the hierarchy has 4 %.
    assert wrong.mean() <= 0.015
    # What the likelihood ratio calls clear is clear: e⁻⁷ ≈ 0.1 %.
    assert wrong[c.lead[0] > 7].mean() <= 0.001


def test_first_column_does_not_wrap_to_the_last():
    u = np.concatenate([np.zeros(5000), np.full(5000, 1279.0)])
    c, _, _ = decode(u, PLANS["mfs"], 12, 10.0, seed=4)
    assert (np.abs(c.u[0] - u) < 1).all()


def test_optics_trend_is_measured_and_taken_out():
    trend = 1 - 0.06 * np.arange(9) / 8
    u = np.random.default_rng(1).uniform(0, 1279, 20_000)
    c, gain, _ = decode(u, PLANS["mfs"], 12, 1.5, seed=5, trend=trend)
    np.testing.assert_allclose(gain, trend / trend.mean(), atol=1e-3)
    assert c.chi2.mean() == pytest.approx(c.dof, rel=0.05)


def test_noise_is_found_in_the_frames_themselves():
    rng = np.random.default_rng(8)
    shape = (200, 300)
    u = np.broadcast_to(np.linspace(5, 700, 300), shape)
    for steps in (3, 12):
        plan = Plan((1280, 800), tuple(phase_steps("x", f, steps) for f in PLANS["mfs"]))
        collected = RoundPhasors(plan, FrameFormat(300, 200, 16))
        level = np.linspace(2000, 30_000, 200)[:, None]
        for i, sequence in enumerate(plan.sequences):
            ideal = level * (1 + 0.7 * np.cos(2 * np.pi * PLANS["mfs"][i] * u + sequence.steps_rad[:, None, None]))
            noisy = ideal + rng.normal(0, 1, ideal.shape) * np.sqrt(30.0**2 + 0.2 * ideal)
            collected.add(i, np.rint(noisy).astype(np.uint16))
        found = collected.estimate_noise()
        grey = np.array([3000.0, 12_000.0, 28_000.0])
        np.testing.assert_allclose(
            found.variance(grey), 30.0**2 + 0.2 * grey, rtol=0.1
        )  # shot noise within a fringe is not that of its mean


def test_unambiguous_ranges():
    assert unambiguous_range(PLANS["mfs"]) == pytest.approx(1280)
    assert unambiguous_range(PLANS["tps"]) == pytest.approx(1280)
    assert unambiguous_range([1 / 16, 1 / 80, 1 / 800]) == pytest.approx(800)
    assert unambiguous_range([1 / 100, 3 / 200]) == pytest.approx(200)
    assert unambiguous_range(PLANS["mps"]) > 1280
