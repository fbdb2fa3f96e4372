"""Boxes that give the camera its trigger pulses, on a serial port: SLT/1 boxes, and Picos that run PrawnBlaster.

`SLT1.md` in this folder is the protocol; `firmware/` holds it for two boards.
"""

from drivers.trigger_box.discovery import SerialPort, serial_ports
from drivers.trigger_box.prawnblaster import PrawnBlasterBox
from drivers.trigger_box.settings import PrawnBlasterSettings, SltSettings
from drivers.trigger_box.slt import SltTriggerBox

__all__ = [
    "PrawnBlasterBox",
    "PrawnBlasterSettings",
    "SerialPort",
    "SltSettings",
    "SltTriggerBox",
    "serial_ports",
]
