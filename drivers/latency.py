"""How much later than handed over a picture is on the surface, measured with the bench's own camera.

What the software believes about a display says little: compositor, driver queue and the projector's own electronics
add one to ten refreshes. So the projector steps between black and white at random moments while the camera keeps taking
frames; the frame that saw part of the step says when it came.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from drivers.devices import Camera, Clock, FrameFormat, FrameStamp, Pixels, Projector, Trigger
from drivers.errors import DeviceSettingError, HardwareError

STEPS = 50
_PATIENCE_S = 2.0

KeepStep = Callable[[int, Sequence[tuple[Pixels, FrameStamp]]], None]
"""Is given the level a step went to (0 or 255) and every frame taken of it, which it must not hold on to."""


@dataclass(frozen=True)
class DisplayLatency:
    """From the hand-over of a picture until it is on the surface.

    Parameters
    ----------
    median_s, p99_s
        Of the measured steps; with fewer than a hundred of them, p99 is the longest.
    samples
        Number of steps.
    measured
        When, ISO 8601.
    camera, projector
        The devices it was measured with.
    """

    median_s: float
    p99_s: float
    samples: int
    measured: str = ""
    camera: str = ""
    projector: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.median_s <= self.p99_s < 60:
            raise ValueError(f"a display latency of {self.median_s:g} s (median), {self.p99_s:g} s (p99) is none")

    def settle_s(self, period_s: float) -> float:
        """How long to wait from hand-over to trigger: p99 and one refresh more, s."""
        return self.p99_s + period_s

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; the inverse of `from_json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Latency of a document that `to_json` wrote.

        Raises
        ------
        DeviceSettingError
            The document is none of those.
        """
        try:
            return cls(**document)
        except (TypeError, ValueError) as error:
            raise DeviceSettingError(
                f"the display latency {dict(document)} cannot be used: {error}", "Measure it again: scan latency."
            ) from None


def measure_latency(
    camera: Camera,
    projector: Projector,
    clock: Clock,
    random: np.random.Generator,
    *,
    trigger: Trigger | None = None,
    frame_format: FrameFormat,
    exposure_s: float,
    steps: int = STEPS,
    progress: Callable[[int, int], None] = lambda done, total: None,
    keep: KeepStep = lambda level, frames: None,
) -> DisplayLatency:
    """Measure the latency of a display with running devices (camera started, projector configured).

    Parameters
    ----------
    camera, projector, trigger
        The devices, ready to expose; without ``trigger`` the camera is triggered by software.
    clock
        Their time.
    random
        Draws the moments of the steps, so that they fall anywhere within a refresh.
    frame_format
        Of the camera's frames.
    exposure_s
        Of the camera, s. It limits how finely a step is seen.
    steps
        How many, black to white and back in turn.
    progress
        Called with (steps done, steps in all).
    keep
        Called after each step, so that writing its frames down does not delay them.

    Returns
    -------
    The latency. A step that fell between two frames counts with the beginning of the later one, so that an uncertain
    latency is long rather than short. Delays between trigger and exposure are part of it.

    Raises
    ------
    HardwareError
        The camera sees no difference between black and white, or no step within two seconds.
    """
    width, height = projector.size
    projector.load([np.zeros((height, width), np.uint8), np.full((height, width), 255, np.uint8)])
    if trigger is not None:
        trigger.arm()
    buffers: list[Pixels] = []
    taken: list[tuple[Pixels, FrameStamp]] = []

    earliest = clock.now()

    def photograph() -> float:
        """Time of the trigger, s; the frame is the last of ``taken``."""
        nonlocal earliest
        if len(taken) == len(buffers):
            buffers.append(np.empty(frame_format.shape, frame_format.dtype))
        frame = buffers[len(taken)]
        clock.sleep(earliest - clock.now())
        asked = clock.now()
        if trigger is None:
            camera.trigger()
        else:
            trigger.fire()
            earliest = clock.now() + trigger.min_period_s
        taken.append((frame, camera.fetch(frame, exposure_s + _PATIENCE_S)))
        return asked

    def end_step(level: int) -> None:
        keep(level, taken)
        taken.clear()

    levels = []
    for picture in (0, 1):
        projector.show(picture)
        clock.sleep(_PATIENCE_S / 2)
        photograph()
        levels.append(taken[-1][0].astype(np.float32))
        end_step(255 * picture)
    seen = _brightened(levels[0], levels[1])
    dark, bright = (float(level[seen].mean()) for level in levels)

    latencies: list[float] = []
    white = True
    for done in range(steps):
        white = not white
        clock.sleep(float(random.uniform(0.5, 1.5)) * projector.period_s)
        shown = projector.show(int(white))
        while True:
            asked = photograph()
            share = (float(taken[-1][0][seen].mean()) - dark) / (bright - dark)
            arrived = share if white else 1 - share
            if arrived > 0.05:
                # With all of the exposure in the new light the step came no later than its beginning.
                latencies.append(max(asked + (1 - min(arrived, 1.0)) * exposure_s - shown, 0.0))
                break
            if asked - shown > _PATIENCE_S:
                raise HardwareError(
                    f"{projector.name}: a step from {'black to white' if white else 'white to black'} was not on the "
                    f"surface {_PATIENCE_S:g} s after it was handed over",
                    "Check that the projector shows this computer's picture, and that nothing else is on its screen.",
                )
        clock.sleep(projector.period_s)
        end_step(255 * int(white))
        progress(done + 1, steps)
    return DisplayLatency(
        median_s=float(np.median(latencies)),
        p99_s=float(np.quantile(latencies, 0.99, method="higher")),
        samples=steps,
        measured=datetime.now(UTC).isoformat(timespec="seconds"),
        camera=camera.name,
        projector=projector.name,
    )


def _brightened(dark: NDArray[np.float32], bright: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels that the projector makes clearly brighter."""
    rise = bright - dark
    threshold = 0.3 * float(np.quantile(rise, 0.99))
    if threshold < 4:
        raise HardwareError(
            f"the camera sees no difference between black and white (99 % of its pixels rise by less than "
            f"{float(np.quantile(rise, 0.99)):.1f} grey levels)",
            "Point projector and camera at the same surface, take the lens caps off, lengthen the exposure.",
        )
    return np.asarray(rise > threshold)
