"""The coded sequence against a display that is known to fail, and in what way."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.display import CodedSequence, DisplayError, check_display
from calibration.display.check import REPEATS
from calibration.display.coded import number_of
from calibration.photometry import PhotometryError
from drivers import OperatorError
from sim_backend.bench import kind
from sim_backend.settings import SimulatedSettings

BITS = 5
REFERENCES = REPEATS * len(CodedSequence((640, 400), BITS).references())
"""Exposures, and pictures shown, before the coded ones."""


@pytest.fixture
def check(transport_cache):
    def run(faults=None, scene=None, projector=None, **settings):
        wanted = SimulatedSettings.model_validate(
            {
                "scene": scene or {"name": "plane", "yaw_deg": 12.0},
                "camera": {"width_px": 256, "height_px": 192},
                "projector": {"width_px": 640, "height_px": 400, **(projector or {})},
                "transport": {"photons": 200_000},
                "faults": faults or {},
                **settings,
            }
        )
        with kind.open(wanted) as bench:
            return check_display(bench, bits=BITS)

    return run


def at(*numbers):
    return [REFERENCES + n for n in numbers]


def codes(result):
    return [f.code for f in result.findings]


def test_pictures_are_all_different_and_neighbours_differ_in_one_bit():
    coded = CodedSequence((640, 400), BITS)
    pictures = np.array([coded.picture(n)[0] for n in range(coded.count)])
    assert len(np.unique(pictures, axis=0)) == 32
    # A bit has a fifth of the columns, three stripes of 42 or 43 px.
    changed = (pictures[1:] != pictures[:-1]).sum(axis=1)
    assert np.all((changed >= 126) & (changed <= 130))
    codes = np.array([[(n ^ n >> 1) >> b & 1 for b in range(7)] for n in range(128)], bool)
    assert np.array_equal(number_of(codes), np.arange(128))


@pytest.mark.parametrize(
    "scene", [{"name": "plane"}, {"name": "v_groove"}, {"name": "mirror"}], ids=lambda s: s["name"]
)
def test_a_good_display_passes_on_any_scene(check, scene):
    result = check(scene=scene, projector={"gamma": 2.2})
    assert result.good
    assert result.findings == ()
    assert np.array_equal(result.seen, np.arange(32))
    assert result.delay == 0
    result.require_good()


def test_a_picture_that_was_not_shown(check):
    result = check({"stale_at": at(7)})
    assert codes(result) == ["display_drops"]
    assert np.flatnonzero(result.seen != result.shown).tolist() == [7]
    assert result.seen[7] == 6
    assert "dropped 1 picture" in result.findings[0].what
    with pytest.raises(DisplayError, match="dropped") as refusal:
        result.require_good()
    assert "Close other programs" in refusal.value.remedy


def test_a_display_that_stands_still(check):
    result = check({"freeze_at": at(10), "freeze_pictures": 6})
    assert codes(result) == ["display_stands_still"]
    assert np.all(result.seen[10:16] == 9)
    assert "for 7 exposures" in result.findings[0].what


def test_a_display_that_lags_for_a_while(check):
    result = check({"lag_at": at(4), "lag_pictures": 5})
    assert codes(result) == ["display_late_at_times"]
    assert np.array_equal(result.shown - result.seen, [1 if 4 <= n < 9 else 0 for n in range(32)])


def test_a_display_that_is_always_one_picture_late(check):
    result = check({"lag_at": [0], "lag_pictures": 1000})
    assert codes(result) == ["display_late"]
    assert result.delay == 1
    assert np.array_equal(result.seen[1:], np.arange(31))
    assert "1 picture too late" in result.findings[0].what


def test_torn_pictures(check):
    result = check({"torn_at": at(9, 17)})
    assert codes(result) == ["display_torn"]
    assert np.flatnonzero(result.torn).tolist() == [9, 17]


@pytest.mark.parametrize("fault", ["mixed_at", "dark_flash_at"])
def test_light_that_changes_during_the_exposure(check, fault):
    result = check({fault: at(9, 20)})
    assert codes(result) == ["display_mixed"]
    assert np.flatnonzero(result.mixed).tolist() == [9, 20]


def test_latency_longer_than_the_bench_waits(check):
    # The default is 35 ms and one refresh. Without the refresh, most exposures begin before the picture is there.
    result = check(settle_s=0.040)
    assert "display_mixed" in codes(result)
    assert not result.good
    with pytest.raises(OperatorError, match="differ between"):
        check(settle_s=0.0)


def test_a_latency_that_is_just_long_enough_passes(check):
    assert check(projector={"latency_s": 0.110}, settle_s=0.110 + 1 / 60).good
    assert not check(projector={"latency_s": 0.110}, settle_s=0.100).good


def test_a_camera_that_sees_nothing_of_it_is_told_so(check):
    with pytest.raises(PhotometryError, match="brighter by"):
        check({"freeze_at": [0], "freeze_pictures": 1000})
