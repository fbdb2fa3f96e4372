"""Patterns of the projector's flash memory, put there with the vendor's program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xxhash

from drivers.errors import DeviceSettingError
from drivers.lightcrafter.chip import StoredPattern
from drivers.lightcrafter.dlpc350 import Dlpc350
from drivers.lightcrafter.dlpc900 import Dlpc900
from drivers.lightcrafter.images import quantised
from drivers.lightcrafter.projector import Picture, SelfTimed


class StoredProjector(SelfTimed):
    """A LightCrafter that shows patterns of its flash memory; a `drivers.devices.SequencePlayer`.

    Pictures are found by their contents among the image files that the settings name; one that is not there is
    refused. Parameters as `LightCrafter`.

    Notes
    -----
    Black is made by switching the LEDs off. The 6500 and 9000 may have a light source of the operator's own: a black
    picture in the memory is shown as well where there is one, without pulses at TRIG_OUT_2.
    """

    _there: dict[bytes, StoredPattern]
    _black: StoredPattern | None = None
    _chosen: tuple[StoredPattern, ...] = ()

    def _enter(self) -> None:
        self._there = {}
        self._black = None
        self._chosen = ()
        bits = self._settings.bit_depth
        for stored in self._settings.stored:
            picture = self._read(stored.file)
            pattern = StoredPattern(stored.image, stored.first_bit, bits)
            self._there[self._key(picture)] = pattern
            if not picture.any() and isinstance(self._chip, Dlpc900):
                self._black = replace(pattern, pulse_2=False)
        if isinstance(self._chip, Dlpc350):
            images = self._chip.flash_images()
            missing = sorted({pattern.image for pattern in self._there.values() if pattern.image >= images})
            if missing:
                raise DeviceSettingError(
                    f"{self.name}: its flash memory holds {images} images, from 0 to {images - 1}; not number "
                    f"{', '.join(map(str, missing))}",
                    "Name the images under stored as they were written to the projector.",
                )
        self._chip.enter_stored()

    def _check_load(self, patterns: Sequence[Picture]) -> None:
        absent = [number for number, pattern in enumerate(patterns) if self._key(pattern) not in self._there]
        if absent or not len(patterns):
            raise DeviceSettingError(
                f"{self.name}: {len(absent)} of {len(patterns)} pictures are not in its flash memory, picture "
                f"{', '.join(map(str, absent[:8]))} among them",
                "Write them to the projector with the vendor's program and name them under stored, or use another "
                "mode.",
            )

    def _load(self, patterns: Sequence[Picture]) -> None:
        if not self._chip.stored_entered():  # somebody else was at it
            self._chip.enter_stored()
        chosen = tuple(self._there[self._key(pattern)] for pattern in patterns)
        # Tried now, so that nothing is refused in the middle of a scan.
        self._set_up(chosen, len(chosen))
        self._chosen = chosen
        self._show_black()

    def _set_up(self, patterns: Sequence[StoredPattern], shown: int) -> None:
        settings = self._settings
        self._chip.show_stored(patterns, settings.shown_us, settings.dark_us, self._leds, shown)

    def _arrange_one(self, index: int) -> None:
        self._set_up([self._chosen[index]], 0)

    def _arrange_all(self) -> None:
        self._set_up(self._chosen, len(self._chosen))

    def _show_black(self) -> None:
        super()._show_black()
        if self._black is not None and self._chosen:
            self._set_up([self._black], 0)
            self._chip.start(endless=True)

    def _key(self, picture: Picture) -> bytes:
        shown = np.ascontiguousarray(quantised(picture, self._settings.bit_depth))
        return xxhash.xxh3_128_digest(shown.data)

    def _read(self, file: Path) -> Picture:
        import PIL.Image

        try:
            with PIL.Image.open(file) as image:
                if image.mode not in ("L", "1"):
                    raise ValueError(f"it is not 8-bit grey but {image.mode}")
                picture: Picture = np.asarray(image.convert("L"))
        except (OSError, ValueError) as error:
            raise DeviceSettingError(
                f"{self.name}: the stored picture {file} cannot be read: {error}",
                "Name an 8-bit grey image file, such as a PNG, of the picture that was written to the projector.",
            ) from error
        self._check_pictures([picture])
        return picture
