"""What is really there: for tests that judge a scan. The pipeline has no way to ask for it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.rig import Rig
from sim_backend.edges import mixing
from sim_backend.kernels import Floats
from sim_backend.optics import Optics, Sensor
from sim_backend.scenes import Window

_PERIOD_PX = 16
_LEAST_BOUNCE = 1e-6
"""Bounced light below this share of the brightest direct light is none."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth of one scene on one bench; all arrays have the camera's (height, width), NaN is "none".

    Parameters
    ----------
    optics
        The chain from projector to camera.
    rig
        Where camera and projector truly are.
    windows
        The scene's windows, by name.
    parts
        Numbers of the surfaces of the scene's parts, by name, as in `object_id`.
    """

    optics: Optics
    rig: Rig
    windows: Mapping[str, Window] = field(default_factory=dict)
    parts: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @property
    def x_p(self) -> Floats:
        """Projector column, px, that directly lights what the pixel's centre sees; NaN where none does."""
        return self.optics.transport.view.x_p

    @property
    def y_p(self) -> Floats:
        """Projector row, px, as `x_p`."""
        return self.optics.transport.view.y_p

    @property
    def object_id(self) -> NDArray[np.int8]:
        """Number of the surface at the pixel's centre, in the order of the scene's ``surfaces()``; −1 for none."""
        return self.optics.transport.view.surface

    @property
    def depth(self) -> Floats:
        """Distance along the camera's axis, mm, of the surface at the pixel's centre, lit or not."""
        return self.optics.transport.view.depth

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """(height, width, 3) mm in the camera frame of what the pixel's centre sees."""
        return np.asarray(self.rig.camera.pixel_rays() * self.depth[..., None], np.float64)

    def in_window(self, name: str) -> NDArray[np.bool_]:
        """Pixels that see the scene's window of this name; ``KeyError`` for one that it does not have."""
        return self.windows[name].holds(self.points, self.object_id)

    @property
    def places(self) -> Mapping[str, NDArray[np.bool_]]:
        """Pixels of every part and in every window, by name."""
        parts = {name: np.isin(self.object_id, list(numbers)) for name, numbers in self.parts.items()}
        return parts | {name: self.in_window(name) for name in self.windows}

    @cached_property
    def edge(self) -> NDArray[np.bool_]:
        """Pixels that mix surfaces, depths, or light and shadow, within themselves or through the camera's blur."""
        mixed = mixing(self.optics.transport.view, float(self.rig.camera.matrix[0, 0]))
        reach = math.ceil(3 * self.optics.camera.blur_px)
        return np.asarray(cv2.dilate(mixed.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)), bool)

    @cached_property
    def _responses(self) -> tuple[tuple[NDArray[np.complex64], NDArray[np.complex64]], ...]:
        """Direct and bounced radiance under the fringe e^{i2πu/16} along each axis."""
        width, height = self.optics.transport.projector_size
        both = []
        for u in (np.arange(width)[None], np.arange(height)[:, None]):
            turns = np.broadcast_to(2 * np.pi * u / _PERIOD_PX, (height, width))
            parts = [self._light(f(turns)) for f in (np.cos, np.sin)]
            both.append((parts[0][0] + 1j * parts[1][0], parts[0][1] + 1j * parts[1][1]))
        return tuple(both)

    def _light(self, pattern: NDArray[np.float64]) -> tuple[Floats, Floats]:
        out = self.optics.projector_blurred(pattern.astype(np.float32))
        return self.optics.direct_picture(out), self.optics.bounced_picture(out)

    @cached_property
    def alpha(self) -> Floats:
        """Bounced over direct amplitude of a fringe of 16 px, the larger of both axes; NaN without direct light."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.max([np.abs(bounced) / np.abs(direct) for direct, bounced in self._responses], axis=0)
        return np.where(np.isfinite(self.x_p), ratio, np.nan).astype(np.float32)

    @cached_property
    def direct_amplitude(self) -> Floats:
        """Amplitude of the direct light's fringes along x of 16 px at full contrast, in grey values of a frame.

        For a projector of linear response.
        """
        scale = self.optics.gain * Sensor(self.optics.camera).scale
        return np.asarray(0.5 * scale * np.abs(self._responses[0][0]), np.float32)

    @cached_property
    def _bounce(self) -> tuple[Floats, Floats]:
        width, height = self.optics.transport.projector_size
        bounced = self.optics.transport.bounced_light
        white = np.ones((height, width), np.float32)
        amount = bounced(white, diffuse=False)
        threshold = _LEAST_BOUNCE * float(self.optics.transport.direct_light(white).max())
        with np.errstate(divide="ignore", invalid="ignore"):
            means = [
                np.where(amount > threshold, bounced(white * u.astype(np.float32), diffuse=False) / amount, np.nan)
                for u in (np.arange(width)[None], np.arange(height)[:, None])
            ]
        return means[0], means[1]

    @property
    def bounce_x(self) -> Floats:
        """Mean projector column, px, of the light that comes over mirrors and lobes, weighted by amount."""
        return self._bounce[0]

    @property
    def bounce_y(self) -> Floats:
        """Mean projector row, px, as `bounce_x`."""
        return self._bounce[1]
