"""The DLPC350 of the LightCrafter 4500, register by register. Source: DLPU010, and TI's own library of 2015."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import ClassVar

from drivers.errors import DeviceSettingError, ProtocolError
from drivers.lightcrafter.chip import Chip, InputSource, Leds, StoredPattern, VideoPatterns

COMMAND_GAP_S = 0.02
"""Commands that follow one another faster are lost now and then (pyCrafter4500, SLStudio)."""

MAX_PATTERNS = 128
GAP_US = 230
"""A pattern's period is its exposure, or longer by this much at least."""

PRELOADED_IMAGES = 2
"""Images that fit into the chip's buffer; more are loaded from flash while the sequence runs."""
IMAGE_LOAD_S = 0.2
"""An image may take this long to load (DLPU011E §4.1)."""

# Which groups of a 24-bit image's planes lie in the highest bits of green, red and blue; planes are ordered G, R, B.
# DLPU010 table 2-70 as pyCrafter4500 uses it; for 3, 5 and 6 bits the groups do not end where a channel ends.
_HIGHEST_BITS = {8: (0, 1, 2), 7: (0, 1, 2), 4: (1, 3, 5), 2: (3, 7, 11), 1: (7, 15, 23)}
_VALIDATION_ERRORS = {0: "exposure or period is out of range", 1: "a pattern number is out of range"}
_VALIDATION_WARNINGS = {
    2: "TRIG_OUT_1 pulses overlap",
    3: "there is no black between patterns",
    4: "less than 230 µs between the end of an exposure and the next",
}


class Mode(IntEnum):
    """Display mode."""

    VIDEO = 0
    PATTERN = 1


class Trigger(IntEnum):
    """What a pattern waits for."""

    INTERNAL = 0
    EXTERNAL_RISING = 1
    EXTERNAL_FALLING = 2
    NONE = 3
    """Goes on from the pattern before."""


class PatternSource(IntEnum):
    """Where patterns come from."""

    VIDEO = 0
    FLASH = 3


class PatternClock(IntEnum):
    """What advances the patterns."""

    VSYNC = 0
    INTERNAL_OR_TRIGGER_IN = 1


class _Mailbox(IntEnum):
    CLOSED = 0
    IMAGES = 1
    PATTERNS = 2


@dataclass(frozen=True)
class PatternWord:
    """One line of the pattern look-up table.

    Parameters
    ----------
    trigger
        What it waits for.
    number
        Group of bit planes of an image: planes ``number * bit_depth`` and up, G0..G7, R0..R7, B0..B7.
    bit_depth
        1..8.
    leds
        Its light.
    invert
        White for black.
    insert_black
        Black after the exposure.
    swap_buffer
        Go to the next image with this pattern.
    share_trigger
        Share the exposure pulse of the pattern before.
    """

    trigger: Trigger
    number: int
    bit_depth: int
    leds: Leds
    invert: bool = False
    insert_black: bool = False
    swap_buffer: bool = False
    share_trigger: bool = False

    def encoded(self) -> bytes:
        """Write it, 3 bytes."""
        word = self.trigger | self.number << 2 | self.bit_depth << 8 | self.leds << 12
        word |= self.invert << 16 | self.insert_black << 17 | self.swap_buffer << 18 | self.share_trigger << 19
        return int(word).to_bytes(3, "little")


@dataclass(frozen=True)
class VideoSignal:
    """What the chip sees at its video input.

    Parameters
    ----------
    locked
        It follows the signal.
    width, height
        Active pixels.
    """

    locked: bool
    width: int
    height: int


class Dlpc350(Chip):
    """Registers of the DLPC350; parameters as `Chip`."""

    # 7 and 8 bits are confirmed by TI's rates (222 and 120 Hz); 1 to 6 bits are from memory of DLPU010 and agree with
    # an open-source driver (250, 700, 1600, 1700, 2000, 2500 µs) within its rounding. Not verified in the manual.
    MIN_EXPOSURE_US: ClassVar[Mapping[int, int]] = {
        1: 235,
        2: 700,
        3: 1570,
        4: 1700,
        5: 2000,
        6: 2500,
        7: 4500,
        8: 8333,
    }

    def video_signal(self) -> VideoSignal:
        """Read what is known of the video signal."""
        data = self.read_exactly(0x071C, 28)
        return VideoSignal(data[0] & 3 == 2, int.from_bytes(data[1:3], "little"), int.from_bytes(data[3:5], "little"))

    def locked(self) -> bool:
        """Say whether the video input is locked to its source."""
        return self.video_signal().locked

    def flash_images(self) -> int:
        """Read how many images the flash memory holds."""
        return self.read_exactly(0x1A42, 1)[0]

    def enter(self, mode: Mode) -> None:
        """Change the display mode; no sequence runs afterwards.

        Raises
        ------
        ProtocolError
            The chip stays in another mode.
        """
        self.stop()
        # Left in pattern mode with a test pattern as its input, the chip drops off the USB (SLStudio).
        self.select_input(InputSource.PARALLEL)
        self.write(0x1A1B, bytes((mode,)))
        if not self.wait_until(lambda: self.mode() == mode, timeout_s=1.0):
            raise ProtocolError(
                f"{self.device}: the projector stays in {Mode(self.mode()).name.lower()} mode",
                "Check that no other program controls the projector, then switch it off and on.",
            )
        self.stop()

    def define(
        self,
        patterns: Sequence[PatternWord],
        exposure_us: int,
        period_us: int,
        *,
        source: PatternSource,
        clock: PatternClock,
        images: Sequence[int] = (0,),
        repeat: bool,
    ) -> list[str]:
        """Write the look-up tables and have the chip validate them; the sequence is stopped before.

        Parameters
        ----------
        patterns
            1..128.
        exposure_us, period_us
            Of every pattern, µs.
        source, clock
            Where patterns come from and what advances them.
        images
            Numbers of the images in flash, in the order in which patterns swap to them.
        repeat
            Begin again after the last pattern.

        Returns
        -------
        list of str
            Warnings of the chip.

        Raises
        ------
        DeviceSettingError
            The chip cannot show this; nothing was sent.
        ProtocolError
            The chip finds the tables invalid.
        """
        self._check(patterns, exposure_us, period_us)
        self.stop()
        self.write(0x1A22, bytes((source,)))
        per_sequence = len(patterns)  # patterns from one pulse of TRIG_OUT_2 to the next
        self.write(0x1A31, bytes((len(patterns) - 1, repeat, per_sequence - 1, len(images) - 1)))
        self.write(0x1A23, bytes((clock,)))
        self.write(0x1A29, exposure_us.to_bytes(4, "little") + period_us.to_bytes(4, "little"))
        self._fill(_Mailbox.PATTERNS, b"".join(pattern.encoded() for pattern in patterns))
        if source is PatternSource.FLASH:
            # Exactly two images are to be sent in the other order (TI's library does so without a word).
            self._fill(_Mailbox.IMAGES, bytes(images[::-1] if len(images) == 2 else images))
        return self._validate()

    def set_trigger_out(self, output: int, *, inverted: bool, rising_us: float, falling_us: float) -> None:
        """Set TRIG_OUT_1 or TRIG_OUT_2: polarity, and delays of the edges in steps of 0.107 µs.

        TRIG_OUT_2 has no delay of its falling edge.

        Raises
        ------
        DeviceSettingError
            A delay is out of range.
        """
        codes = [round(delay / 0.1072) + 0xBB for delay in (rising_us, falling_us)]
        if not all(0 <= code <= 0xD5 for code in codes):
            raise DeviceSettingError(
                f"{self.device}: TRIG_OUT_{output} cannot be delayed by {rising_us:g} and {falling_us:g} µs",
                "Set delays of -20.0 … 2.7 µs.",
            )
        self.write(0x1A1C + output, bytes((inverted, *(codes if output == 1 else codes[:1]))))

    def set_trigger_in(self, *, delay_us: float, falling: bool) -> None:
        """Set the delay of TRIG_IN_1 (µs, steps of 0.107 µs) and the edge of TRIG_IN_2.

        Raises
        ------
        DeviceSettingError
            The delay is out of range.
        """
        code = round(delay_us / 0.1072)
        if not 0 <= code < 1 << 19:
            raise DeviceSettingError(
                f"{self.device}: TRIG_IN_1 cannot be delayed by {delay_us:g} µs", "Set a delay of 0 … 56 000 µs."
            )
        self.write(0x1A35, code.to_bytes(4, "little"))
        self.write(0x1A36, bytes((falling,)))

    def enter_video(self) -> None:
        """Go to plain video mode."""
        self.enter(Mode.VIDEO)

    def show_video(self, patterns: VideoPatterns, vsync_s: float) -> None:
        """Take patterns from the video frames from now on; see `Chip.show_video`."""
        each = patterns.exposure_us + patterns.dark_us
        if patterns.per_frame * each > vsync_s * 1e6:
            raise DeviceSettingError(
                f"{self.device}: {patterns.per_frame} × {each} µs do not fit into a video frame of "
                f"{vsync_s * 1e6:.0f} µs",
                f"Set exposure_us + dark_us to {self.longest_in_frame_us(patterns.per_frame, vsync_s)} µs at most; "
                f"{patterns.bit_depth} bits need {self.MIN_EXPOSURE_US[patterns.bit_depth]} µs.",
            )
        if patterns.bit_depth not in _HIGHEST_BITS:
            raise DeviceSettingError(
                f"{self.device}: the highest {patterns.bit_depth} bits of a channel are no pattern of this chip",
                f"Set bit_depth to one of {', '.join(str(bits) for bits in _HIGHEST_BITS)}.",
            )
        words = [
            # The first pattern of a frame waits for VSYNC, the others go on.
            PatternWord(
                Trigger.NONE if position else Trigger.EXTERNAL_RISING, number, patterns.bit_depth, patterns.leds
            )
            for position, number in enumerate(_HIGHEST_BITS[patterns.bit_depth][: patterns.per_frame])
        ]
        self._check(words, patterns.exposure_us, each)
        self.enter(Mode.VIDEO)
        self.wait_for_lock()
        self.enter(Mode.PATTERN)
        self.define(
            words, patterns.exposure_us, each, source=PatternSource.VIDEO, clock=PatternClock.VSYNC, repeat=True
        )

    def longest_in_frame_us(self, per_frame: int, vsync_s: float) -> int:
        """Longest exposure and dark time, together, of a pattern from a video frame, µs."""
        return int(vsync_s * 1e6) // per_frame

    def stored_entered(self) -> bool:
        """Say whether the chip is in pattern mode."""
        return self.mode() == Mode.PATTERN

    def enter_stored(self) -> None:
        """Get ready to show patterns of the flash memory."""
        self.enter(Mode.PATTERN)
        # The first start after video mode is ignored; make it one that nobody sees.
        dark = PatternWord(Trigger.INTERNAL, 0, 1, Leds.NONE, swap_buffer=True)
        self._define_stored([dark], 2000, 2000, images=(0,), repeat=True)
        self.start(endless=True)
        self.stop()

    def show_stored(
        self, patterns: Sequence[StoredPattern], exposure_us: int, dark_us: int, leds: Leds, shown: int
    ) -> None:
        """Set up patterns of the flash memory; see `Chip.show_stored`."""
        words: list[PatternWord] = []
        images: list[int] = []
        for pattern in patterns:
            swap = not images or images[-1] != pattern.image
            if swap:
                images.append(pattern.image)
            number = pattern.position // pattern.bit_depth
            words.append(PatternWord(Trigger.INTERNAL, number, pattern.bit_depth, leds, swap_buffer=swap))
        self._check(words, exposure_us, exposure_us + dark_us)
        self._check_loading(words, len(images), (exposure_us + dark_us) * 1e-6)
        self._define_stored(words, exposure_us, exposure_us + dark_us, images=images, repeat=shown == 0)

    def _define_stored(
        self, words: Sequence[PatternWord], exposure_us: int, period_us: int, *, images: Sequence[int], repeat: bool
    ) -> None:
        self.define(
            words,
            exposure_us,
            period_us,
            source=PatternSource.FLASH,
            clock=PatternClock.INTERNAL_OR_TRIGGER_IN,
            images=images,
            repeat=repeat,
        )

    def _fill(self, mailbox: _Mailbox, data: bytes) -> None:
        self.write(0x1A33, bytes((mailbox,)))
        self.write(0x1A32, b"\0")
        self.write(0x1A34, data)
        self.write(0x1A33, bytes((_Mailbox.CLOSED,)))

    def _validate(self) -> list[str]:
        """Have the chip check its tables; without that it does not start (TI, e2e 466576)."""
        self.write(0x1A1A, b"\0")
        found = 0x80

        def done() -> bool:
            nonlocal found
            found = self.read_exactly(0x1A1A, 1)[0]
            return not found & 0x80

        if not self.wait_until(done, timeout_s=2.0):
            raise ProtocolError(
                f"{self.device}: the pattern table is still being validated after 2 s",
                "Switch the projector off and on.",
            )
        errors = [text for bit, text in _VALIDATION_ERRORS.items() if found >> bit & 1]
        if errors:
            raise ProtocolError(
                f"{self.device} finds the pattern table invalid: {' and '.join(errors)}",
                "Expose longer, or use fewer bits.",
            )
        return [text for bit, text in _VALIDATION_WARNINGS.items() if found >> bit & 1]

    def _check(self, patterns: Sequence[PatternWord], exposure_us: int, period_us: int) -> None:
        if not 1 <= len(patterns) <= MAX_PATTERNS:
            raise DeviceSettingError(
                f"{self.device}: {len(patterns)} patterns do not fit into its table of {MAX_PATTERNS}",
                "Split the sequence.",
            )
        for bits in {pattern.bit_depth for pattern in patterns}:
            self.check_exposure(exposure_us, bits)
        if period_us != exposure_us and period_us - exposure_us < GAP_US:
            raise DeviceSettingError(
                f"{self.device}: {period_us - exposure_us} µs of dark time after a pattern cannot be made",
                f"Set dark_us to 0, or to {GAP_US} µs or more.",
            )

    def _check_loading(self, words: Sequence[PatternWord], images: int, period_s: float) -> None:
        if images <= PRELOADED_IMAGES:
            return
        swaps = [index for index, word in enumerate(words) if word.swap_buffer]
        fewest = min(end - begin for begin, end in pairwise(swaps))
        if fewest * period_s < IMAGE_LOAD_S:
            raise DeviceSettingError(
                f"{self.device}: {images} images of the flash memory are needed, but only {PRELOADED_IMAGES} can be "
                f"loaded before the sequence, and {fewest} patterns of {period_s * 1e3:g} ms leave no time for more",
                f"Show patterns of at most {PRELOADED_IMAGES} images in a sequence, or set exposure_us + dark_us to "
                f"{IMAGE_LOAD_S / fewest * 1e6:.0f} µs or more.",
            )
