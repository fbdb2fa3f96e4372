"""Trigger boxes that are not there: their firmware in Python, on a pseudo-terminal that the real drivers open."""

from sim_backend.trigger_box.emulators import BoxEmulator, PrawnBlasterEmulator, SltBoxEmulator
from sim_backend.trigger_box.slt import SltBox
from sim_backend.trigger_box.wire import WireFaults

__all__ = ["BoxEmulator", "PrawnBlasterEmulator", "SltBox", "SltBoxEmulator", "WireFaults"]
