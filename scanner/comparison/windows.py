"""Where methods are compared: rectangles of the picture that the configuration names, or the detected region."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.config import CompareSection, ConfigError
from scanner.result import Maps


@dataclass(frozen=True)
class Window:
    """A part of the picture with one surface in it.

    Parameters
    ----------
    name
        For tables, such as ``W1``.
    fit
        What is fitted to the points in it.
    mask
        (H, W) bool.
    """

    name: str
    fit: Literal["plane", "sphere"]
    mask: NDArray[np.bool_]


def windows_of(section: CompareSection, maps: Iterable[Maps]) -> list[Window]:
    """Windows of the configuration; without any, the largest connected region that the first able method detected.

    Parameters
    ----------
    section
        Of the configuration.
    maps
        Of the methods in their order, one at least.

    Raises
    ------
    ConfigError
        A window reaches beyond the picture.
    """
    first, *others = maps
    height, width = first.flags.shape
    found = []
    for window in section.windows:
        if window.x + window.width > width or window.y + window.height > height:
            raise ConfigError(
                f"compare.windows: {window.name} reaches to ({window.x + window.width}, {window.y + window.height}), "
                f"the camera's picture to ({width}, {height}) px",
                "move the window, or make it smaller",
            )
        mask = np.zeros((height, width), bool)
        mask[window.y : window.y + window.height, window.x : window.x + window.width] = True
        found.append(Window(window.name, window.fit, mask))
    if found:
        return found
    detected = next((m.interreflection for m in (first, *others) if m.interreflection.any()), None)
    if detected is None:
        return [Window("whole picture", section.fit, first.valid)]
    return [Window("bounce region", section.fit, largest_region(detected))]


def largest_region(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected part of a mask."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))
