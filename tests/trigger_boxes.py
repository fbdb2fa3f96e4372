"""Emulated trigger boxes as subjects of the conformance suite."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from drivers import SystemClock
from drivers.trigger_box import SltSettings, SltTriggerBox
from sim_backend.trigger_box import BoxEmulator, SltBoxEmulator

PERIOD_S = 2e-3
"""Between two edges."""


def edges_into(box: BoxEmulator) -> Callable[[int], None]:
    """Gives short high pulses to the box's input, as a projector's trigger output does."""

    def give(count: int) -> None:
        for _ in range(count):
            box.strobe("EXT0")
            time.sleep(PERIOD_S)

    return give


@contextmanager
def slt_subject(**emulator: Any) -> Iterator[tuple[SltTriggerBox, Callable[[int], None], Callable[[], int]]]:
    """A driver on an emulated box, with a camera that reports its exposures back."""
    with SltBoxEmulator(**emulator) as box:

        def expose(t_s: float) -> None:
            box.exposure(True)
            box.exposure(False)

        box.on_pulse = expose
        driver = SltTriggerBox(SltSettings(port=box.port), SystemClock())
        try:
            yield driver, edges_into(box), lambda: len(box.pulses)
        finally:
            driver.close()
