"""The compiled loops against their plain twins, and both against what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from scanner import kernels

MFS = np.array([(80 + t) / 1280 for t in range(9)])


def stepped_frames(rng, u, frequency, steps, mean=110.0, amplitude=80.0, sigma=1.5, dtype=np.uint8):
    ideal = mean + amplitude * np.cos(2 * np.pi * frequency * u + steps[:, None])
    top = 2 ** (8 * np.dtype(dtype).itemsize) - 1
    return np.clip(np.rint(ideal + rng.normal(0, sigma, ideal.shape)), 0, top).astype(dtype)


@pytest.mark.parametrize("count", [3, 4, 5, 12])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("pixels", [1, 511, 512, 70_001])
def test_demodulate_equals_its_twin(count, dtype, pixels):
    rng = np.random.default_rng(count * pixels)
    steps = 2 * np.pi * np.arange(1, count + 1) / count
    frames = stepped_frames(rng, rng.uniform(0, 1280, pixels), 1 / 16, steps, dtype=dtype)
    z = np.empty(pixels, np.complex64)
    mean, residual = np.zeros(pixels, np.float32), np.zeros(pixels, np.float32)
    saturated = np.zeros(pixels, bool)
    kernels.demodulate(frames, steps, 189, z, mean, residual, saturated)
    z2, mean2, residual2, saturated2 = kernels.demodulate_twin(frames, steps, 189)
    # Single precision: 24 bits of grey values around 200, summed over the steps.
    np.testing.assert_allclose(z, z2, atol=2e-4)
    np.testing.assert_allclose(mean, mean2, atol=2e-4)
    np.testing.assert_allclose(residual, residual2, atol=2e-2)
    assert (saturated == saturated2).all()


def test_unequal_steps_are_solved_by_least_squares():
    rng = np.random.default_rng(5)
    u = rng.uniform(0, 1280, 1000)
    steps = np.radians([0, 80, 200, 290.0])
    frames = np.rint(100 * (300 + 200 * np.cos(2 * np.pi * u / 20 + steps[:, None]))).astype(np.uint16)
    z = np.empty(1000, np.complex64)
    kernels.demodulate(
        frames, steps, 65535, z, np.zeros(1000, np.float32), np.zeros(1000, np.float32), np.zeros(1000, bool)
    )
    # Rounding to one of 20 000 levels of B is all that differs from the analytic phasor.
    np.testing.assert_allclose(z, 20_000 * np.exp(2j * np.pi * u / 20), atol=2)


def test_steps_that_do_not_determine_the_phase_are_refused():
    with pytest.raises(ValueError, match="do not determine"):
        kernels.demodulation_matrices(np.radians([0.0, 180.0, 0.0]))


@pytest.mark.parametrize(
    "frequency", [MFS, np.array([1 / 16, 1 / 128, 1 / 1280]), 1 / np.array([14.57, 16.09, 16.24, 16.67, 16.60])]
)
@pytest.mark.parametrize("sigma_z", [0.5, 8.0])
def test_unwrap_equals_its_twin(frequency, sigma_z):
    rng = np.random.default_rng(3)
    u = rng.uniform(-0.4, 1279.4, 3001)
    z = 80 * np.exp(2j * np.pi * frequency[:, None] * u)
    z += rng.normal(0, sigma_z, z.shape) + 1j * rng.normal(0, sigma_z, z.shape)
    gain = 1 + 0.02 * np.linspace(1, -1, len(frequency))
    sigma = np.full(u.size, sigma_z)
    fast = kernels.unwrap(z.astype(np.complex64), frequency, gain, sigma.astype(np.float32), -0.5, 1279.5)
    plain = kernels.unwrap_twin(z, frequency, gain, sigma, -0.5, 1279.5)
    # Where two orders are equally likely, rounding may choose either; nowhere else.
    clear = plain[4] > 0.01
    assert clear.mean() > 0.98
    for got, expected, tolerance in zip(fast, plain, (3e-4, 1e-4, 1e-3, 1e-2, 2e-2), strict=True):
        scale = np.maximum(np.abs(expected[clear]), 1)
        assert np.max(np.abs(got[clear] - expected[clear]) / scale) < tolerance


def test_sine_and_cosine_polynomials():
    from numba import njit

    @njit
    def evaluate(x, s, c):
        for i in range(x.size):
            s[i], c[i] = kernels.sin_cos_turns(x[i])

    x = np.linspace(-3, 90, 200_001).astype(np.float32)
    s, c = np.empty_like(x), np.empty_like(x)
    evaluate(x, s, c)
    exact = 2 * np.pi * x.astype(np.float64)
    # 24 bits of 90 turns leave 4e-6 turns only in the argument itself, which is exact here: what is left is the series.
    np.testing.assert_allclose(s, np.sin(exact), atol=1e-6)
    np.testing.assert_allclose(c, np.cos(exact), atol=1e-6)


def test_blocks_cover_every_pixel_once_and_errors_come_through():
    seen = np.zeros(200_003, int)

    def mark(a, b):
        seen[a:b] += 1

    kernels.over_pixels(mark, seen.size)
    assert (seen == 1).all()

    def fail(a, b):
        raise RuntimeError("block")

    with pytest.raises(RuntimeError, match="block"):
        kernels.over_pixels(fail, 10)
