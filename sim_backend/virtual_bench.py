"""The bench kind ``virtual``: the real drivers, at emulated ends of their wires."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel

from drivers import BenchKind, HardwareError, OperatorError
from drivers.process import DeviceProcess
from sim_backend.virtual_settings import VirtualSettings

if TYPE_CHECKING:
    from drivers.device_bench import DeviceBench
    from drivers.examination import Finding
    from drivers.hardware import HardwareSettings
    from sim_backend.world import WireEnds

CAMERA_SERIAL = "SIM0001"
_START_TAKES_AT_MOST_S = 3600.0
"""The light of a new scene is traced first."""
_FRAME_TAKES_AT_MOST_S = 5.0
"""From a trigger; the world computes what a real scene has ready."""
_one_in_a_process = threading.Lock()


class VirtualBenchKind:
    """Opens virtual benches; see `drivers.BenchKind`."""

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the section ``bench:``."""
        return VirtualSettings

    @contextmanager
    def open(self, settings: VirtualSettings) -> Iterator[DeviceBench]:
        """An open bench; the scene's light is traced first unless it is in the cache."""
        with open_world(settings) as (_, ends), open_bench(settings, ends) as bench:
            yield bench

    def examine(self, settings: VirtualSettings) -> Iterator[Finding]:
        """What `scan doctor` finds of this bench: it is opened, but for the scene's light, which may take long."""
        from drivers.examination import Finding, Verdict

        item = f"virtual {settings.scene.name}"
        try:
            with self.open(settings.model_copy(update={"light": "direct"})):
                pass
        except OperatorError as error:
            yield Finding("bench", item, Verdict.FAULT, error.message, error.remedy)
        else:
            yield Finding("bench", item, Verdict.OK, "X server, camera and trigger box start and take their settings")


@contextmanager
def open_world(settings: VirtualSettings) -> Iterator[tuple[DeviceProcess, WireEnds]]:
    """The process that runs a `sim_backend.world.World`, and where the drivers find it.

    For as long as it is open, the environment of this process and of those that it starts points the simulated producer
    to this world.

    Raises
    ------
    MissingLibraryError
        Xvfb or a C compiler is not installed.
    HardwareError
        Another virtual bench is open in this process.
    """
    from sim_backend.gentl import SimulatedCameraId, installed
    from sim_backend.world import World

    if not _one_in_a_process.acquire(blocking=False):
        raise HardwareError(
            "another virtual bench is open in this process",
            "Close it first, or run the second in a process of its own.",
        )
    with ExitStack() as stack:
        stack.callback(_one_in_a_process.release)
        folder = tempfile.mkdtemp(prefix="virtual-bench-")
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        world = DeviceProcess("virtual bench", World, settings, folder)
        stack.callback(world.stop)
        world.start(_START_TAKES_AT_MOST_S)
        ends: WireEnds = world.call("ends")
        camera = SimulatedCameraId(
            CAMERA_SERIAL,
            user_name="virtual bench",
            width_px=settings.camera.width_px,
            height_px=settings.camera.height_px,
        )
        stack.enter_context(installed(Path(folder), [camera], Path(ends.pictures)))
        yield world, ends


@contextmanager
def open_bench(settings: VirtualSettings, ends: WireEnds) -> Iterator[DeviceBench]:
    """The real drivers on the wires whose ``ends`` are given."""
    from drivers.hardware import HardwareBenchKind

    with HardwareBenchKind().open(hardware_settings(settings, ends)) as bench:
        bench.simulated = True
        bench.rig = settings.rig().to_json()
        bench.timeout_s = _FRAME_TAKES_AT_MOST_S
        yield bench


def hardware_settings(settings: VirtualSettings, ends: WireEnds) -> HardwareSettings:
    """What the bench file of such a bench would say, were it real."""
    from drivers.genicam.settings import GenICamSettings
    from drivers.hardware import HardwareSettings, SoftwareTrigger
    from drivers.trigger_box.settings import SltSettings
    from drivers.window.settings import SyncPatch, WindowSettings
    from sim_backend.gentl import producer_path

    camera, projector, streamed = settings.camera, settings.projector, settings.synchronisation == "stream"
    period_s = 1 / projector.refresh_hz
    boxed = settings.trigger == "box"
    x, y, width, height = settings.sync_patch
    return HardwareSettings(
        name=f"virtual {settings.scene.name}",
        camera=GenICamSettings(
            producer=(producer_path(),),
            serial=CAMERA_SERIAL,
            pixel_format=camera.pixel_format,
            exposure_us=camera.exposure_us,
            gain_db=camera.gain_db,
            trigger="line" if boxed else "software",
        ),
        projector=WindowSettings(
            width_px=projector.width_px,
            height_px=projector.height_px,
            display=ends.display,
            refresh_hz=projector.refresh_hz,
            pacing="timer",
            sync_patch=SyncPatch(x_px=x, y_px=y, width_px=width, height_px=height) if streamed else None,
        ),
        trigger=SltSettings(
            port=ends.port,
            edge="change" if streamed else "rising",
            delay_us=round(settings.trigger_delay_s * 1e6),
            min_period_us=round(0.8e6 * period_s),
        )
        if boxed
        else SoftwareTrigger(),
        synchronisation=settings.synchronisation,
        settle_s=projector.latency_s + 1.5 * period_s if settings.settle_s is None else settings.settle_s,
        reconnect_s=settings.reconnect_s,
        whole_refreshes=False,  # this light is steady within a refresh
    )


kind: BenchKind = VirtualBenchKind()
"""What the entry point names."""
