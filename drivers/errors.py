"""The one tree of errors an operator can meet.

Every error says what is wrong and where (the message) and what to do about it (``remedy``). ``exit_code`` is what a
command line ends with: 2 bad configuration or usage, 3 hardware, 4 the scan ran but its result fails its own gates.
"""

from __future__ import annotations


class OperatorError(Exception):
    """Base of all errors that are shown to a person instead of a traceback.

    Parameters
    ----------
    message
        What is wrong and where.
    remedy
        What the operator can do about it, as one sentence.
    """

    exit_code = 2

    def __init__(self, message: str, remedy: str) -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}\n  → {self.remedy}"


class HardwareError(OperatorError):
    """A device did not do what it was asked to."""

    exit_code = 3


class IllegalCallError(HardwareError):
    """A device was asked for something its state does not allow."""

    def __init__(self, device: str, state: str, call: str, allowed: str) -> None:
        super().__init__(
            f"{device}: {call}() is not allowed while the device is {state}",
            f"{call}() needs the device to be {allowed}; this is a fault of the calling program, please report it.",
        )


class DeviceLostError(HardwareError):
    """A device that was there does not answer any more."""


class FrameTimeoutError(HardwareError):
    """A triggered frame did not arrive in time."""


class DeviceSettingError(HardwareError):
    """A device cannot be set as asked."""

    exit_code = 2
