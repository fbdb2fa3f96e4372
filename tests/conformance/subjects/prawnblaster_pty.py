"""The PrawnBlaster driver on a pseudo-terminal, with the emulator at its far end."""

from contextlib import contextmanager

from trigger_boxes import edges_into

from drivers import SystemClock
from drivers.trigger_box import PrawnBlasterBox, PrawnBlasterSettings
from sim_backend.trigger_box import PrawnBlasterEmulator


@contextmanager
def trigger(tmp_path):
    with PrawnBlasterEmulator() as box:
        driver = PrawnBlasterBox(PrawnBlasterSettings(port=box.port), SystemClock())
        try:
            yield driver, edges_into(box), lambda: len(box.pulses)
        finally:
            driver.close()
