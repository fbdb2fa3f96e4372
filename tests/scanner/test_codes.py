"""F + 2 frames have nothing to spare: what tells a wrong one is that all pixels must have codes of the same columns."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import FrameFormat, NoiseModel
from scanner.config import ScanSection
from scanner.integrity import SequenceHistory, check_sequence
from scanner.methods import METHODS
from scanner.methods.gupta_nayar import nearest_code

SIZE, SHAPE, FRAMES = (320, 200), (48, 64), 7
PLAN = METHODS["mps_gn"].first_round(ScanSection(method="mps_gn"), SIZE)
FORMAT = FrameFormat(SHAPE[1], SHAPE[0], 8)


def scene(seed, gamma=1.0, bounce=0.4):
    """(uniform level → grey, frames without noise, x)."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    x = random.uniform(5, 60) + random.uniform(2.5, 3.7) * columns + 0.3 * rows
    gain = random.uniform(80, 150) * random.uniform(0.6, 1, SHAPE)
    share = bounce * ((abs(rows - 20) < 8) & (abs(columns - 30) < 10))

    def grey(fringe):
        direct, indirect = (
            0.5 + 0.5 * np.cos(2 * np.pi * fringe.frequency * u + fringe.step_rad) for u in (x, 300 - 0.8 * x)
        )
        return 8 + gain * (direct**gamma + share * indirect**gamma)

    return lambda level: 8 + gain * (1 + share) * level**gamma, [grey(f) for f in PLAN.sequences[0].fringes], x


def noisy(frames, seed, sigma=1.5):
    random = np.random.default_rng(seed + 100)
    return np.clip(np.rint(np.stack(frames) + random.normal(0, sigma, (len(frames), *SHAPE))), 0, 255).astype(np.uint8)


def check(seed, frames, level, sigma=1.5):
    history = SequenceHistory()
    bright, dark = noisy([level(1.0), level(0.0)], seed + 50, sigma)
    history.begin_round(SIZE, levels=(bright, dark), saturated_dn=FORMAT.saturated_dn)
    return check_sequence(noisy(frames, seed, sigma), PLAN.sequences[0], FORMAT.saturated_dn, history)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("gamma", [0.8, 1.0, 2.2])
def test_harmonics_and_bounces_are_no_reason_for_alarm(seed, gamma):
    level, frames, _ = scene(seed, gamma)
    assert check(seed, frames, level).findings == ()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("first", range(1, FRAMES))
@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_projector_that_lags_for_a_while(seed, first, count):
    level, frames, _ = scene(seed)
    late = [frames[n - (first <= n < first + count)] for n in range(FRAMES)]
    assert check(seed, late, level).findings


@pytest.mark.parametrize("step", range(3))
@pytest.mark.parametrize(("ratio", "found"), [(0.3, False), (1.2, True)])
def test_light_that_flickers_in_one_of_the_steps(step, ratio, found):
    level, frames, _ = scene(7)
    # (2/3) (e/B) / √2 is the rms error of the phase, √(2/3) σ/B its noise.
    frames[step] = frames[step] + ratio * 0.7 * np.sqrt(3)
    assert bool(check(7, frames, level, 0.7).findings) == found


def test_codes_are_decoded_with_the_steps_of_their_patterns():
    _, frames, x = scene(1, bounce=0)
    assert [f.step_rad for f in PLAN.sequences[0].fringes[3:]] == pytest.approx([0, np.pi, 0, np.pi])
    found = nearest_code(noisy(frames, 1), PLAN.sequences[0], SIZE[0], NoiseModel(1.5)).coordinates
    assert (np.abs(found.u - x) < 5 * found.sigma).mean() > 0.99
