"""What an operator can set of a simulated bench: the ``bench:`` section of a configuration with ``kind: simulated``.

Importing this file is cheap; all that computes is imported where it is needed.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim_backend.scenes import MirrorScene, Scene

if TYPE_CHECKING:
    from scanner.rig import Lens, Rig

_Count = Annotated[int, Field(ge=0)]
_ROUNDING = 1e-9
_LEAST_SPARE = 0.98
"""Of the radius at which a lens folds back, for what its tangential distortion adds."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Picture(_Section):
    """A lens and the picture behind or before it."""

    width_px: int = Field(1024, ge=16, le=16384, description="Width of the picture, px.")
    height_px: int = Field(768, ge=16, le=16384, description="Height of the picture, px.")
    field_of_view_deg: float = Field(28.7, gt=1, lt=120, description="Horizontal field of view without distortion, °.")
    principal_offset_px: tuple[float, float] = Field(
        (0.0, 0.0), description="Principal point to the right of and below the picture's middle, [x, y] px."
    )
    distortion_k1: float = Field(
        0.0, ge=-0.3, le=0.3, description="First radial distortion term k1 of OpenCV's lens model; 0 is a perfect lens."
    )
    distortion_k2: float = Field(0.0, ge=-1, le=1, description="Second radial distortion term k2.")
    distortion_k3: float = Field(0.0, ge=-2, le=2, description="Third radial distortion term k3.")
    distortion_p1: float = Field(0.0, ge=-0.02, le=0.02, description="First tangential distortion term p1.")
    distortion_p2: float = Field(0.0, ge=-0.02, le=0.02, description="Second tangential distortion term p2.")

    @model_validator(mode="after")
    def _reaches_the_corners(self) -> Self:
        """Refuse a lens that draws no ray at some of its pixels, because its distortion folds back."""
        k1, k2, k3 = self.distortion_k1, self.distortion_k2, self.distortion_k3
        turns = np.polynomial.Polynomial([1.0, 3 * k1, 5 * k2, 7 * k3]).trim().roots()
        turning = turns.real[(np.abs(turns.imag) < _ROUNDING) & (turns.real > 0)]
        if turning.size:
            squared = float(turning.min())
            reach = math.sqrt(squared) * (1 + squared * (k1 + squared * (k2 + squared * k3)))
            x, y = (abs(shift) + n / 2 for shift, n in zip(self.principal_offset_px, self._size, strict=True))
            if math.hypot(x, y) / self._focal_px >= _LEAST_SPARE * reach:
                raise ValueError("the distortion folds back within the picture: some pixels would see nothing")
        return self

    @property
    def _size(self) -> tuple[int, int]:
        return self.width_px, self.height_px

    @property
    def _focal_px(self) -> float:
        return self.width_px / 2 / math.tan(math.radians(self.field_of_view_deg / 2))

    def lens(self) -> Lens:
        """The same as a camera model."""
        from scanner.rig import Lens

        cx, cy = ((n - 1) / 2 + shift for n, shift in zip(self._size, self.principal_offset_px, strict=True))
        matrix = np.array([[self._focal_px, 0, cx], [0, self._focal_px, cy], [0, 0, 1]])
        names = ("k1", "k2", "p1", "p2", "k3")
        return Lens(matrix, np.array([getattr(self, f"distortion_{name}") for name in names]), self._size)


class CameraSettings(_Picture):
    """The simulated camera."""

    exposure_us: float = Field(16_667.0, gt=0, le=10_000_000, description="Exposure time, µs; grey values follow it.")
    white_dn: float = Field(
        182.0,
        gt=0,
        description="Sensitivity: grey value (8-bit scale) of a matt surface of reflectance 0.8 that faces the white"
        " projector at the convergence distance, exposed for 16 667 µs.",
    )
    ambient_dn: float = Field(
        2.0, ge=0, description="What room light adds to every pixel in 16 667 µs, grey value of the 8-bit scale."
    )
    blur_px: float = Field(0.5, ge=0, le=20, description="Standard deviation of the camera's Gaussian blur, camera px.")
    bits: Literal[8, 10, 12] = Field(8, description="Bits of a grey value.")
    read_noise_dn: float = Field(
        1.5,
        ge=0,
        description="Standard deviation of a grey value in the dark, quantisation included, DN of the 8-bit scale.",
    )
    electrons_per_dn: float | None = Field(
        None, gt=0, description="Electrons per grey level of the 8-bit scale, for shot noise; leave out for none."
    )
    readout_s: float = Field(0.005, ge=0, le=10, description="From the end of an exposure until its frame is there, s.")


class ProjectorSettings(_Picture):
    """The simulated projector."""

    width_px: int = Field(1280, ge=16, le=16384, description="Width of the picture, px.")
    height_px: int = Field(800, ge=16, le=16384, description="Height of the picture, px.")
    field_of_view_deg: float = Field(35.5, gt=1, lt=120, description="Horizontal field of view without distortion, °.")
    gamma: float = Field(
        1.0, ge=0.2, le=5, description="Light follows (grey/255)^gamma; 1 is a projector with linear response."
    )
    blur_px: float = Field(
        0.5, ge=0, le=20, description="Standard deviation of the projector's defocus beyond a pixel's own spot, px."
    )
    refresh_hz: float = Field(60.0, gt=0, le=10_000, description="Pictures per second.")
    latency_s: float = Field(
        0.035, ge=0, le=10, description="From the hand-over of a picture until it can appear at the next refresh, s."
    )


class TransportSettings(_Section):
    """How finely light is traced."""

    supersample: int = Field(3, ge=1, le=8, description="Camera rays per pixel along each axis.")
    photons: int = Field(
        3_000_000, ge=1000, le=100_000_000, description="Light paths traced from the projector for each kind of bounce."
    )
    specular_bounces: int = Field(3, ge=0, le=8, description="Mirror-like reflections that are followed.")
    diffuse_bounces: int = Field(2, ge=0, le=8, description="Reflections followed where one of them is diffuse.")


_Rate = Annotated[float, Field(ge=0, le=1)]


class FaultRates(_Section):
    """Faults at random: the probability of each at every exposure, or at every picture that is shown."""

    seed: int = Field(0, ge=0, description="Seed of the faults: the same seed gives the same ones.")
    repeat_frame: _Rate = Field(0.0, description="The camera hands out its former frame once more.")
    stale: _Rate = Field(0.0, description="The projector still shows the picture before.")
    torn: _Rate = Field(0.0, description="A part of the picture's rows still is the picture before.")
    mixed: _Rate = Field(0.0, description="The picture changes during the exposure.")
    cut: _Rate = Field(0.0, description="The frame's last rows are missing, and nobody says so.")
    dark_flash: _Rate = Field(0.0, description="The projector is dark during a part of the exposure.")
    flicker: _Rate = Field(0.0, description="The room is brighter during the exposure.")
    drop: _Rate = Field(0.0, description="The frame never arrives.")
    late: _Rate = Field(0.0, description="The frame arrives `late_s` too late.")
    incomplete: _Rate = Field(0.0, description="The camera reports the frame as incomplete.")
    id_jump: _Rate = Field(0.0, description="The camera's frame numbers jump: frames were lost.")
    lose_camera: _Rate = Field(0.0, description="The camera is unplugged.")
    freeze: _Rate = Field(0.0, description="The projector does not change its picture for a while.")
    lag: _Rate = Field(0.0, description="The projector shows each picture one late for a while.")


class FaultSettings(_Section):
    """Faults to provoke: lists of exposures or of pictures, counted from 0 since the bench was opened, or rates."""

    repeat_frame_at: tuple[_Count, ...] = Field((), description="The camera hands out its former frame once more.")
    stale_at: tuple[_Count, ...] = Field((), description="The projector still shows the picture before.")
    torn_at: tuple[_Count, ...] = Field((), description="A part of the picture's rows still is the picture before.")
    mixed_at: tuple[_Count, ...] = Field((), description="The picture changes during the exposure.")
    cut_at: tuple[_Count, ...] = Field((), description="The frame's last rows are missing, and nobody says so.")
    dark_flash_at: tuple[_Count, ...] = Field((), description="The projector is dark during a part of the exposure.")
    flicker_at: tuple[_Count, ...] = Field((), description="The room is brighter during the exposure.")
    flicker_dn: float = Field(20.0, ge=0, description="By how much at most, grey value of the 8-bit scale.")
    drop_at: tuple[_Count, ...] = Field((), description="The frame never arrives.")
    late_at: tuple[_Count, ...] = Field((), description="The frame arrives `late_s` too late.")
    late_s: float = Field(5.0, ge=0, le=1000, description="How late a late frame arrives, s.")
    incomplete_at: tuple[_Count, ...] = Field((), description="The camera reports the frame as incomplete.")
    id_jump_at: tuple[_Count, ...] = Field((), description="The camera's frame numbers jump: frames were lost.")
    lose_camera_at: _Count | None = Field(None, description="The camera is unplugged at this exposure.")
    camera_back_after_s: float | None = Field(
        None, ge=0, description="After this time it is plugged in again, s; left out, it stays away."
    )
    freeze_at: tuple[_Count, ...] = Field((), description="Pictures from which on the projector stands still.")
    freeze_pictures: int = Field(15, ge=1, description="For so many pictures.")
    lag_at: tuple[_Count, ...] = Field((), description="Pictures from which on the projector is one picture late.")
    lag_pictures: int = Field(30, ge=1, description="For so many pictures.")
    rates: FaultRates = Field(FaultRates(), description="Faults at random.")


class SceneSettings(_Section):
    """A scene that is not there, a camera and a projector that look at it, and how its light is traced."""

    scene: Scene = Field(MirrorScene(), description="What stands in front of the bench.")
    camera: CameraSettings = Field(CameraSettings(), description="The camera.")
    projector: ProjectorSettings = Field(ProjectorSettings(), description="The projector.")
    baseline_mm: float = Field(
        180.0, gt=0, le=10_000, description="Distance of the projector to the camera's left, mm."
    )
    convergence_mm: float = Field(
        600.0,
        gt=0,
        le=100_000,
        description="Where the projector's axis crosses the camera's: distance from the camera, mm.",
    )
    projector_height_mm: float = Field(
        0.0, ge=-10_000, le=10_000, description="Height of the projector above the camera, mm; negative: below it."
    )
    projector_roll_deg: float = Field(
        0.0,
        ge=-180,
        le=180,
        description="Turn of the projector about its own axis, °; positive turns its picture clockwise for one who"
        " stands behind it.",
    )
    seed: int = Field(0, ge=0, description="Seed of the camera noise: the same seed gives the same frames.")
    transport: TransportSettings = Field(TransportSettings(), description="How finely light is traced.")
    cache_dir: Path | None = Field(
        None,
        description="Where computed light transport is kept; left out, the environment's MFS_SCANNER_CACHE or the"
        " user's cache folder.",
    )
    cache_limit_mb: int = Field(
        4000, ge=0, description="Size above which the oldest cached transports are deleted, MB."
    )

    def rig(self) -> Rig:
        """The rig as it truly stands: the projector left of the camera, turned in until their axes meet."""
        from scanner.rig import Rig

        centre = np.array([-self.baseline_mm, -self.projector_height_mm, 0.0])
        z = np.array([0.0, 0.0, self.convergence_mm]) - centre
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        y = np.cross(z, x)
        cos, sin = math.cos(math.radians(self.projector_roll_deg)), math.sin(math.radians(self.projector_roll_deg))
        rotation = np.stack((cos * x + sin * y, cos * y - sin * x, z))
        return Rig(
            self.camera.lens(), self.projector.lens(), rotation, -rotation @ centre, {"source": "simulated bench"}
        )


class SimulatedSettings(SceneSettings):
    """A bench that is not there: a scene, a camera and a projector that look at it, and how they fail."""

    settle_s: float | None = Field(
        None,
        ge=0,
        le=60,
        description="From showing a picture to the trigger, s; left out, the latency and one refresh, which suffice.",
    )
    knows_rig: bool = Field(True, description="False: a bench that nobody has calibrated yet; it knows no rig.")
    faults: FaultSettings = Field(FaultSettings(), description="Faults to provoke.")
    real_time: bool = Field(False, description="Let simulated time really pass.")
