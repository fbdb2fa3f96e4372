"""The LightCrafter 6500 with patterns loaded over USB, its emulator below pyusb."""

from contextlib import contextmanager

from drivers.lightcrafter import LightCrafter6500Settings, make_lightcrafter
from sim_backend.clock import VirtualClock
from sim_backend.lightcrafter import EmulatedDlpc900, EmulatedUsb

PLAYS = True


class SmallMirrors(LightCrafter6500Settings):
    """A tenth of the width and height, as noise goes over the USB uncompressed."""

    @property
    def size(self):
        return 192, 108


@contextmanager
def projector(tmp_path):
    clock = VirtualClock()
    emulator = EmulatedDlpc900(clock, (192, 108))
    usb = EmulatedUsb(emulator)

    def read_surface():
        clock.sleep(0.02)
        return emulator.surface()

    yield make_lightcrafter(SmallMirrors(exposure_us=5000), clock, backend=usb), read_surface
    assert not usb.claimed
    assert emulator.kernel_driver
