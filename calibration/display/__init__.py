"""Does the display show every picture, in order and in time? A coded sequence tells."""

from calibration.display.check import DisplayCheck, DisplayError, check_display
from calibration.display.coded import CodedSequence

__all__ = ["CodedSequence", "DisplayCheck", "DisplayError", "check_display"]
