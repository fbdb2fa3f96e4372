"""From a projected picture to a frame: projector response and blur, light transport, camera blur, sensor."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel, Pixels
from sim_backend.blur import blurred, blurred_within_more
from sim_backend.kernels import Floats
from sim_backend.settings import CameraSettings, ProjectorSettings, SceneSettings
from sim_backend.transport import Transport
from sim_backend.viewpoint import Viewpoint

_REFERENCE_EXPOSURE_US = 16_667.0
_REFERENCE_REFLECTANCE = 0.8

Shown = Iterable[tuple[float, NDArray[np.uint8]]]
"""Shares of an exposure and the pictures (height, width) that were on the surface meanwhile."""


@dataclass(frozen=True, eq=False)
class Optics:
    """The optical chain of a bench; grey values without noise are on the 8-bit scale and not cut off at 255.

    Parameters
    ----------
    transport
        Of the scene.
    camera, projector
        Their settings.
    dn_per_radiance
        Grey value of a unit of radiance at the reference exposure.
    """

    transport: Transport
    camera: CameraSettings
    projector: ProjectorSettings
    dn_per_radiance: float

    @classmethod
    def of(cls, settings: SceneSettings, transport: Transport) -> Optics:
        """The chain with the sensitivity that ``camera.white_dn`` asks for."""
        projector = Viewpoint.projector(settings.rig())
        target = np.array([[0.0, 0.0, settings.convergence_mm]])
        to_projector = projector.centre - target
        distance = np.linalg.norm(to_projector, axis=1, keepdims=True)
        flux_density = projector.density(projector.project(target), target, to_projector / distance)[0]
        radiance = flux_density * _REFERENCE_REFLECTANCE / math.pi
        return cls(transport, settings.camera, settings.projector, settings.camera.white_dn / radiance)

    @property
    def gain(self) -> float:
        """Grey value (8-bit scale) of a unit of radiance at the exposure that is set."""
        return self.dn_per_radiance * self.camera.exposure_us / _REFERENCE_EXPOSURE_US

    @cached_property
    def _response(self) -> Floats:
        return np.asarray((np.arange(256) / 255) ** self.projector.gamma, np.float32)

    def light_out(self, shown: Shown) -> Floats:
        """(height, width) what leaves the projector, 0..1, as the mean over an exposure."""
        light = np.zeros(self.transport.projector_size[::-1], np.float32)
        for share, picture in shown:
            light += cv2.LUT(picture, np.float32(share) * self._response)
        return self.projector_blurred(light)

    def projector_blurred(self, light: Floats) -> Floats:
        """The same picture (height, width) out of focus."""
        return blurred(light, self.projector.blur_px)

    def camera_blurred(self, light: Floats) -> Floats:
        """A picture (height, width) of the light at the pixels, as the camera's lens draws it where it has no edges."""
        return blurred_within_more(light, self.camera.blur_px)

    def direct_picture(self, light_out: Floats) -> Floats:
        """(height, width) radiance of direct light as the camera's pixels get it through its lens."""
        transport = self.transport
        picture = self.camera_blurred(transport.direct_light(light_out))
        # The lens blurs before the pixels sample: at edges that makes a difference, by `sim_backend.edges`.
        transport.edges.add_to(picture, light_out, self.camera.blur_px)
        return picture

    def bounced_picture(self, light_out: Floats) -> Floats:
        """(height, width) the same of light that took more than one reflection."""
        return self.camera_blurred(self.transport.bounced_light(light_out))

    def grey(self, shown: Shown) -> Floats:
        """(height, width) expected grey value of a frame, without noise and rounding."""
        out = self.light_out(shown)
        light = self.direct_picture(out) + self.bounced_picture(out)
        ambient = self.camera.ambient_dn * self.camera.exposure_us / _REFERENCE_EXPOSURE_US
        return light * np.float32(self.gain) + np.float32(ambient)


@dataclass(frozen=True)
class Sensor:
    """What a pixel makes of light: noise, rounding, saturation.

    Parameters
    ----------
    settings
        Of the camera.
    """

    settings: CameraSettings

    @property
    def frame_format(self) -> FrameFormat:
        """What frames look like."""
        return FrameFormat(self.settings.width_px, self.settings.height_px, self.settings.bits)

    @property
    def scale(self) -> float:
        """Grey values of a frame per grey value of the 8-bit scale."""
        return self.frame_format.saturated_dn / 255

    @property
    def noise(self) -> NoiseModel:
        """The true noise model, in grey values of a frame; rounding alone makes 1/12 DN²."""
        read = max(self.settings.read_noise_dn * self.scale, math.sqrt(1 / 12))
        electrons = self.settings.electrons_per_dn
        return NoiseModel(read, 0.0 if electrons is None else self.scale / electrons)

    def digitise(self, grey: Floats, random: np.random.Generator, out: Pixels) -> None:
        """Write the frame of expected grey values (8-bit scale) to ``out``, both (height, width)."""
        signal = grey * np.float32(self.scale)
        model = self.noise
        variance = model.variance(signal) if model.dn_per_electron else model.read_dn**2
        sigma = np.sqrt(np.maximum(variance - 1 / 12, 0.0)).astype(np.float32)
        signal += sigma * random.standard_normal(signal.shape, np.float32)
        np.rint(signal, out=signal)
        out[...] = np.clip(signal, 0, self.frame_format.saturated_dn, out=signal)
