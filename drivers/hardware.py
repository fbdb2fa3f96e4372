"""The bench kind ``hardware``: the real camera, projector and trigger that a bench file names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from drivers.bench import BenchKind
from drivers.clock import SystemClock
from drivers.device_bench import DeviceBench
from drivers.devices import Clock, Projector, Trigger
from drivers.errors import DeviceSettingError
from drivers.genicam.settings import GenICamSettings
from drivers.lightcrafter.settings import LightCrafter4500Settings, LightCrafter6500Settings, LightCrafter9000Settings
from drivers.refreshes import whole_refreshes
from drivers.stepped import SteppedBench
from drivers.streamed import StreamedBench
from drivers.trigger_box.settings import PrawnBlasterSettings, SltSettings
from drivers.window.settings import WindowSettings

if TYPE_CHECKING:
    from drivers.examination import Finding


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SoftwareTrigger(_Section):
    """The camera is triggered by a command of this program."""

    driver: Literal["software"] = "software"


class ProjectorTrigger(_Section):
    """The projector's trigger output is wired to the camera's trigger line."""

    driver: Literal["projector"] = "projector"


ProjectorSettings = Annotated[
    WindowSettings | LightCrafter4500Settings | LightCrafter6500Settings | LightCrafter9000Settings,
    Field(discriminator="driver"),
]
TriggerSettings = Annotated[
    SoftwareTrigger | ProjectorTrigger | SltSettings | PrawnBlasterSettings, Field(discriminator="driver")
]


class HardwareSettings(_Section):
    """A real bench: which camera, which projector, and how a pattern and its exposure come together."""

    name: str = Field("bench", min_length=1, max_length=60, description="What the bench is called in reports.")
    camera: GenICamSettings = Field(description="The camera.")
    projector: ProjectorSettings = Field(description="The projector.")
    trigger: TriggerSettings = Field(
        SoftwareTrigger(),
        description="What exposes the camera. software: a command; slt, prawnblaster: a trigger box; projector: the "
        "projector's own trigger output.",
    )
    synchronisation: Literal["step", "stream"] = Field(
        "step",
        description="step: show, wait, expose; always works. stream: one pattern per refresh, exposed by hardware.",
    )
    settle_s: float | None = Field(
        None,
        ge=0,
        le=60,
        description="From the hand-over of a pattern until it is surely on the surface, s. null: from the display "
        "latency that `scan latency` has measured and kept with the rig.",
    )
    reconnect_s: float = Field(
        20.0, ge=0, le=3600, description="How long a device that was lost in a scan is waited for, s."
    )
    whole_refreshes: bool = Field(
        True,
        description="Refuse an exposure that is not a whole number of projector refreshes. false only for projectors "
        "whose light does not vary within a refresh.",
    )

    @model_validator(mode="after")
    def _trigger_reaches_the_camera(self) -> Self:
        source, wanted = self.trigger.driver, self.camera.trigger
        if source == "software" and wanted == "line":
            raise _refused("camera.trigger is line, but trigger.driver is software", "set camera.trigger: software")
        if source != "software" and wanted != "line":
            raise _refused(f"trigger.driver is {source}, but camera.trigger is {wanted}", "set camera.trigger: line")
        if self.synchronisation == "stream" and source == "software":
            raise _refused(
                "synchronisation is stream, but nothing but software triggers the camera",
                "set synchronisation: step, or name a trigger box or the projector's trigger output",
            )
        if self.synchronisation == "step" and source == "projector":
            raise _refused(
                "the projector's trigger output exposes the camera, but synchronisation is step",
                "set synchronisation: stream",
            )
        window = self.projector if isinstance(self.projector, WindowSettings) else self.projector.window
        if (
            self.synchronisation == "stream"
            and window is not None
            and (source == "projector" or window.sync_patch is None)
        ):
            # A LightCrafter that shows video gives a pulse for every frame, also for those between two sequences.
            raise _refused(
                "no output of a screen tells which picture is the first",
                "set sync_patch of the window, put a light sensor on it, and wire that to a trigger box",
            )
        return self


def _refused(what: str, remedy: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{what}: {remedy}", {"what": what, "remedy": remedy})


class HardwareBenchKind:
    """Opens real benches; see `drivers.BenchKind`."""

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the section ``bench:``."""
        return HardwareSettings

    @contextmanager
    def open(self, settings: HardwareSettings) -> Iterator[DeviceBench]:
        """An open bench; nothing but black is projected."""
        with make_bench(settings, SystemClock()) as bench:
            exposure_us = settings.camera.exposure_us
            if settings.synchronisation == "step" and settings.whole_refreshes and exposure_us is not None:
                # A window that holds a picture for several refreshes still refreshes it.
                check_exposure_period(exposure_us, getattr(bench.projector, "refresh_s", bench.projector.period_s))
            yield bench

    def examine(self, settings: HardwareSettings) -> Iterator[Finding]:
        """What `scan doctor` finds of this bench's devices, without projecting anything."""
        from drivers.doctor import examine_hardware

        yield from examine_hardware(settings)


def make_bench(settings: HardwareSettings, clock: Clock) -> DeviceBench:
    """The closed bench that ``settings`` describe."""
    from drivers.genicam import GenICamCamera

    parts: dict[str, Any] = {
        "name": settings.name,
        "camera": GenICamCamera(settings.camera, clock),
        "projector": make_projector(settings.projector, clock),
        "trigger": make_trigger(settings.trigger, clock),
        "clock": clock,
        "settle_s": settings.settle_s,
        "exposure_s": (settings.camera.exposure_us or 0.0) * 1e-6,
        "reconnect_s": settings.reconnect_s,
        "whole_refreshes": settings.whole_refreshes,
    }
    return SteppedBench(**parts) if settings.synchronisation == "step" else StreamedBench(**parts)


def make_projector(settings: Any, clock: Clock) -> Projector:
    """The closed projector of its section."""
    if isinstance(settings, WindowSettings):
        from drivers.window import WindowProjector

        return WindowProjector(settings, clock)
    from drivers.lightcrafter import make_lightcrafter

    return make_lightcrafter(settings, clock)


def make_trigger(settings: Any, clock: Clock) -> Trigger | None:
    """The closed trigger box of its section; None where there is no box."""
    if isinstance(settings, SltSettings):
        from drivers.trigger_box import SltTriggerBox

        return SltTriggerBox(settings, clock)
    if isinstance(settings, PrawnBlasterSettings):
        from drivers.trigger_box import PrawnBlasterBox

        return PrawnBlasterBox(settings, clock)
    return None


def check_exposure_period(exposure_us: float, period_s: float) -> None:
    """Refuse an exposure that is not a whole number of projector refreshes.

    A projector makes grey levels by switching within a refresh; an exposure that cuts one adds an error to every step
    that beats with the two clocks.

    Parameters
    ----------
    exposure_us
        Exposure, µs.
    period_s
        Of the projector, s.

    Raises
    ------
    DeviceSettingError
        It is not; the remedy names the nearest that are.
    """
    refreshes = exposure_us * 1e-6 / period_s
    if whole_refreshes(exposure_us * 1e-6, period_s) is None:
        below, above = max(int(refreshes), 1), int(refreshes) + 1
        nearest = " or ".join(f"{n * period_s * 1e6:.0f}" for n in sorted({below, above}))
        raise DeviceSettingError(
            f"an exposure of {exposure_us:.0f} µs is {refreshes:.3f} refreshes of the projector "
            f"({period_s * 1e3:.3f} ms), not a whole number",
            f"Set bench.camera.exposure_us to {nearest}, or bench.whole_refreshes to false for a projector whose light "
            "is steady within a refresh.",
        )


kind: BenchKind = HardwareBenchKind()
"""What the entry point names."""
