"""The light of a traced scene, computed while a picture is still on its way."""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from drivers import FrameFormat
from sim_backend.kernels import Floats
from sim_backend.light import Grey, Shown
from sim_backend.optics import Optics, Sensor
from sim_backend.surface import Picture

_REFERENCE_US = 16_667.0
_KEPT_PICTURES = 24


class SceneLight:
    """The light of a traced scene, with the camera's noise.

    Light adds up: what an exposure collects is the sum over its pictures. So the light of a picture is computed once,
    from when it leaves for the surface.

    Parameters
    ----------
    optics
        Of the bench; exposure and depth of its camera are overruled by each frame's.
    seed
        Of the noise: the same frames come with the same noise in the same order.
    """

    def __init__(self, optics: Optics, seed: int) -> None:
        reference = optics.camera.model_copy(update={"exposure_us": _REFERENCE_US, "ambient_dn": 0.0})
        self._optics = replace(optics, camera=reference)
        self._camera = optics.camera
        self._random = np.random.default_rng(seed)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="expected light")
        self._lock = threading.Lock()
        self._computed: OrderedDict[int, tuple[Picture, Future[Floats]]] = OrderedDict()

    def expect(self, picture: Picture) -> None:
        """Compute the light of ``picture`` while it is on its way."""
        self._of(picture)

    def frame(self, shown: Shown, exposure_s: float, gain: float, black_dn: float, frame_format: FrameFormat) -> Grey:
        """Frame (height, width) of one exposure."""
        sensor = Sensor(self._camera.model_copy(update={"bits": frame_format.bits}))
        factor = gain * exposure_s * 1e6 / _REFERENCE_US
        size = self._camera.height_px, self._camera.width_px
        grey = np.full(size, self._camera.ambient_dn * factor, np.float32)
        for share, picture in shown:
            grey += np.float32(share * factor) * self._of(picture).result()
        grey += np.float32(black_dn / sensor.scale)
        frame: Grey = np.empty(frame_format.shape, frame_format.dtype)
        sensor.digitise(grey, self._random, frame)
        return frame

    def close(self) -> None:
        """Stop computing."""
        self._worker.shutdown(cancel_futures=True)

    def _of(self, picture: Picture) -> Future[Floats]:
        with self._lock:
            # With the picture kept beside its light, nothing else can have its identity.
            kept = self._computed.pop(id(picture), None)
            if kept is None:
                kept = picture, self._worker.submit(self._optics.grey, [(1.0, picture)])
            self._computed[id(picture)] = kept
            if len(self._computed) > _KEPT_PICTURES:
                self._computed.popitem(last=False)
            return kept[1]
