"""The far ends of a virtual bench's wires, in one process and around one scene.

    window → X server ─ scan-outs → display ─ latency → surface ─ exposures → pictures → GenTL producer → camera
                                                  │                                                          │
                                        light sensor ─ edges → trigger box ─ pulses → camera's line 0        │
                                                                   ↑ count-back ─────────── exposure active ─┘

Everything keeps the machine's monotonic time and says when it happened: a busy machine makes answers late, but moves no
exposure against its picture.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from drivers import FrameFormat
from drivers.process import Emit
from sim_backend.display import Display
from sim_backend.gentl.feed import Exposure, ExposureRequest, Fault, PictureServer
from sim_backend.light import DirectLight, Grey, Light
from sim_backend.surface import Picture, Surface
from sim_backend.timetable import Timetable
from sim_backend.trigger_box import SltBoxEmulator
from sim_backend.virtual_settings import VirtualSettings
from sim_backend.xserver import XServer

_SCAN_OUT_PHASE = 0.5
"""Of a refresh, after the window's flip: as much time as can be for the X server's copy to be complete."""


@dataclass(frozen=True)
class WireEnds:
    """Where the drivers find what they talk to.

    Parameters
    ----------
    display
        Name of the X server's display.
    pictures
        Path of the socket from which the simulated camera gets its pictures.
    port
        Path of the trigger box's serial port.
    """

    display: str
    pictures: str
    port: str


class World:
    """Runs in a `drivers.process.DeviceProcess`; its public methods are the commands, most of them faults.

    Parameters
    ----------
    emit
        Not needed: the world speaks through its wires.
    settings
        Of the bench.
    folder
        Where everything that must not be left behind is kept; deleted at the end.
    """

    def __init__(self, emit: Emit, settings: VirtualSettings, folder: str) -> None:
        tempfile.tempdir = folder
        sys.setswitchinterval(0.0005)  # the display's thread must not wait for others
        self._camera = settings.camera
        x, y, width, height = settings.sync_patch
        self._patch = slice(y, y + height), slice(x, x + width)
        self._bright = False
        self._answered, self._longest_answer_s = 0, 0.0
        self._light = _light(settings)
        with ExitStack() as stack:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            stack.callback(self._light.close)
            size = settings.projector.width_px, settings.projector.height_px
            self._screen = stack.enter_context(XServer(*size))
            self._surface = Surface(np.zeros(size[::-1], np.uint8))
            self._box = stack.enter_context(SltBoxEmulator(on_pulse=self._pulse))
            self._lines = Timetable()
            stack.callback(self._lines.close)
            self._pictures = stack.enter_context(PictureServer(Path(folder) / "pictures", self, exposed=self._exposed))
            self._display = Display(
                self._screen.channel("green"),
                self._surface,
                settings.projector.refresh_hz,
                _SCAN_OUT_PHASE,
                settings.projector.latency_s,
                self._shown,
            )
            stack.callback(self._display.close)
            self._lines.start()
            self._display.start()
            self._stack = stack.pop_all()

    def idle(self) -> float:
        """Nothing to do: threads do it all."""
        return 60.0

    def close(self) -> None:
        """End everything."""
        self._stack.close()

    def ends(self) -> WireEnds:
        """Where the drivers find what they talk to."""
        return WireEnds(self._screen.display, str(self._pictures.path), self._box.port)

    def counts(self) -> dict[str, float]:
        """What has happened so far."""
        return {
            "scan_outs": self._display.scan_outs,
            "changes": self._display.changes,
            "dropped": self._display.dropped,
            "skipped": self._display.skipped,
            "pictures": self._answered,
            "longest_answer_s": self._longest_answer_s,
            "pulses": len(self._box.pulses),
        }

    def shown(self) -> Picture:
        """(height, width) what is on the surface now."""
        now = time.monotonic()
        return self._surface.during(now, now + 1e-6)[0][1]

    # Faults of the display and the projector

    def freeze(self, seconds: float) -> None:
        """Keep the present picture on for ``seconds``."""
        self._display.freeze(seconds)

    def drop(self, changes: int) -> None:
        """Have the next ``changes`` new pictures come a refresh late."""
        self._display.drop(changes)

    def delay(self, latency_s: float) -> None:
        """Change the latency."""
        self._display.latency_s = latency_s

    def black_out(self, dark: bool) -> None:
        """Switch the projector's lamp off or on again."""
        self._display.black_out(dark)

    # Faults of the trigger box

    def upset_box_wire(self, fault: str, value: int | bool) -> None:
        """Set one of `sim_backend.trigger_box.WireFaults`."""
        setattr(self._box.faults, fault, value)

    def reboot_box(self, boot_s: float) -> None:
        """Reset the trigger box."""
        self._box.reboot(boot_s)

    def unplug_box(self) -> None:
        """Pull the trigger box's USB cable."""
        self._box.unplug()

    def plug_in_box(self) -> None:
        """Put it back."""
        self._box.plug_in()

    # Faults of the camera

    def upset_camera(self, fault: Fault, count: int = 1) -> bool:
        """Let a fault befall the ``count``-th frame from now; False where no camera acquires."""
        return self._pictures.inject(fault, count) > 0

    # What happens by itself, each in the thread that notices it

    def _shown(self, moment: float, picture: Picture) -> None:
        self._light.expect(picture)
        bright = bool(picture[self._patch].mean() > 127)
        if bright != self._bright:
            self._bright = bright
            self._lines.at(moment, partial(self._box.edge, "EXT0", bright, moment))

    def _pulse(self, moment: float) -> None:
        self._pictures.edge(0, True, moment)
        self._pictures.edge(0, False, moment)

    def _exposed(self, exposure: Exposure) -> None:
        begin, end = exposure.t_begin_s, exposure.t_end_s
        self._lines.at(begin, partial(self._box.exposure, True, begin))
        self._lines.at(end, partial(self._box.exposure, False, end))

    def picture(self, request: ExposureRequest) -> Grey:
        """What the camera sees; see `sim_backend.gentl.feed.PictureSource`."""
        asked = time.monotonic()
        end = request.t_begin_s + request.exposure_s
        self._display.catch_up(end)
        frame = self._light.frame(
            self._surface.during(request.t_begin_s, end),
            request.exposure_s,
            10 ** (request.gain_db / 20),
            request.black_level_dn,
            FrameFormat(self._camera.width_px, self._camera.height_px, request.bits),
        )
        x, y = request.offset_x_px, request.offset_y_px
        self._answered += 1
        self._longest_answer_s = max(self._longest_answer_s, time.monotonic() - asked)
        time.sleep(max(0.0, end + self._camera.readout_s - time.monotonic()))
        return frame[y : y + request.height_px, x : x + request.width_px]


def _light(settings: VirtualSettings) -> Light:
    if settings.light == "direct":
        return DirectLight()
    # Imported here, because tracing needs Open3D and Numba, which direct light does without.
    from sim_backend.cache import transport_of
    from sim_backend.optics import Optics
    from sim_backend.scene_light import SceneLight

    return SceneLight(Optics.of(settings, transport_of(settings)), settings.seed)
