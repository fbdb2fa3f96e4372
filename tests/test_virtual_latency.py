"""The display latency measured through the real drivers, against what the virtual bench's display was set to."""

import pytest
from virtual import require_virtual_bench, small

from sim_backend.virtual_bench import open_bench, open_world

LATENCY_S, EXPOSURE_S, REFRESH_HZ = 0.03, 0.002, 60


EXPECTED_S = LATENCY_S + 0.5 / REFRESH_HZ
"""Flips are half a refresh before the scan-outs; latency counts from there."""
BETWEEN_S = {"software": 0.006, "box": 0.8 / REFRESH_HZ + 0.006}
"""A step is seen within one exposure and the time between two: some ms, or the box's shortest period."""


@pytest.mark.parametrize("trigger", BETWEEN_S)
def test_latency_is_that_of_the_display(trigger):
    require_virtual_bench()
    settings = small(camera={"exposure_us": EXPOSURE_S * 1e6}, projector={"latency_s": LATENCY_S}, trigger=trigger)
    latest_s = EXPECTED_S + BETWEEN_S[trigger]
    with open_world(settings) as (_, ends), open_bench(settings, ends) as bench:
        for _ in range(4):
            found = bench.measure_latency(lambda done, total: None)
            # A busy machine may flip a refresh late, which is latency too, now and then; and once in a while it does
            # something else for several.
            if found.p99_s < latest_s + 3 / REFRESH_HZ:
                break
    assert EXPECTED_S - EXPOSURE_S < found.median_s < latest_s
    assert found.median_s <= found.p99_s < latest_s + 3 / REFRESH_HZ
    assert found.samples == 50
    assert "projector" in found.projector
