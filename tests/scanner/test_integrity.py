"""Sequences with one thing wrong are found, good ones are not, whatever noise, gamma and bounces there are."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.integrity import check_sequence, repeated_frames
from scanner.patterns import phase_steps

SHAPE = (60, 80)


def sequence(seed=0, steps=12, sigma=1.5, gamma=1.0, bounce=0.3, period=16.0):
    rng = np.random.default_rng(seed)
    plan = phase_steps("x", 1 / period, steps)
    u = np.broadcast_to(np.linspace(100, 400, SHAPE[1]), SHAPE)
    level = rng.uniform(0.2, 1.0, SHAPE)
    ideal = [0.5 + 0.5 * np.cos(2 * np.pi * u / period + s) for s in plan.steps_rad]
    second = [0.5 + 0.5 * np.cos(2 * np.pi * (u + 200) / period + s) for s in plan.steps_rad]
    frames = [5 + 160 * level * (a**gamma + bounce * b**gamma) for a, b in zip(ideal, second, strict=True)]
    return plan, np.clip(np.rint(np.stack(frames) + rng.normal(0, sigma, (steps, *SHAPE))), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("steps", [3, 4, 5, 12])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("sigma", [0.5, 10.0])
@pytest.mark.parametrize("seed", range(3))
def test_good_sequences_pass(steps, gamma, sigma, seed):
    plan, frames = sequence(seed, steps, sigma, gamma)
    assert check_sequence(frames, plan, 255).findings == ()


@pytest.mark.parametrize("steps", [5, 8, 12])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("wrong", [1, 3])
def test_stale_frame_is_named(steps, gamma, wrong):
    plan, frames = sequence(1, steps, gamma=gamma)
    rng = np.random.default_rng(9)
    # The pattern before it once more, with noise of its own.
    frames[wrong] = np.clip(frames[wrong - 1] + rng.normal(0, 1.5, SHAPE), 0, 255).astype(np.uint8)
    found = check_sequence(frames, plan, 255)
    assert [f.frame for f in found.findings] == [wrong]
    assert f"shows step {wrong} of" in found.findings[0].message


def test_repeated_frame_is_named_even_with_three_steps():
    plan, frames = sequence(1, 3)
    frames[2] = frames[0]
    assert "frame 3 is frame 1 over again" in check_sequence(frames, plan, 255).findings[0].message
    assert repeated_frames(frames) == [(0, 2)]


def test_swapped_frames_are_named():
    plan, frames = sequence(1, 12)
    frames[[4, 7]] = frames[[7, 4]]
    assert [f.frame for f in check_sequence(frames, plan, 255).findings] == [4, 7]


def test_whole_order_shuffled_is_found():
    plan, frames = sequence(1, 12)
    order = np.random.default_rng(3).permutation(12)
    assert not check_sequence(frames[order], plan, 255).good


def test_blank_and_mixed_frames_are_found():
    plan, frames = sequence(1, 12)
    dark = frames.copy()
    dark[5] = np.random.default_rng(0).normal(5, 1.5, SHAPE).clip(0, 255)
    assert 5 in [f.frame for f in check_sequence(dark, plan, 255).findings]
    torn = frames.copy()
    torn[6] = (frames[6].astype(float) / 2 + frames[0].astype(float) / 2).astype(np.uint8)
    assert 6 in [f.frame for f in check_sequence(torn, plan, 255).findings]


@pytest.mark.parametrize("seed", range(4))
def test_a_part_of_one_fringe_is_no_reason_for_alarm(seed):
    # One period over the projector, of which the object sees a third; half of the pixels see a bounce as well.
    rng = np.random.default_rng(seed)
    plan = phase_steps("x", 1 / 1280, 12)
    u = np.broadcast_to(np.linspace(300, 750, SHAPE[1]), SHAPE)
    alpha = np.where(u < 500, 0.5, 0.0)
    frames = [
        5 + 80 * (1 + np.cos(2 * np.pi * u / 1280 + s)) + 80 * alpha * (1 + np.cos(2 * np.pi * (900 - u) / 1280 + s))
        for s in plan.steps_rad
    ]
    noisy = np.rint(np.stack(frames) * 0.9 + rng.normal(0, 1.5, (12, *SHAPE))).astype(np.uint8)
    assert check_sequence(noisy, plan, 255).good
    stale = noisy.copy()
    stale[6] = np.clip(noisy[5] + rng.normal(0, 1.0, SHAPE), 0, 255).astype(np.uint8)
    assert not check_sequence(stale, plan, 255).good


def test_without_fringes_there_is_nothing_to_say():
    rng = np.random.default_rng(1)
    noise = rng.normal(5, 1.5, (12, *SHAPE)).clip(0, 255).astype(np.uint8)
    found = check_sequence(noise, phase_steps("x", 1 / 16, 12), 255)
    assert found.good
    assert found.usable == 0.0
    black = np.zeros((12, *SHAPE), np.uint8)
    assert check_sequence(black, phase_steps("x", 1 / 16, 12), 255).good


@pytest.mark.parametrize(("steps", "gamma"), [(6, 1.0), (12, 1.0), (12, 2.2)])
@pytest.mark.parametrize(("ratio", "found"), [(0.3, False), (0.65, True)])
def test_an_error_that_is_lost_in_the_noise_of_every_pixel(steps, gamma, ratio, found):
    # (2/N) (e/B) / √2 is the rms error of the phase, √(2/N) σ/B its noise.
    plan, frames = sequence(4, steps, 3.0, gamma)
    frames = np.clip(
        frames.astype(int) + np.rint(ratio * 3.0 * np.sqrt(steps)).astype(int) * (np.arange(steps) == 2)[:, None, None],
        0,
        255,
    )
    assert bool(check_sequence(frames.astype(np.uint8), plan, 255).findings) == found


def test_a_part_of_the_former_picture_in_a_few_rows():
    plan, frames = sequence(5, 12, 3.0)
    former, own = frames[4, 20:28].astype(float), frames[5, 20:28]
    rng = np.random.default_rng(1)
    frames[5, 20:28] = np.rint(0.55 * own + 0.45 * former + rng.normal(0, 2, own.shape))
    findings = check_sequence(frames, plan, 255).findings
    assert findings
    assert "rows" in findings[0].message
