"""Patterns loaded into the projector over USB: DLPC900 in pattern-on-the-fly mode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from drivers.devices import Clock
from drivers.errors import DeviceSettingError
from drivers.lightcrafter.chip import Leds
from drivers.lightcrafter.dlpc900 import MAX_IMAGES, MAX_PATTERNS, Dlpc900, Mode, PatternEntry
from drivers.lightcrafter.images import PLANES, Compression, encoded, laid_out
from drivers.lightcrafter.projector import Picture, SelfTimed
from drivers.lightcrafter.settings import LightCrafter6500Settings, LightCrafter9000Settings

_MEMORY_PLANES = {"lightcrafter6500": 400, "lightcrafter9000": 480}
"""Bit planes that the controller's memory holds (DLPS037H)."""


class OnTheFlyProjector(SelfTimed):
    """A LightCrafter 6500 or 9000 that gets its patterns over USB; a `drivers.devices.SequencePlayer`.

    Parameters
    ----------
    settings, clock, backend
        See `LightCrafter`.

    Notes
    -----
    Behind the pictures lies one that is black; it is shown whenever nothing else is, without pulses at TRIG_OUT_2. So
    a camera on that output is exposed once for each picture of a played sequence, and never else but by `show`.
    """

    def __init__(
        self, settings: LightCrafter6500Settings | LightCrafter9000Settings, clock: Clock, *, backend: Any = None
    ) -> None:
        super().__init__(settings, clock, backend=backend)
        self._halves = 2 if settings.driver == "lightcrafter9000" else 1  # each controller drives one
        self._compression = Compression[settings.compression.upper()]
        self._asked_for: tuple[bytes, ...] = ()
        self._on_chip: tuple[bytes, ...] | None = None

    @property
    def _dlpc900(self) -> Dlpc900:
        assert isinstance(self._chip, Dlpc900)
        return self._chip

    @property
    def capacity(self) -> int:
        """Different pictures that can be loaded at once, the black one apart."""
        bits = self._settings.bit_depth
        in_memory = (_MEMORY_PLANES[self._settings.driver] - 1) // bits
        in_images = MAX_IMAGES * (PLANES // bits) - (PLANES % bits == 0)  # the black one needs a plane as well
        return min(in_memory, in_images, MAX_PATTERNS - 1)

    def _enter(self) -> None:
        self._on_chip = None
        self._dlpc900.enter(Mode.ON_THE_FLY)

    def _check_load(self, patterns: Sequence[Picture]) -> None:
        self._asked_for = tuple(map(_digest, patterns))
        different = len(set(self._asked_for))
        if not 1 <= len(patterns) < MAX_PATTERNS or different > self.capacity:
            raise DeviceSettingError(
                f"{self.name}: {len(patterns)} patterns, {different} of them different, do not fit into its memory",
                f"It holds {self.capacity} different ones of {self._settings.bit_depth} bits and shows 1 to "
                f"{MAX_PATTERNS - 1} in a sequence; use fewer bits or patterns, or the mode video_pattern.",
            )

    def _load(self, patterns: Sequence[Picture]) -> None:
        chip = self._dlpc900
        chip.stop()
        self._light(False)
        if chip.mode() != Mode.ON_THE_FLY:  # somebody else was at it
            self._enter()
        if self._asked_for != self._on_chip:
            self._on_chip = None
            self._upload(patterns, self._asked_for)
            self._on_chip = self._asked_for
        self._loaded = len(patterns)
        self._show_black()

    def _upload(self, patterns: Sequence[Picture], contents: Sequence[bytes]) -> None:
        settings, bits = self._settings, self._settings.bit_depth
        different = dict(zip(contents, patterns, strict=True))
        images, spots = laid_out(list(different.values()), bits, MAX_IMAGES - 1)
        place = dict(zip(different, spots, strict=True))
        entries = [
            PatternEntry(settings.shown_us, bits, self._leds, *place[content], settings.dark_us) for content in contents
        ]
        image, position = _free_plane(max(spots), bits)
        if image == len(images):
            images.append(np.zeros_like(images[0]))
        entries.append(
            PatternEntry(settings.shown_us, 1, Leds.NONE, image, position, settings.dark_us, trigger_out_2=False)
        )
        # Table first, images after it, the last one first (DLPU018J §5.3 and 0x1A2A): a change of the table makes the
        # chip forget its images.
        self._dlpc900.define(entries)
        width = self.size[0] // self._halves
        for index in reversed(range(len(images))):
            for half in range(self._halves):
                part: NDArray[np.uint32] = np.ascontiguousarray(images[index][:, half * width : (half + 1) * width])
                self._dlpc900.load_image(index, encoded(part, self._compression), secondary=half == 1)

    def _arrange_one(self, index: int) -> None:
        self._dlpc900.stop()
        self._dlpc900.reorder([index], shown=0)

    def _arrange_all(self) -> None:
        self._dlpc900.stop()
        # The same number of lines as before, so that the images stay; all but the black one are shown.
        self._dlpc900.configure(self._loaded + 1, shown=self._loaded)

    def _show_black(self) -> None:
        super()._show_black()
        if self._on_chip is not None:
            self._arrange_one(self._loaded)
            self._chip.start(endless=True)


def _digest(picture: Picture) -> bytes:
    return xxhash.xxh3_128_digest(np.ascontiguousarray(picture).data)


def _free_plane(last: tuple[int, int], bits: int) -> tuple[int, int]:
    """Give the first plane behind the last picture's."""
    image, position = last
    return (image, position + bits) if position + bits < PLANES else (image + 1, 0)
