"""The exposure search against cameras whose best exposure is known in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from calibration.exposure import search_exposure
from calibration.steps.geometry import fringes
from scanner.config import ScanSection

PERIOD_S = 1 / 60
PERIOD_US = 1e6 / 60


class Camera:
    """Grey value = black + gain·exposure·reflectance + noise; the projector lights all but the upper third."""

    def __init__(self, gain, black=3.0, noise=1.5, bits=8, brightest=1.0):
        self.gain, self.black, self.noise, self.full = gain, black, noise, 2**bits - 1
        self.random = np.random.default_rng(5)
        self.reflectance = self.random.uniform(0.3 * brightest, brightest, (90, 120))
        self.reflectance[:30] = 0
        self.exposures = []

    def __call__(self, exposure_us):
        self.exposures.append(exposure_us)
        grey = self.black + self.gain * exposure_us * self.reflectance
        grey = np.rint(grey + self.random.normal(0, self.noise, grey.shape))
        return np.clip(grey, 0, self.full).astype(np.uint8 if self.full < 256 else np.uint16)

    def best_us(self, target=0.9):
        quantile = np.quantile(self.reflectance[30:], 0.995)
        return (target * self.full - self.black) / (self.gain * quantile)


def search(camera, **options):
    limits = {"saturated_dn": camera.full, "minimum_us": 50.0, "maximum_us": 1e6} | options
    return search_exposure(camera, **limits)


@pytest.mark.parametrize("gain", [2e-4 * k for k in (1.3, 5, 37, 410)])
@pytest.mark.parametrize("bits", [8, 12])
def test_exposure_without_period_comes_near_the_best(gain, bits):
    camera = Camera(gain * (2**bits - 1) / 255, bits=bits, noise=1.5 * (2**bits - 1) / 255, black=3 * 2 ** (bits - 8))
    choice = search(camera)
    assert choice.good
    assert choice.findings == ()
    assert 0.93 < choice.exposure_us / camera.best_us() <= 1.01
    assert 0.84 < choice.brightest <= 0.9
    assert choice.saturated_share <= 0.001
    assert len(choice.shots) <= 6
    # What is chosen was photographed.
    assert choice.exposure_us in camera.exposures


@pytest.mark.parametrize("gain", [1e-3 * k for k in (0.31, 0.9, 2.2, 6.1, 9.3)])
@pytest.mark.parametrize("start", [None, 30_000.0, 900_000.0])
def test_with_a_period_it_is_the_longest_whole_multiple(gain, start):
    camera = Camera(gain)
    choice = search(camera, period_s=PERIOD_S, start_us=start)
    assert choice.good
    assert choice.exposure_us == pytest.approx(choice.periods * PERIOD_US)
    best = camera.best_us() / PERIOD_US
    assert choice.periods in (int(best), max(int(best - 0.02 * best), 1))
    assert len(choice.shots) <= 6
    assert f"= {choice.periods} period" in choice.reason


def test_a_few_glints_do_not_count_but_many_do():
    camera = Camera(5e-3)
    camera.reflectance[40, 40:44] = 50  # 4 of 7200 lit pixels
    assert search(camera).brightest > 0.84
    camera.reflectance[50:53] = 50  # 5 %: they saturate until 20 times less light
    choice = search(camera)
    assert choice.saturated_share <= 0.001
    assert choice.exposure_us < 0.05 * Camera(5e-3).best_us()


def test_too_dark_says_by_how_many_stops():
    camera = Camera(6e-5)
    choice = search(camera)
    (finding,) = choice.findings
    assert (finding.code, finding.refuses) == ("too_dark", False)
    assert choice.exposure_us == 1e6
    stops = np.log2(0.9 / choice.brightest)
    assert f"by {stops:.1f} stops" in finding.remedy
    assert f"{6.02 * stops:.0f} dB" in finding.remedy
    (hopeless,) = search(Camera(5e-6)).findings
    assert hopeless.refuses


@pytest.mark.parametrize("factor", [1.5, 3.0, 7.0])
def test_too_bright_at_one_period_says_by_how_many_stops(factor):
    camera = Camera(1.0)
    camera.gain = factor * camera.gain * camera.best_us() / PERIOD_US
    choice = search(camera, period_s=PERIOD_S)
    (finding,) = choice.findings
    assert (finding.code, finding.refuses) == ("too_bright", True)
    assert not choice.good
    assert choice.periods == 1
    said = float(finding.remedy.split("aperture by ")[1].split(" stops")[0])
    assert said == pytest.approx(np.log2(factor), abs=0.15)


def test_a_camera_that_is_not_linear_still_ends_with_what_keeps_the_rule():
    camera = Camera(2e-3)
    straight = camera.__call__

    def bent(exposure_us):
        return (255 * (straight(exposure_us) / 255.0) ** 0.6).astype(np.uint8)

    choice = search_exposure(bent, saturated_dn=255, minimum_us=50, maximum_us=1e6, period_s=PERIOD_S)
    assert choice.good
    assert 0.75 < choice.brightest <= 0.9


def test_limits_that_allow_nothing_are_refused():
    with pytest.raises(ValueError, match="no multiple"):
        search(Camera(1e-3), minimum_us=20_000, maximum_us=30_000, period_s=PERIOD_S)
    with pytest.raises(ValueError, match="maximum"):
        search(Camera(1e-3), minimum_us=20, maximum_us=10)


def test_boards_are_photographed_at_one_exposure_whatever_scans_take():
    scan = ScanSection(exposures=(1.0, 0.25), max_regional_sequences=4)
    work = SimpleNamespace(
        loaded=SimpleNamespace(config=SimpleNamespace(scan=scan)),
        settings=SimpleNamespace(geometry=SimpleNamespace(steps=8)),
    )
    board = fringes(work, (640, 400))
    assert (board.method, board.exposures, board.max_regional_sequences) == ("tps", (1.0,), 1)
