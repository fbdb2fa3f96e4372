"""The LightCrafter 4500 in video pattern mode: its emulator below pyusb, and a simulated screen at the video cable."""

from contextlib import contextmanager

from drivers.lightcrafter import LightCrafter4500Settings, make_lightcrafter
from drivers.window.settings import WindowSettings
from sim_backend.clock import VirtualClock
from sim_backend.lightcrafter import EmulatedDlpc350, EmulatedUsb, SimulatedScreen, VideoSource

PLAYS = True


class SmallMirrors(LightCrafter4500Settings):
    @property
    def size(self):
        return 228, 285


@contextmanager
def projector(tmp_path):
    clock = VirtualClock()
    source = VideoSource((228, 285), 60.0, clock)
    emulator = EmulatedDlpc350(clock, (228, 285), video=source)
    usb = EmulatedUsb(emulator)
    settings = SmallMirrors(window=WindowSettings(width_px=228, height_px=285))

    def read_surface():
        clock.sleep(0.1)
        return emulator.surface()

    yield make_lightcrafter(settings, clock, backend=usb, screen=SimulatedScreen(source, clock)), read_surface
    assert not usb.claimed
    assert emulator.kernel_driver
