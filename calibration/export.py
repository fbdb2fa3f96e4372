"""A rig for other programs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scanner.rig import Rig, RigError


def export_opencv(rig: Rig, path: str | Path) -> None:
    """Write a rig as OpenCV FileStorage (YAML, XML or JSON by the name's ending).

    Names are those of `cv2.stereoCalibrate` with the camera as first and the projector as second view: K1, D1, K2, D2,
    R, T (mm), image_width, image_height, screenResX, screenResY. `Rig.load` reads the same lenses and pose back.

    Raises
    ------
    RigError
        The file cannot be written.
    """
    path = Path(path)
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    except cv2.error:
        storage = None
    if storage is None or not storage.isOpened():
        raise RigError(
            f"cannot write rig {path}",
            "Choose a place that can be written and a name that ends in .yml, .xml or .json.",
        )
    for name, values in (
        ("K1", rig.camera.matrix),
        ("D1", _row(rig.camera.distortion)),
        ("K2", rig.projector.matrix),
        ("D2", _row(rig.projector.distortion)),
        ("R", rig.rotation),
        ("T", rig.translation.reshape(3, 1)),
    ):
        storage.write(name, np.ascontiguousarray(values))
    for name, number in zip(("image_width", "image_height"), rig.camera.size, strict=True):
        storage.write(name, int(number))
    for name, number in zip(("screenResX", "screenResY"), rig.projector.size, strict=True):
        storage.write(name, int(number))
    storage.release()


def _row(distortion: np.ndarray) -> np.ndarray:
    """(1, n): OpenCV's matrices are never empty, so a lens without distortion is written with four zeros."""
    return np.zeros((1, 4)) if distortion.size == 0 else distortion.reshape(1, -1)
