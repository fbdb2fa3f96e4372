"""The DLPC900 of the LightCrafter 6500 and 9000, register by register. Source: DLPU018J."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import ClassVar

from drivers.errors import DeviceSettingError, ProtocolError
from drivers.lightcrafter.chip import Chip, InputSource, Leds, StoredPattern, VideoPatterns
from drivers.lightcrafter.transport import RefusedCommandError

MAX_PATTERNS = 400
MAX_IMAGES = 18
"""24-bit images that can be loaded; the numbers in `Dlpc900.load_image` are 0..17."""

PACKET_BYTES = 504
BLACK_BEFORE_TRIGGER_US = 105
"""A pattern that precedes one that waits for a trigger ends with so much black (DLPU018J, LUT Configuration)."""

ERRORS = {
    1: "checksum of a batch file",
    2: "the device failed",
    3: "there is no such command",
    4: "not with this controller and mirror device",
    5: "not allowed in the present mode",
    6: "a parameter is out of range",
    7: "an item is missing",
    8: "out of resources",
    9: "this compression of images is not supported",
    10: "bit depth or bit position out of range",
    11: "an image is missing",
    12: "dark time out of range",
    13: "delay of a signal out of range",
    14: "exposure out of range",
    15: "pattern number out of range",
    16: "wrong pattern definition",
    17: "memory address out of range",
    255: "internal error",
}

MODELS = {1: "LightCrafter 6500", 2: "LightCrafter 9000", 3: "DLP670S", 4: "DLP500YX", 5: "DLP5500"}


class Mode(IntEnum):
    """Display mode."""

    VIDEO = 0
    STORED = 1
    VIDEO_PATTERN = 2
    ON_THE_FLY = 3


@dataclass(frozen=True)
class PatternEntry:
    """One line of the pattern look-up table.

    Parameters
    ----------
    exposure_us, dark_us
        How long it is shown, and black after it, µs.
    bit_depth
        1..8.
    leds
        Its light.
    image, position
        24-bit image it lies in and the first of its bit planes there.
    wait_for_trigger
        Do not begin before a pulse at TRIG_IN_1, or VSYNC in video pattern mode.
    clear
        Clear the mirrors after the exposure (matters for 1-bit patterns with external trigger).
    trigger_out_2
        Give a pulse at TRIG_OUT_2 when it begins.
    """

    exposure_us: int
    bit_depth: int
    leds: Leds
    image: int = 0
    position: int = 0
    dark_us: int = 0
    wait_for_trigger: bool = False
    clear: bool = True
    trigger_out_2: bool = True

    def encoded(self, index: int) -> bytes:
        """Write it as line ``index``, 12 bytes."""
        return b"".join(
            (
                index.to_bytes(2, "little"),
                self.exposure_us.to_bytes(3, "little"),
                bytes((self.clear | self.bit_depth - 1 << 1 | self.leds << 4 | self.wait_for_trigger << 7,)),
                self.dark_us.to_bytes(3, "little"),
                # 1 switches the pulse off (DLPU018J); open-source drivers have it the other way round.
                bytes((not self.trigger_out_2,)),
                (self.image | self.position << 11).to_bytes(2, "little"),
            )
        )


class Dlpc900(Chip):
    """Registers of the DLPC900; parameters as `Chip`."""

    # 1 and 8 bits are confirmed (DLPU018J; TI, e2e 953168); 2 to 7 bits are from memory of the manual, not verified.
    MIN_EXPOSURE_US: ClassVar[Mapping[int, int]] = {1: 105, 2: 304, 3: 394, 4: 823, 5: 1215, 6: 1487, 7: 1998, 8: 4046}

    def read(self, command: int, data: bytes = b"") -> bytes:
        """Read a register; a refusal says why."""
        try:
            return self.transport.read(command, data)
        except RefusedCommandError as error:
            raise self._explained(error) from None

    def write(self, command: int, data: bytes = b"") -> None:
        """Write a register; a refusal says why."""
        try:
            self.transport.write(command, data)
        except RefusedCommandError as error:
            raise self._explained(error) from None

    def model(self) -> tuple[int, str]:
        """Read (hardware id, tag of the firmware)."""
        data = self.read_exactly(0x0206, 32)
        return data[0], data[1:].split(b"\0")[0].decode("ascii", "replace")

    def locked(self) -> bool:
        """Say whether the video input is locked to its source."""
        return bool(self.read_exactly(0x1A0C, 1)[0] & 8)

    def connect_video(self) -> None:
        """Switch the board's HDMI receiver on and take its pictures as the input."""
        # The code of the receiver's power is from memory of DLPU018, not verified: 0 off, 1 HDMI, 2 DisplayPort.
        self.write(0x1A01, b"\1")
        self.select_input(InputSource.PARALLEL)

    def enter(self, mode: Mode) -> None:
        """Change the display mode; no sequence runs afterwards.

        Raises
        ------
        ProtocolError
            The chip stays in another mode, or no video is there for `Mode.VIDEO_PATTERN`.
        """
        # A sequence that runs forbids the change, and the new mode may begin with one of its own (mcSIM).
        self.stop()
        if mode is Mode.VIDEO_PATTERN:
            # Reached from video mode only, and only with a locked source.
            self.write(0x1A1B, bytes((Mode.VIDEO,)))
            self.wait_for_lock()
        self.write(0x1A1B, bytes((mode,)))
        # Video pattern mode takes about 300 ms.
        if not self.wait_until(lambda: self.mode() == mode, timeout_s=1.0):
            raise ProtocolError(
                f"{self.device}: the projector stays in {Mode(self.mode()).name.lower()} mode",
                "Check that no other program controls the projector, then switch it off and on.",
            )
        self.stop()

    def define(self, entries: Sequence[PatternEntry], shown: int = 0) -> None:
        """Write the pattern look-up table; the sequence is stopped before.

        Parameters
        ----------
        entries
            1..400 patterns.
        shown
            How many patterns a start shows; 0 for ever.

        Raises
        ------
        DeviceSettingError
            The chip cannot show this; nothing was sent.
        """
        if not 1 <= len(entries) <= MAX_PATTERNS:
            raise DeviceSettingError(
                f"{self.device}: {len(entries)} patterns do not fit into its table of {MAX_PATTERNS}",
                "Split the sequence.",
            )
        for entry in entries:
            self._check(entry)
        self.stop()
        for index, entry in enumerate(entries):
            self.write(0x1A34, entry.encoded(index))
        self.configure(len(entries), shown)

    def configure(self, entries: int, shown: int) -> None:
        """Have the table take effect in its own order; due after any change of it. The sequence must not run."""
        self.write(0x1A31, entries.to_bytes(2, "little") + shown.to_bytes(4, "little"))

    def reorder(self, order: Sequence[int], shown: int) -> None:
        """Show lines of the table in another order. The sequence must not run."""
        numbers = b"".join(index.to_bytes(2, "little") for index in order)
        self.write(0x1A32, len(order).to_bytes(2, "little") + shown.to_bytes(4, "little") + numbers)

    def load_image(self, index: int, data: bytes, *, secondary: bool = False) -> None:
        """Load one 24-bit image, header included; a sequence's images go in reverse order, the last one first.

        Parameters
        ----------
        index
            0..17.
        data
            As `drivers.lightcrafter.images.encoded` writes it.
        secondary
            True for the right half of a board with two controllers.
        """
        announce, send = (0x1A2C, 0x1A2D) if secondary else (0x1A2A, 0x1A2B)
        self.write(announce, index.to_bytes(2, "little") + len(data).to_bytes(4, "little"))
        for at in range(0, len(data), PACKET_BYTES):
            part = data[at : at + PACKET_BYTES]
            self.write(send, len(part).to_bytes(2, "little") + part)

    def set_trigger_out(self, output: int, *, inverted: bool, rising_us: float, falling_us: float) -> None:
        """Set TRIG_OUT_1 or TRIG_OUT_2: polarity, and delays of the edges, rounded to µs.

        Raises
        ------
        DeviceSettingError
            A delay is out of range.
        """
        delays = round(rising_us), round(falling_us)
        if not all(-20 <= delay <= 20_000 for delay in delays):
            raise DeviceSettingError(
                f"{self.device}: TRIG_OUT_{output} cannot be delayed by {rising_us:g} and {falling_us:g} µs",
                "Set delays of -20 … 20 000 µs.",
            )
        code = b"".join(delay.to_bytes(2, "little", signed=True) for delay in delays)
        self.write(0x1A1C + output, bytes((inverted,)) + code)

    def set_trigger_in(self, *, delay_us: int, falling: bool) -> None:
        """Set TRIG_IN_1: delay (µs, 104 at least) and edge.

        Raises
        ------
        DeviceSettingError
            The delay is out of range.
        """
        if not 104 <= delay_us <= 0xFFFF:
            raise DeviceSettingError(
                f"{self.device}: TRIG_IN_1 cannot be delayed by {delay_us} µs", "Set a delay of 104 … 65 535 µs."
            )
        self.write(0x1A35, delay_us.to_bytes(2, "little") + bytes((falling,)))

    def enter_video(self) -> None:
        """Go to plain video mode."""
        self.enter(Mode.VIDEO)

    def show_video(self, patterns: VideoPatterns, vsync_s: float) -> None:
        """Take patterns from the video frames from now on; see `Chip.show_video`."""
        each = patterns.exposure_us + patterns.dark_us
        if patterns.per_frame * each + BLACK_BEFORE_TRIGGER_US > vsync_s * 1e6:
            raise DeviceSettingError(
                f"{self.device}: {patterns.per_frame} × {each} µs and {BLACK_BEFORE_TRIGGER_US} µs of black before the "
                f"next frame do not fit into a video frame of {vsync_s * 1e6:.0f} µs",
                f"Set exposure_us + dark_us to {self.longest_in_frame_us(patterns.per_frame, vsync_s)} µs at most; "
                f"{patterns.bit_depth} bits need {self.MIN_EXPOSURE_US[patterns.bit_depth]} µs.",
            )
        first = PatternEntry(
            patterns.exposure_us,
            patterns.bit_depth,
            patterns.leds,
            # Green, red and blue lie on planes 0, 8 and 16 (from memory of TI's own program; not verified).
            position=8 - patterns.bit_depth,
            dark_us=patterns.dark_us,
            wait_for_trigger=True,
        )
        self._check(first)
        self.enter(Mode.VIDEO_PATTERN)
        self.define(
            [
                replace(first, position=first.position + 8 * channel, wait_for_trigger=channel == 0)
                for channel in range(patterns.per_frame)
            ]
        )

    def longest_in_frame_us(self, per_frame: int, vsync_s: float) -> int:
        """Longest exposure and dark time, together, of a pattern from a video frame, µs."""
        return int(vsync_s * 1e6 - BLACK_BEFORE_TRIGGER_US) // per_frame

    def stored_entered(self) -> bool:
        """Say whether the chip is in pre-stored mode."""
        return self.mode() == Mode.STORED

    def enter_stored(self) -> None:
        """Get ready to show patterns of the flash memory."""
        self.enter(Mode.STORED)

    def show_stored(
        self, patterns: Sequence[StoredPattern], exposure_us: int, dark_us: int, leds: Leds, shown: int
    ) -> None:
        """Set up patterns of the flash memory; see `Chip.show_stored`."""
        self.define(
            [
                PatternEntry(
                    exposure_us,
                    pattern.bit_depth,
                    leds,
                    pattern.image,
                    pattern.position,
                    dark_us,
                    trigger_out_2=pattern.pulse_2,
                )
                for pattern in patterns
            ],
            shown,
        )

    def _check(self, entry: PatternEntry) -> None:
        self.check_exposure(entry.exposure_us, entry.bit_depth)
        if not 0 <= entry.dark_us < 1 << 24:
            raise DeviceSettingError(
                f"{self.device}: {entry.dark_us} µs is no dark time", f"Set dark_us to 0 … {(1 << 24) - 1} µs."
            )

    def _explained(self, error: RefusedCommandError) -> RefusedCommandError:
        code = self.transport.read(0x0100)[:1]
        try:
            text = self.transport.read(0x0101).split(b"\0")[0].decode("ascii", "replace").strip()
        except RefusedCommandError:  # older firmware has no descriptions
            text = ""
        if not code:
            return error
        return RefusedCommandError(self.device, error.command, code[0], text or ERRORS.get(code[0], "unknown error"))

    def _locked_bit(self, main: int) -> bool | None:
        return bool(main & 8)
