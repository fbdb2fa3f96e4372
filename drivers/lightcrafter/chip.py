"""What the DLPC350 and the DLPC900 have in common: registers of status, light, flips, input and start.

Sources: DLPU010 (DLPC350) and DLPU018J (DLPC900).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, ClassVar

from drivers.devices import Clock
from drivers.errors import DeviceSettingError, ProtocolError
from drivers.lightcrafter.transport import UsbTransport

_POLL_S = 0.01
_STARTS = 3
_STARTED_WITHIN_S = 0.1


class Leds(IntFlag):
    """Light of a pattern."""

    NONE = 0
    RED = 1
    GREEN = 2
    BLUE = 4


class InputSource(IntEnum):
    """Where pictures in video mode come from."""

    PARALLEL = 0
    """The video connector."""
    TEST_PATTERN = 1
    FLASH = 2


@dataclass(frozen=True)
class ChipStatus:
    """What the status registers say.

    Parameters
    ----------
    parked
        The mirrors are parked: nothing is shown.
    running
        A pattern sequence runs.
    locked
        The video input is locked; None where this register does not tell (DLPC350).
    faults
        Errors of hardware and sequencer, in words.
    """

    parked: bool
    running: bool
    locked: bool | None
    faults: tuple[str, ...]


_HARDWARE_FAULTS = {
    2: "mirror resets overlap",
    3: "forced buffer swap",
    6: "the sequencer gave up",
    7: "error of the sequencer",
}


@dataclass(frozen=True)
class VideoPatterns:
    """Patterns that the chip takes from video frames.

    Parameters
    ----------
    per_frame
        1 (from green) or 3 (from green, red and blue, in this order).
    bit_depth
        The highest bits of each channel, 1..8.
    exposure_us, dark_us
        Of each pattern, µs.
    leds
        Light of all patterns.
    """

    per_frame: int
    bit_depth: int
    exposure_us: int
    dark_us: int
    leds: Leds


@dataclass(frozen=True)
class StoredPattern:
    """A pattern in the chip's flash memory.

    Parameters
    ----------
    image
        Number of the 24-bit image.
    position
        First of its bit planes there, 0..23, a multiple of ``bit_depth``.
    bit_depth
        1..8.
    pulse_2
        Give a pulse at TRIG_OUT_2 when it begins; False is for the DLPC900 only.
    """

    image: int
    position: int
    bit_depth: int
    pulse_2: bool = True


class Chip:
    """Registers that both chips have.

    Parameters
    ----------
    transport
        Connection, opened and closed by the owner.
    clock
        Time.
    """

    MIN_EXPOSURE_US: ClassVar[Mapping[int, int]]
    """Shortest exposure of a pattern by its bit depth, µs."""

    def __init__(self, transport: UsbTransport, clock: Clock) -> None:
        self.transport = transport
        self.clock = clock

    @property
    def device(self) -> str:
        """The name that errors mention."""
        return self.transport.device

    def read(self, command: int, data: bytes = b"") -> bytes:
        """Read a register; errors as `UsbTransport.read`."""
        return self.transport.read(command, data)

    def write(self, command: int, data: bytes = b"") -> None:
        """Write a register; errors as `UsbTransport.read`."""
        self.transport.write(command, data)

    def read_exactly(self, command: int, size: int) -> bytes:
        """Read a register of ``size`` bytes.

        Raises
        ------
        ProtocolError
            The answer is shorter.
        """
        data = self.read(command)
        if len(data) < size:
            raise ProtocolError(
                f"{self.device}: register 0x{command:04X} has {len(data)} bytes instead of {size}",
                "Use a shorter USB cable without a hub, or the projector's newest firmware.",
            )
        return data[:size]

    def status(self) -> ChipStatus:
        """Read the hardware status and the main status."""
        hardware = self.read_exactly(0x1A0A, 1)[0]
        main = self.read_exactly(0x1A0C, 1)[0]
        faults = [text for bit, text in _HARDWARE_FAULTS.items() if hardware >> bit & 1]
        if not hardware & 1:
            faults.insert(0, "initialisation failed")
        return ChipStatus(bool(main & 1), bool(main & 2), self._locked_bit(main), tuple(faults))

    def locked(self) -> bool:
        """Say whether the video input is locked to its source."""
        raise NotImplementedError

    def version(self) -> str:
        """Read the firmware's version."""
        application = int.from_bytes(self.read_exactly(0x0205, 4), "little")
        return f"{application >> 24}.{application >> 16 & 0xFF}.{application & 0xFFFF}"

    def standby(self, on: bool) -> None:
        """Park the mirrors and switch the light off, or wake up."""
        self.write(0x0200, bytes((on,)))

    def control_leds(self, leds: Leds | None) -> None:
        """Switch LEDs by hand; None has the running sequence switch them."""
        self.write(0x1A07, bytes((8 if leds is None else int(leds),)))

    def set_led_current(self, red: int, green: int, blue: int) -> None:
        """Set the LEDs' currents, 0 (least) to 255, whatever way round the board's drivers take them."""
        inverted = self.read_exactly(0x1A05, 1)[0] & 1
        self.write(0x0B01, bytes(255 - value if inverted else value for value in (red, green, blue)))

    def flip(self, *, long_axis: bool, short_axis: bool) -> None:
        """Mirror the picture."""
        self.write(0x1008, bytes((long_axis,)))
        self.write(0x1009, bytes((short_axis,)))

    def select_input(self, source: InputSource) -> None:
        """Choose the source of pictures in video mode, 24 bits wide."""
        self.write(0x1A00, bytes((source | 1 << 3,)))

    def mode(self) -> int:
        """Read the display mode."""
        return self.read_exactly(0x1A1B, 1)[0] & 3

    def stop(self) -> None:
        """Stop the pattern sequence; the next start begins with its first pattern."""
        self.write(0x1A24, b"\0")

    def start(self, *, endless: bool) -> None:
        """Start the pattern sequence.

        Parameters
        ----------
        endless
            True for one that repeats until it is stopped: then it is made sure that it runs. A short one may be over
            before that could be seen.

        Raises
        ------
        ProtocolError
            It does not run.
        """
        self.write(0x1A24, b"\2")
        if not endless:
            return
        for _ in range(_STARTS):
            if self.wait_until(self._running, _STARTED_WITHIN_S):
                return
            # After video mode the first start is ignored (pyCrafter4500).
            self.write(0x1A24, b"\2")
        raise ProtocolError(
            ": ".join((f"{self.device}: the pattern sequence does not start", *self.status().faults)),
            "Switch the projector off and on; check that its firmware fits the model.",
        )

    def wait_until(self, true: Callable[[], Any], timeout_s: float) -> bool:
        """Poll until ``true``; False where it was not within ``timeout_s``."""
        deadline = self.clock.now() + timeout_s
        while not true():
            if self.clock.now() >= deadline:
                return False
            self.clock.sleep(_POLL_S)
        return True

    def wait_for_lock(self, timeout_s: float = 3.0) -> None:
        """Wait until the video input is locked.

        Raises
        ------
        ProtocolError
            It is not within ``timeout_s``.
        """
        if not self.wait_until(self.locked, timeout_s):
            raise ProtocolError(
                f"{self.device}: the video input is not locked to a source",
                "Check the video cable, and that the computer drives this display at the projector's own size and at "
                "60 Hz.",
            )

    def check_exposure(self, exposure_us: int, bit_depth: int) -> None:
        """Refuse an exposure that the chip cannot make.

        Raises
        ------
        DeviceSettingError
            With the limit.
        """
        shortest = self.MIN_EXPOSURE_US[bit_depth]
        if not shortest <= exposure_us < 1 << 24:
            raise DeviceSettingError(
                f"{self.device}: a pattern of {bit_depth} bits cannot be exposed for {exposure_us} µs",
                f"Set exposure_us to {shortest} … {(1 << 24) - 1} µs for {bit_depth} bits, or fewer bits.",
            )

    def set_trigger_out(self, output: int, *, inverted: bool, rising_us: float, falling_us: float) -> None:
        """Set TRIG_OUT_1 or TRIG_OUT_2: polarity, and delays of the edges.

        Raises
        ------
        DeviceSettingError
            A delay is out of range.
        """
        raise NotImplementedError

    def connect_video(self) -> None:
        """Take pictures from the video connector."""
        self.select_input(InputSource.PARALLEL)

    def enter_video(self) -> None:
        """Go to plain video mode."""
        raise NotImplementedError

    def show_video(self, patterns: VideoPatterns, vsync_s: float) -> None:
        """Take patterns from the video frames from now on; not started yet.

        Parameters
        ----------
        patterns
            What to take from a frame.
        vsync_s
            Period of the frames, s.

        Raises
        ------
        DeviceSettingError
            The patterns do not fit into a frame, or the chip has no such patterns.
        """
        raise NotImplementedError

    def longest_in_frame_us(self, per_frame: int, vsync_s: float) -> int:
        """Longest exposure and dark time, together, of a pattern from a video frame, µs."""
        raise NotImplementedError

    def stored_entered(self) -> bool:
        """Say whether the chip is in the mode that `enter_stored` brings it into."""
        raise NotImplementedError

    def enter_stored(self) -> None:
        """Get ready to show patterns of the flash memory."""
        raise NotImplementedError

    def show_stored(
        self, patterns: Sequence[StoredPattern], exposure_us: int, dark_us: int, leds: Leds, shown: int
    ) -> None:
        """Set up patterns of the flash memory; not started yet.

        Parameters
        ----------
        patterns
            In order.
        exposure_us, dark_us, leds
            Of each.
        shown
            How many patterns a start shows: all of them once, or 0 for ever.

        Raises
        ------
        DeviceSettingError
            The chip cannot show them.
        """
        raise NotImplementedError

    def _running(self) -> bool:
        return bool(self.read_exactly(0x1A0C, 1)[0] & 2)

    def _locked_bit(self, main: int) -> bool | None:
        return None
