"""Gamma of a real projector and camera, from other people's frames: a wall, three steps, two pre-applied gammas.

The projector coordinate of every pixel comes from the Gray code of the same set, smoothed over the flat wall. The
authors' own estimate is γ = 1.6448 (`gamma_result.txt`).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.photometry import (
    fringe_harmonics,
    gamma_of_intensity,
    gamma_of_phase_error,
    power_harmonics,
    predict_phase_error,
)
from scanner.response import LEVELS, ProjectorResponse

KAMINO = Path(__file__).resolve().parents[3] / "shared" / "data" / "kamino_phase_shifting" / "gamma_correction"

pytestmark = pytest.mark.skipif(not KAMINO.is_dir(), reason=f"the real captures {KAMINO} are not on this machine")

PERIOD = 240
AUTHORS = 1.6448
SETS = {("x", 0.75): (0, 1, 2), ("x", 1.25): (3, 4, 5), ("y", 0.75): (6, 7, 8), ("y", 1.25): (9, 10, 11)}


@pytest.fixture(scope="module")
def wall():
    """Frames at every fourth pixel, the projector coordinates there, and the pixels where both are known."""
    frames = np.stack([cv2.imread(str(KAMINO / f"pat{i:02d}.png"), 0)[::4, ::4] for i in range(54)]).astype(float)
    white, black = frames[52], frames[53]
    good = white - black > 100
    rows, columns = np.mgrid[0 : white.shape[0], 0 : white.shape[1]] / white.shape[1] - 0.4
    terms = np.stack([columns**i * rows**j for i in range(6) for j in range(6 - i)], axis=-1)
    coordinates = {}
    for axis, first, cells in (("x", 12, 960), ("y", 32, 540)):
        bit, code = np.zeros(white.shape, int), np.zeros(white.shape, int)
        for pair in range(first, first + 20, 2):
            # The Gray code's pairs are picture and inverse, the highest bit first.
            bit ^= frames[pair] > frames[pair + 1]
            code = 2 * code + bit
            good = good & (np.abs(frames[pair] - frames[pair + 1]) > 4)
        known = good & (code < cells)
        solution = np.linalg.lstsq(terms[known], 2 * code[known] + 0.5, rcond=None)[0]
        coordinates[axis] = terms @ solution
        good = good & (np.abs(2 * code + 0.5 - coordinates[axis]) < 4)
    assert good.mean() > 0.5
    return frames, coordinates, good


def seen(wall, axis, applied):
    """(3, M) frames, true phase, and (3, M) grey levels that were sent, at the good pixels."""
    frames, coordinates, good = wall
    theta = 2 * np.pi * coordinates[axis][good] / PERIOD
    turns = theta + 2 * np.pi / 3 * np.array([-1, 0, 1])[:, None]
    sent = ((1 + np.cos(turns)) / 2) ** (1 / applied)
    return frames[list(SETS[axis, applied])][:, good], theta, sent


@pytest.fixture(scope="module")
def by_intensity(wall):
    frames, _, good = wall
    white, black = frames[52][good], frames[53][good]
    return {
        key: gamma_of_intensity(sent.reshape(-1), ((values - black) / (white - black)).reshape(-1))
        for key in SETS
        for values, _, sent in [seen(wall, *key)]
    }


@pytest.fixture(scope="module")
def by_phase(wall):
    found = {}
    for axis, applied in SETS:
        values, theta, _ = seen(wall, axis, applied)
        z = (values * np.exp(-2j * np.pi / 3 * np.array([-1, 0, 1]))[:, None]).sum(axis=0)
        estimate = gamma_of_phase_error(theta, np.angle(z * np.exp(-1j * theta)), 3)
        found[axis, applied] = estimate.gamma * applied
    return found


def test_two_independent_methods_agree(by_intensity, by_phase, capsys):
    one = float(np.mean([e.gamma for e in by_intensity.values()]))
    two = float(np.mean(list(by_phase.values())))
    with capsys.disabled():
        print(f"\nγ by intensity {one:.4f}, by phase error {two:.4f}, authors {AUTHORS}")
        for key in SETS:
            e = by_intensity[key]
            print(f"  {key}: intensity {e.gamma:.4f} ± {e.sigma:.4f}, phase {by_phase[key]:.4f}")
    assert one == pytest.approx(two, rel=0.05)
    assert one == pytest.approx(AUTHORS, rel=0.05)
    assert two == pytest.approx(AUTHORS, rel=0.05)
    # Either axis gives the same.
    for found in ({k: e.gamma for k, e in by_intensity.items()}, by_phase):
        for applied in (0.75, 1.25):
            assert found["x", applied] == pytest.approx(found["y", applied], rel=0.02)


@pytest.mark.parametrize("judged", ["x", "y"])
def test_correction_lowers_the_second_harmonic_fivefold_in_prediction(by_intensity, by_phase, judged):
    """γ from the grey values of one axis corrects; what it leaves is judged by the phases of the other."""
    other = {"x": "y", "y": "x"}[judged]
    measured = np.mean([by_intensity[other, applied].gamma for applied in (0.75, 1.25)])
    true = np.mean([by_phase[judged, applied] for applied in (0.75, 1.25)])
    before = power_harmonics(true, 2)[1]
    after = power_harmonics(true / measured, 2)[1]
    assert before > 0.15
    assert abs(after) < before / 5
    light, correction = ProjectorResponse.power(true).light, ProjectorResponse.power(measured).light
    b = fringe_harmonics(light, correction=correction, count=2)
    assert b[2] / b[1] == pytest.approx(after, abs=0.002)
    errors = [predict_phase_error(light, 1 / PERIOD, 3, correction=c) for c in (None, correction)]
    assert errors[1].rms_rad < errors[0].rms_rad / 5


def test_prediction_is_what_the_frames_show(wall, by_phase):
    """The measured curve, from grey values at one pre-applied gamma, predicts the phase error at the other."""
    frames, _, good = wall
    white, black = frames[52][good], frames[53][good]
    values, _, sent = seen(wall, "x", 0.75)
    level = np.rint(sent * (LEVELS - 1)).astype(int).reshape(-1)
    light = ((values - black) / (white - black)).reshape(-1)
    count = np.bincount(level, minlength=LEVELS)
    curve = np.bincount(level, weights=light, minlength=LEVELS) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    curve = np.maximum.accumulate(np.interp(np.arange(LEVELS), known, curve[known]))
    curve = (curve - curve[0]) / (curve[-1] - curve[0])
    values, theta, _ = seen(wall, "x", 1.25)
    z = (values * np.exp(-2j * np.pi / 3 * np.array([-1, 0, 1]))[:, None]).sum(axis=0)
    error = np.angle(z * np.exp(-1j * theta))
    predicted = predict_phase_error(curve, 1 / PERIOD, 3, correction=ProjectorResponse.power(1.25).light)
    rms = np.sqrt(np.mean((error - np.median(error)) ** 2))
    assert rms == pytest.approx(predicted.rms_rad, rel=0.3)
    assert rms == pytest.approx(predicted.rms_rad, abs=0.02)
    assert by_phase["x", 1.25] > 1.25
