"""Weak bounces on analytic surfaces: what is taken off, and what must stay. Ground truth is the formula of the surface.

The limits in `scanner.ripples` were chosen on rendered scenes (objects on a table, a V of two boards); none is here.
"""

import numpy as np
import pytest

from scanner.phasors import AxisPhasors
from scanner.result import Flag
from scanner.ripples import remove_ripples
from scanner.unwrapping import unwrap

EXTENT = 1280
FREQUENCY = np.array([(80 + t) / EXTENT for t in range(9)])
AMPLITUDE, SIGMA = 80.0, 0.6  # DN; twelve steps at 1.5 DN


def grid(side, pitch=1.0):
    return pitch * np.mgrid[:side, :side].astype(float)


def phasors(u, second=None, alpha=0.0, albedo=1.0, seed=1):
    """Phasors of a surface at ``u``, of a second path at ``second``, with noise."""
    rng = np.random.default_rng(seed)
    turn = 2j * np.pi * FREQUENCY[:, None, None]
    z = AMPLITUDE * albedo * np.exp(turn * u)
    if second is not None:
        z = z + alpha * AMPLITUDE * np.exp(turn * second)
    noise = rng.normal(0, SIGMA, (2, *z.shape))
    return AxisPhasors("x", FREQUENCY, (z + noise[0] + 1j * noise[1]).astype(np.complex64), 1 / 6)


def cleaned(found, good=None, asked=None):
    sigma = np.full(found.z.shape[1:], SIGMA, np.float32)
    good = np.ones(sigma.shape, bool) if good is None else good
    before = unwrap(found, sigma, EXTENT)
    after, ripple = remove_ripples(found, before, sigma, np.ones(9), good, good if asked is None else asked, EXTENT)
    return before, after, ripple


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def curved(y, x):
    """A surface that bends a little, px."""
    return 300 + 0.9 * x + 0.1 * y + 2e-4 * (x - 40) ** 2


@pytest.mark.parametrize("alpha", [0.02, 0.04, 0.1])
@pytest.mark.parametrize(("far", "run"), [(30.0, (0.3, 1.4)), (-190.0, (1.0, 0.8)), (60.0, (-0.4, 1.8))])
def test_the_ripples_of_a_weak_bounce_are_taken_off(alpha, far, run):
    y, x = grid(96)
    u = curved(y, x)
    before, after, ripple = cleaned(phasors(u, u + far + run[0] * y + run[1] * x, alpha, seed=round(100 * alpha)))
    noise = rms(before.sigma)
    assert rms(before.u - u) > 1.3 * noise
    assert (ripple > 0).mean() > 0.95
    assert np.median(ripple) == pytest.approx(alpha, rel=0.1)
    assert rms(after.u - u) < 1.1 * noise
    assert (np.abs(after.u - u) < 3 * after.sigma).mean() > 0.99
    assert after.chi2.mean() == pytest.approx(after.dof, rel=0.03)


def test_two_bounces_in_one_place_are_taken_off_together():
    y, x = grid(96)
    u = curved(y, x)
    found = phasors(u, u + 60 + 2.0 * x, 0.04)
    found.z += (0.03 * AMPLITUDE * np.exp(2j * np.pi * FREQUENCY[:, None, None] * (u - 150 + 1.3 * y - x))).astype(
        np.complex64
    )
    before, after, _ = cleaned(found)
    assert rms(before.u - u) > 4 * rms(before.sigma)
    assert rms(after.u - u) < 1.3 * rms(before.sigma)


def machined(y, x):
    """Grooves of 0.06 px that run across, eleven pixels apart."""
    return 0.06 * np.cos(2 * np.pi * (x + 0.3 * y) / 11)


SURFACES = {
    "relief": lambda y, x: (machined(y, x), 1.0),
    "albedo": lambda y, x: (0.0, 1 + 0.1 * np.cos(2 * np.pi * (y - x) / 9)),
    # Shading follows the slope, a quarter turn from the height: in one sideband, like a bounce at one frequency.
    "relief and its shading": lambda y, x: (machined(y, x), 1 + 0.0235 * np.sin(2 * np.pi * (x + 0.3 * y) / 11)),
    "steps": lambda y, x: (0.4 * (x > 50) - 0.3 * (y > 31), np.where(x > 61, 0.6, 1.0)),
    "crease": lambda y, x: (0.5 * np.abs(x - 47), 1 - 0.2 * (x > 47)),
    "nothing": lambda y, x: (0.0, 1.0),
}


@pytest.mark.parametrize("what", SURFACES)
def test_what_the_surface_does_itself_stays(what):
    y, x = grid(96)
    height, albedo = SURFACES[what](y, x)
    u = curved(y, x) + height
    before, after, ripple = cleaned(phasors(u, albedo=albedo, seed=7))
    assert not ripple.any()
    np.testing.assert_array_equal(after.u, before.u)
    np.testing.assert_array_equal(after.sigma, before.sigma)


def test_relief_under_a_bounce_stays_too():
    y, x = grid(96)
    u = curved(y, x) + machined(y, x)
    _, after, ripple = cleaned(phasors(u, u + 70 + 1.6 * y, 0.05))
    assert (ripple > 0).mean() > 0.9
    kept = (after.u - curved(y, x))[12:-12, 12:-12]
    wave = machined(y, x)[12:-12, 12:-12]
    assert (kept * wave).mean() / (wave**2).mean() == pytest.approx(1, abs=0.03)


def test_noise_alone_is_no_bounce():
    y, x = grid(384)
    for seed in range(2):
        _, _, ripple = cleaned(phasors(curved(y, x), seed=seed))
        assert not ripple.any()


def test_a_finer_camera_sees_the_same():
    y, x = grid(210, 1 / 3)
    u = 300 + 0.95 * x + 0.1 * y
    before, after, ripple = cleaned(phasors(u, u + 50 + 1.7 * x, 0.03))
    assert (ripple > 0).mean() > 0.9
    assert rms(before.u - u) > 2 * rms(before.sigma)
    assert rms(after.u - u) < 1.05 * rms(before.sigma)


def test_only_what_is_asked_for_and_sound_is_changed():
    y, x = grid(96)
    u = curved(y, x)
    found = phasors(u, u + 60 + 2.0 * x, 0.05)
    z = found.z.copy()
    good, asked = np.ones(u.shape, bool), np.ones(u.shape, bool)
    good[:, :20], asked[:30] = False, False
    before, after, ripple = cleaned(found, good, asked)
    left = ~(good & asked)
    np.testing.assert_array_equal(found.z[:, left], z[:, left])
    np.testing.assert_array_equal(after.u[left], before.u[left])
    assert not ripple[left].any()
    assert (ripple[~left] > 0).mean() > 0.9


def test_too_few_frequencies_tell_no_distance():
    y, x = grid(48)
    found = phasors(curved(y, x), curved(y, x) + 60 + 2 * x, 0.1)
    found = AxisPhasors("x", FREQUENCY[:4], found.z[:4], 1 / 6)
    sigma = np.full((48, 48), SIGMA, np.float32)
    before = unwrap(found, sigma, EXTENT)
    whole = np.ones((48, 48), bool)
    after, ripple = remove_ripples(found, before, sigma, np.ones(4), whole, whole, EXTENT)
    assert after is before
    assert not ripple.any()


def test_among_matt_objects_five_times_fewer_coordinates_are_beyond_three_sigma(scan_simulated):
    # The scene of the paper's third experiment from another side; one round.
    scans = [
        scan_simulated(
            {"name": "objects", "pitch_deg": 20, "block_turn_deg": 36},
            method="mfs1",
            options={"remove_ripples": remove},
            seed=5,
            camera={"width_px": 512, "height_px": 384, "field_of_view_deg": 28.7, "exposure_us": 16_667},
            transport={"photons": 500_000, "supersample": 2},
        )
        for remove in (False, True)
    ]
    for part in ("table", "block"):
        beyond, errors = [], []
        for maps, truth in scans:
            asked = truth.places[part] & ~truth.edge & np.isfinite(truth.x_p) & np.isfinite(maps.x_p)
            off = [np.abs(getattr(maps, f"{a}_p") - getattr(truth, f"{a}_p"))[asked] for a in "xy"]
            sigma = [getattr(maps, f"sigma_{a}")[asked] for a in "xy"]
            beyond.append(np.mean([(o > 3 * s).mean() for o, s in zip(off, sigma, strict=True)]))
            errors.append(rms(np.minimum(off, 1.0)))
        assert beyond[1] < beyond[0] / 5
        assert errors[1] < 0.85 * errors[0]
        assert any((maps.flags & Flag.RIPPLE).any() for maps, _ in scans[1:])
