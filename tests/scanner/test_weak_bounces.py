"""Weak bounces on both axes of a round: what one axis shows, the other has to answer for."""

from types import SimpleNamespace

import numpy as np
import pytest

from scanner.config import ScanSection
from scanner.methods.multi_frequency import DecodedAxis
from scanner.methods.weak_bounces import without_ripples
from scanner.phasors import AxisPhasors
from scanner.unwrapping import unwrap

FREQUENCY = np.array([(80 + t) / 1280 for t in range(9)])
AMPLITUDE, SIGMA, ALPHA = 80.0, 0.6, 0.06


def axis(name, u, apart, seed):
    """Phasors and coordinates of a surface at ``u`` with a second path ``apart`` from it."""
    turn = 2j * np.pi * FREQUENCY[:, None, None]
    z = AMPLITUDE * np.exp(turn * u) * (1 + ALPHA * np.exp(turn * apart))
    noise = np.random.default_rng(seed).normal(0, SIGMA, (2, *z.shape))
    phasors = AxisPhasors(name, FREQUENCY, (z + noise[0] + 1j * noise[1]).astype(np.complex64), 1 / 6)
    sigma = np.full(u.shape, SIGMA, np.float32)
    found = unwrap(phasors, sigma, 1280)
    return phasors, DecodedAxis(found, found.amplitude, sigma, np.ones(9))


@pytest.mark.parametrize("still_px", [3.0, -5.0, 8.0])
def test_an_axis_on_which_the_bounce_stands_still_has_a_sigma_that_covers_it(still_px):
    rows, columns = np.mgrid[:96, :96].astype(float)
    u = {"x": 300 + columns, "y": 200 + rows}
    # Along x the distance to the second path runs, along y it stays: no ripple, and the surface is off as a whole.
    parts = {
        "x": axis("x", u["x"], 40 + 1.8 * columns, 3),
        "y": axis("y", u["y"], np.full(rows.shape, still_px), 4),
    }
    frames = SimpleNamespace(axis=lambda a: parts[a][0], plan=SimpleNamespace(extent=lambda a: 1280))
    decoded = {a: p[1] for a, p in parts.items()}
    whole = np.ones(rows.shape, bool)
    off = np.abs(decoded["y"].coordinates.u - u["y"])
    assert (off < 3 * decoded["y"].coordinates.sigma).mean() < 0.5
    found, changed, told = without_ripples(frames, decoded, whole, whole, SimpleNamespace(scan=ScanSection()))
    assert changed.mean() > 0.95
    # The shift, α · 16 px/2π at most, is several σ along x.
    assert told.mean() > 0.95
    for a in ("x", "y"):
        now = found[a].coordinates
        assert (np.abs(now.u - u[a]) < 3 * now.sigma).mean() > 0.99
    kept, changed, told = without_ripples(
        frames, decoded, whole, whole, SimpleNamespace(scan=ScanSection(remove_ripples=False))
    )
    assert kept is decoded
    assert not changed.any()
    assert not told.any()
