"""A sequence that is wrong by about the noise stands out among the others of its round; bounces and gamma do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.integrity.agreement import Shown, same, standing_out
from scanner.integrity.sampling import grid
from scanner.patterns import Plan, phase_steps

SHAPE = (48, 64)
EXTENT = {"x": 320, "y": 200}
MICRO = tuple((20 + t) / 320 for t in range(9))
TEMPORAL = (1 / 16, 10 / 320, 1 / 320)


def frames_of(frequency, steps, random, gamma=1.0, sigma=1.5, bounce=0.4):
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    u = 30 + 3 * columns + 0.3 * rows
    inside = (abs(rows - 20) < 8) & (abs(columns - 30) < 10)
    grey = [
        8
        + 80 * (0.5 + 0.5 * np.cos(2 * np.pi * frequency * u + s)) ** gamma
        + 80 * bounce * inside * (0.5 + 0.5 * np.cos(2 * np.pi * frequency * (300 - 0.8 * u) + s)) ** gamma
        for s in phase_steps("x", frequency, steps).steps_rad
    ]
    return np.rint(np.stack(grey) + random.normal(0, sigma, (steps, *SHAPE)))


def shown(frames, frequency, sigma=1.5):
    steps = phase_steps("x", frequency, len(frames)).steps_rad
    z = grid(SHAPE).take_all(frames.astype(np.float32)).T @ (2 / len(steps) * np.exp(-1j * steps))
    sigma_z = sigma * np.sqrt(2 / len(steps))
    return Shown("x", frequency, z.astype(np.complex64), sigma_z, np.abs(z) > 8 * sigma_z, 1)


def odds(sequences):
    return standing_out(sequences, EXTENT, grid(SHAPE))


@pytest.mark.parametrize(
    ("frequencies", "steps", "gamma"),
    [(MICRO, 3, 1.0), (MICRO, 4, 2.2), (MICRO, 12, 2.2), (TEMPORAL, 3, 1.0), (TEMPORAL, 12, 2.2)],
)
@pytest.mark.parametrize("bounce", [0.0, 0.5])
def test_good_rounds_agree(frequencies, steps, gamma, bounce):
    for seed in range(3):
        random = np.random.default_rng(seed)
        good = [shown(frames_of(f, steps, random, gamma, bounce=bounce), f) for f in frequencies]
        assert odds(good).max() == 0


@pytest.mark.parametrize("frequencies", [MICRO, TEMPORAL])
@pytest.mark.parametrize("steps", [3, 12])
@pytest.mark.parametrize("ratio", [0.2, 1.0])
def test_light_that_flickers_in_one_frame(frequencies, steps, ratio):
    # (2/N) (e/B) / √2 is the rms error of the phase, √(2/N) σ/B its noise.
    excess = ratio * 1.5 * np.sqrt(steps)
    random = np.random.default_rng(5)
    sequences = []
    for t, f in enumerate(frequencies):
        frames = frames_of(f, steps, random)
        frames[1] += excess * (t == 1)
        sequences.append(shown(frames, f))
    found = odds(sequences)
    if ratio < 0.5:
        assert found.max() == 0
    else:
        # Of three, the two that weigh are at odds alike.
        assert found.argmax() == 1 or frequencies is TEMPORAL
        assert found[1] > 1


def test_some_rows_of_one_frame():
    random = np.random.default_rng(6)
    sequences = []
    for t, f in enumerate(MICRO):
        frames = frames_of(f, 12, random)
        # Half of the former picture in a sixth of the rows.
        if t == 4:
            frames[3, 32:40] = (frames[3, 32:40] + frames[2, 32:40]) / 2
        sequences.append(shown(frames, f))
    found = odds(sequences)
    assert found.argmax() == 4
    assert found[4] > 1


def test_the_former_sequence_in_the_first_frame():
    # Its fringes go the other way, so that none of this sequence's own shapes explains them.
    random = np.random.default_rng(7)
    former = np.broadcast_to(60 + 40 * np.cos(2 * np.pi * np.arange(SHAPE[0]) / 11)[:, None], SHAPE)
    sequences = []
    for t, f in enumerate(MICRO):
        frames = frames_of(f, 6, random)
        if t == 0:
            frames[0] += 0.08 * (former - frames[0])
        one = shown(frames, f)
        last = grid(SHAPE).take(former) if t == 0 else None
        sequences.append(replace(one, former=last))
    found = odds(sequences)
    assert found.argmax() == 0
    assert found[0] > 1


def test_what_needs_no_others_and_what_does_not_weigh_is_not_asked():
    # Steps enough to tell by themselves; and a frequency that only counts fringes.
    random = np.random.default_rng(8)
    for frequencies, wrong, sure in ((MICRO, 4, True), (TEMPORAL, 2, False)):
        sequences = []
        for t, f in enumerate(frequencies):
            frames = frames_of(f, 3, random)
            frames[1] += 6 * (t == wrong)
            sequences.append(replace(shown(frames, f), sure=sure))
        assert odds(sequences).max() == 0


def test_two_takes_are_the_same_or_not():
    random = np.random.default_rng(9)
    first, second = (frames_of(MICRO[0], 6, random) for _ in range(2))
    assert same(shown(first, MICRO[0]), shown(second, MICRO[0]))
    second[2] += 1.5 * 1.5 * np.sqrt(6)
    assert not same(shown(first, MICRO[0]), shown(second, MICRO[0]))


def small_round(plan, seed, sigma, gain, wrong=0.0):
    """The sequences of axis y that show a small region, as the pictures' grey levels make it; and the wrong one."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    u = random.uniform(5, 40) + random.uniform(2.2, 3.0) * rows + random.uniform(-0.2, 0.2) * columns
    top, left, height, width = (random.integers(*span) for span in ((0, 24), (0, 34), (10, 26), (20, 30)))
    inside = (rows >= top) & (rows < top + height) & (columns >= left) & (columns < left + width)
    light = gain * (0.75 + 0.25 * np.sin(columns / 9)) * inside
    chosen = [n for n, s in enumerate(plan.sequences) if s.axis == "y"]
    spoilt, found = int(random.integers(len(chosen))), []
    for t, n in enumerate(chosen):
        sequence = plan.sequences[n]
        lines = [picture[:, 0] / 255 for picture in plan.render(n)]
        frames = np.stack([light * np.interp(u, np.arange(plan.size[1]), line) for line in lines])
        frames += random.normal(0, sigma, frames.shape)
        frames[1] += wrong * sigma * np.sqrt(len(frames)) * (t == spoilt)
        z = grid(SHAPE).take_all(frames).T @ (2 / len(frames) * np.exp(-1j * sequence.steps_rad))
        sigma_z = sigma * np.sqrt(2 / len(frames))
        lit = grid(SHAPE).take(inside) > 0
        found.append(Shown("y", sequence.frequency, z.astype(np.complex64), sigma_z, lit, 1))
    return found, spoilt


def test_grey_levels_of_the_pictures_are_no_fault():
    # Four steps, hardly any noise, and a region that sees few projector rows: what rounding moves is no noise there.
    plan = Plan((320, 200), tuple(phase_steps("y", f, 4) for f in MICRO))
    levels = plan.rounding()
    unaware = []
    for seed in range(800, 812):
        good, _ = small_round(plan, seed, sigma=0.5, gain=230)
        assert standing_out(good, EXTENT, grid(SHAPE), levels).max() == 0
        unaware.append(odds(good).max())
    assert max(unaware) > 0


def test_a_wrong_frame_is_found_beside_the_grey_levels():
    # An error of one frame that moves the phases by 1.2 times their noise.
    plan = Plan((320, 200), tuple(phase_steps("y", f, 4) for f in MICRO))
    for seed in range(820, 828):
        sequences, spoilt = small_round(plan, seed, sigma=0.5, gain=230, wrong=1.2)
        found = standing_out(sequences, EXTENT, grid(SHAPE), plan.rounding())
        assert found.argmax() == spoilt
        assert found[spoilt] > 1
