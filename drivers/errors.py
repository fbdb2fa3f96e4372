"""The one tree of errors an operator can meet.

Every error says what is wrong and where (the message) and what to do about it (``remedy``). ``exit_code`` is what a
command line ends with: 2 bad configuration or usage, 3 hardware, 4 the scan ran but its result fails its own gates.
"""

from __future__ import annotations

from typing import Any


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

    def __reduce__(self) -> tuple[Any, ...]:
        # Errors travel between the processes of a bench; a subclass may be made of other arguments than these.
        return _revived, (type(self), self.message, self.remedy)


def _revived(kind: type[OperatorError], message: str, remedy: str) -> OperatorError:
    error = kind.__new__(kind)
    OperatorError.__init__(error, message, remedy)
    return error


class HardwareError(OperatorError):
    """A device did not do what it was asked to.

    ``repeatable`` says whether the same sequence may succeed when it is taken again.
    """

    exit_code = 3
    repeatable = False


class MissingLibraryError(HardwareError):
    """A library that a driver stands on is not installed or cannot be loaded."""


class DeviceNotFoundError(HardwareError):
    """No device, or more than one, is what the configuration asks for; the message lists what is there."""


class DeviceBusyError(HardwareError):
    """Another process holds the device."""


class ProtocolError(HardwareError):
    """A device answered something that its protocol does not allow."""

    repeatable = True


class SequenceFaultError(HardwareError):
    """The frames of a sequence cannot be trusted: counts disagree, a flip was late, a picture was missing."""

    repeatable = True


class FrameLossError(SequenceFaultError):
    """Frames were lost or are incomplete."""


class IllegalCallError(HardwareError):
    """A device was asked for something its state does not allow."""

    def __init__(self, device: str, state: str, call: str, allowed: str) -> None:
        super().__init__(
            f"{device}: {call}() is not allowed while the device is {state}",
            f"{call}() needs the device to be {allowed}; this is a fault of the calling program, please report it.",
        )


class DeviceLostError(HardwareError):
    """A device that was there does not answer any more; it is in FAULT until it is closed and opened again."""

    repeatable = True


class FrameTimeoutError(HardwareError):
    """A triggered frame did not arrive in time."""

    repeatable = True


class DeviceSettingError(HardwareError):
    """A device cannot be set as asked."""

    exit_code = 2
