"""Patterns over HDMI: a window makes the pictures, the chip times, lights and triggers them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.devices import Clock, DeviceState, PlayRecord, SequencePlayer
from drivers.errors import DeviceSettingError, OperatorError, SequenceFaultError
from drivers.lightcrafter.chip import VideoPatterns
from drivers.lightcrafter.projector import LightCrafter, Picture
from drivers.lightcrafter.settings import LightCrafterSettings

# Pictures 1, 2 and 3 of a frame lie in its green, red and blue channel; a frame is (height, width, RGB).
_CHANNELS = (1, 0, 2)


class VideoPatternProjector(LightCrafter):
    """A LightCrafter at a screen's connector; a `drivers.devices.SequencePlayer`.

    Parameters
    ----------
    settings, clock, backend
        See `LightCrafter`; in mode ``video`` the chip is an ordinary display, in mode ``video_pattern`` it shows one or
        three patterns of each frame.
    screen
        Shows the pictures at the connector, one per refresh; opened and closed along with the projector. Where three
        go into a frame, it takes pictures of (height, width, 3), RGB.

    Notes
    -----
    In video pattern mode the trigger outputs pulse with every frame, whether a sequence is played or not: which pulse
    belongs to which picture, a sensor on the screen's synchronisation patch or the images have to tell.
    """

    def __init__(
        self, settings: LightCrafterSettings, clock: Clock, *, screen: SequencePlayer, backend: Any = None
    ) -> None:
        super().__init__(settings, clock, backend=backend)
        self._screen = screen
        self._by_pattern = settings.mode == "video_pattern"
        self._per_frame = settings.patterns_per_frame if self._by_pattern else 1
        self._exposure_us: int | None = None
        self._pictures: list[Picture] = []
        self._on_screen: bool | None = None  # packed frames, single pictures, or neither

    @property
    def period_s(self) -> float:
        """Time one picture of a played sequence is on, s."""
        return self._screen.period_s / self._per_frame

    def open(self) -> None:
        """Connect to the chip, which makes the screen appear, and open the screen; errors as of both."""
        super().open()
        try:
            with self._watched():
                self._chip.connect_video()
                self._chip.enter_video()
            self._screen.open()
        except BaseException:
            with suppress(OperatorError):
                self.close()
            raise

    def configure(self) -> None:
        """Apply the settings; errors as `LightCrafter.configure`, and where no video is locked."""
        self._life.check("configure")
        if self._screen.size != self.size:
            raise DeviceSettingError(
                f"{self.name}: the screen shows {self._screen.size[0]} × {self._screen.size[1]} px",
                f"Have the computer drive it at the projector's own {self.size[0]} × {self.size[1]} px.",
            )
        with self._watched():
            self._screen.configure()
        super().configure()

    def load(self, patterns: Sequence[Picture]) -> None:
        """Take over the pictures (height, width) of one sequence.

        Raises
        ------
        DeviceSettingError
            They are not of the projector's size.
        ProtocolError, SequenceFaultError
            No video is locked, or the chip does not run.
        """
        self._life.check("arm")
        self._check_pictures(patterns)
        if self.state is DeviceState.ARMED:
            self._life.move("stop")
        self._pictures = list(patterns) if self._per_frame == 1 else [pattern.copy() for pattern in patterns]
        self._on_screen = None
        with self._watched():
            if self._fault():
                # After another program or a lost signal the chip has to be brought here again.
                self._enter()
                self._verify()
            self._put_on_screen(packed=True)
        self._life.move("arm")

    def show(self, index: int) -> float:
        """Show picture ``index`` in every frame; returns when it was handed over, s."""
        self._life.require("show", DeviceState.ARMED)
        self._check_index(index, len(self._pictures))
        with self._watched():
            self._verify()
            self._put_on_screen(packed=False)
            self._illuminate()
            shown = self._screen.show(index)
        self._counts["shown"] += 1
        return shown

    def play(self) -> None:
        """Begin to show all pictures once."""
        self._life.check("start")
        with self._watched():
            self._verify()
            self._put_on_screen(packed=True)
            self._illuminate()
            self._screen.play()
        self._life.move("start")

    def finish(self, timeout_s: float) -> PlayRecord:
        """Wait until the last picture was shown.

        Raises
        ------
        SequenceFaultError
            The screen says so, or the video lock was lost.
        """
        self._life.require("finish", DeviceState.RUNNING)
        try:
            with self._watched():
                record = self._screen.finish(timeout_s)
                self._verify()
        except SequenceFaultError:
            self.darken()
            raise
        self._rest()
        self._counts["played"] += 1
        if self._per_frame == 1:
            return record
        each = ((self._exposure_us or 0) + self._settings.dark_us) * 1e-6
        pictures = range(len(self._pictures))
        return PlayRecord(
            tuple(record.shown_s[n // self._per_frame] + n % self._per_frame * each for n in pictures),
            tuple(n for n in pictures if n // self._per_frame in record.late),
        )

    def close(self) -> None:
        """Go dark, disconnect and close the screen; allowed in every state."""
        try:
            super().close()
        finally:
            self._screen.close()

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot."""
        return {**super().describe(), "exposure_us": self._exposure_us, "screen": self._screen.describe()}

    def _enter(self) -> None:
        settings, chip = self._settings, self._chip
        chip.connect_video()
        if not self._by_pattern:
            chip.enter_video()
            chip.wait_for_lock()
            return
        longest = chip.longest_in_frame_us(self._per_frame, self._screen.period_s) - settings.dark_us
        self._exposure_us = longest if settings.exposure_us is None else settings.exposure_us
        patterns = VideoPatterns(self._per_frame, settings.bit_depth, self._exposure_us, settings.dark_us, self._leds)
        chip.show_video(patterns, self._screen.period_s)
        chip.start(endless=True)

    def _show_black(self) -> None:
        # The chip goes on: stopped, it would have to find the video again.
        try:
            if self._screen.state is not DeviceState.CLOSED:
                self._screen.darken()
        finally:
            self._light(False)

    def _illuminate(self) -> None:
        if not self._lit:
            self._light(True)

    def _put_on_screen(self, *, packed: bool) -> None:
        """Hand the pictures to the screen, one by one or as frames of three, unless it has them."""
        if self._per_frame == 1:
            packed = False
        if self._on_screen is packed:
            return
        self._on_screen = None
        self._screen.load(self._frames() if packed else self._pictures)
        self._on_screen = packed

    def _frames(self) -> list[NDArray[np.uint8]]:
        width, height = self.size
        frames: list[NDArray[np.uint8]] = []
        for number, picture in enumerate(self._pictures):
            if number % self._per_frame == 0:
                frames.append(np.zeros((height, width, 3), np.uint8))
            frames[-1][..., _CHANNELS[number % self._per_frame]] = picture
        return frames

    def _fault(self) -> str:
        """What keeps the chip from showing what the screen shows; empty where nothing does."""
        if not self._chip.locked():
            return "the video input has lost its signal"
        if self._by_pattern:
            status = self._chip.status()
            if status.faults:
                return ", ".join(status.faults)
            if not status.running:
                return "it does not show video patterns any more"
        return ""

    def _verify(self) -> None:
        if fault := self._fault():
            raise SequenceFaultError(
                f"{self.name}: {fault}",
                "Check the video cable and that the computer keeps this display on; the sequence can be repeated.",
            )
