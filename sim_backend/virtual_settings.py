"""What an operator can set of a virtual bench: the ``bench:`` section of a configuration with ``kind: virtual``."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from sim_backend.settings import CameraSettings, ProjectorSettings, SceneSettings


class VirtualCameraSettings(CameraSettings):
    """The simulated camera, behind a GenTL producer of its own."""

    width_px: int = Field(1024, ge=16, le=16384, multiple_of=8, description="Width of the picture, px.")
    height_px: int = Field(768, ge=16, le=16384, multiple_of=2, description="Height of the picture, px.")
    packed: bool = Field(
        False, description="Send 10 and 12 bits close together (Mono10p, Mono12p) instead of in 16 bits each."
    )
    gain_db: float = Field(0.0, ge=0, le=24, description="Amplification, dB; 6 dB double the grey values.")

    @property
    def pixel_format(self) -> str:
        """Its name in the GenICam Pixel Format Naming Convention."""
        return f"Mono{self.bits}{'p' if self.packed and self.bits > 8 else ''}"


class VirtualProjectorSettings(ProjectorSettings):
    """The screen of an X server without hardware, and the projector behind it."""

    latency_s: float = Field(
        0.035, ge=0, le=5, description="From the scan-out of a picture at a refresh until it is on the surface, s."
    )


class VirtualSettings(SceneSettings):
    """Real drivers at emulated ends of their wires: X server, GenTL producer and serial box, all seeing one scene."""

    camera: VirtualCameraSettings = Field(VirtualCameraSettings(), description="The camera.")
    projector: VirtualProjectorSettings = Field(VirtualProjectorSettings(), description="The projector.")
    synchronisation: Literal["step", "stream"] = Field(
        "step",
        description="step: show, wait, expose. stream: one pattern per refresh; a light sensor on a corner of the "
        "picture gives the edges, the trigger box a pulse for each, and a pulse exposes the camera.",
    )
    trigger: Literal["software", "box"] = Field(
        "software", description="What exposes the camera: a command, or the trigger box at a serial port."
    )
    settle_s: float | None = Field(
        None,
        ge=0,
        le=60,
        description="From the hand-over of a picture to the trigger, s; left out, the latency and 1.5 refreshes.",
    )
    reconnect_s: float = Field(
        20.0, ge=0, le=3600, description="How long a device that was lost in a scan is waited for, s."
    )
    light: Literal["scene", "direct"] = Field(
        "scene",
        description="scene: the light of the scene. direct: every camera pixel sees one projector pixel, without any "
        "noise; costs nothing, and serves to measure how fast the drivers are.",
    )

    @model_validator(mode="after")
    def _stream_fits(self) -> Self:
        if self.synchronisation == "step":
            return self
        if self.trigger == "software":
            raise _refused("synchronisation is stream, but trigger is software", "set trigger: box")
        if self.camera.exposure_us > self.exposure_window_s * 1e6 + 0.5:
            raise _refused(
                f"an exposure of {self.camera.exposure_us:g} µs does not fit into one refresh of "
                f"{1e6 / self.projector.refresh_hz:.0f} µs",
                f"set camera.exposure_us to at most {self.exposure_window_s * 1e6:.0f}",
            )
        return self

    @property
    def sync_patch(self) -> tuple[int, int, int, int]:
        """Where the light sensor looks: left, top, width and height, px; the lower left corner."""
        side = max(4, self.projector.height_px // 25)
        return 0, self.projector.height_px - side, side, side

    @property
    def exposure_window_s(self) -> float:
        """Time within a refresh that an exposure may take when patterns are streamed, s."""
        return 1 / self.projector.refresh_hz - 2 * self.trigger_delay_s

    @property
    def trigger_delay_s(self) -> float:
        """From the light sensor's edge to the exposure when patterns are streamed: a twentieth of a refresh, s."""
        return 0.05 / self.projector.refresh_hz if self.synchronisation == "stream" else 0.0


def _refused(what: str, remedy: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{what}: {remedy}", {"what": what, "remedy": remedy})
