"""Where methods are compared: rectangles of the picture, places that the bench knows, or the detected region."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import SceneTruth
from scanner.comparison.detection import bounces
from scanner.config import CompareSection, ConfigError, WindowSection
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


def windows_of(section: CompareSection, maps: Iterable[Maps], truth: SceneTruth | None = None) -> list[Window]:
    """Windows of the configuration; without any, the largest connected region that the first able method detected.

    Parameters
    ----------
    section
        Of the configuration.
    maps
        Of the methods in their order, one at least.
    truth
        Knows the places that windows name; None where the bench cannot tell.

    Raises
    ------
    ConfigError
        A window reaches beyond the picture, or its place is not known.
    """
    first, *others = maps
    found = [
        Window(
            window.name,
            window.fit,
            _rectangle(window, first.flags.shape)
            if window.place is None
            else _place(window, window.place, truth, section.least_alpha),
        )
        for window in section.windows
    ]
    if found:
        return found
    detected = next((m.interreflection for m in (first, *others) if m.interreflection.any()), None)
    if detected is None:
        return [Window("whole picture", section.fit, first.valid)]
    return [Window("bounce region", section.fit, largest_region(detected))]


def _rectangle(window: WindowSection, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    x, y, width, height = (side or 0 for side in (window.x, window.y, window.width, window.height))
    if x + width > shape[1] or y + height > shape[0]:
        raise ConfigError(
            f"compare.windows: {window.name} reaches to ({x + width}, {y + height}), "
            f"the camera's picture to ({shape[1]}, {shape[0]}) px",
            "move the window, or make it smaller",
        )
    mask = np.zeros(shape, bool)
    mask[y : y + height, x : x + width] = True
    return mask


def _place(window: WindowSection, place: str, truth: SceneTruth | None, least_alpha: float) -> NDArray[np.bool_]:
    """Pixels of a place that have direct light and do not mix surfaces."""
    if truth is None:
        raise ConfigError(
            f"compare.windows: {window.name} is a place of the scene, which this bench does not know",
            "give a rectangle: x, y, width and height",
        )
    places = truth.places
    if place not in places:
        raise ConfigError(
            f"compare.windows: {window.name} is at {place}, which this scene does not have",
            f"name one of {', '.join(places)}",
        )
    bounce, _ = bounces(truth, least_alpha)
    mask = places[place] & (bounce if window.bounced else np.isfinite(truth.x_p) & ~truth.edge)
    if not mask.any():
        raise ConfigError(
            f"compare.windows: {window.name} has no pixel: {place} is not seen, not lit, or sees no bounce",
            "choose another place, or a finer camera",
        )
    return mask


def largest_region(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected part of a mask."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))
