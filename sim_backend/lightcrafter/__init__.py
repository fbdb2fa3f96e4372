"""LightCrafter projectors that are not there: emulators below pyusb, on the bench's clock."""

from sim_backend.lightcrafter.dlpc350 import EmulatedDlpc350
from sim_backend.lightcrafter.dlpc900 import EmulatedDlpc900
from sim_backend.lightcrafter.usb import EmulatedUsb
from sim_backend.lightcrafter.video import SimulatedScreen, VideoSource

__all__ = ["EmulatedDlpc350", "EmulatedDlpc900", "EmulatedUsb", "SimulatedScreen", "VideoSource"]
