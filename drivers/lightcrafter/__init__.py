"""LightCrafter projectors over USB: the 4500 (DLPC350) and the 6500 and 9000 (DLPC900)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.lightcrafter.discovery import UDEV_RULE, UDEV_RULE_PATH, UsbProjector, find_projectors
from drivers.lightcrafter.settings import (
    LightCrafter4500Settings,
    LightCrafter6500Settings,
    LightCrafter9000Settings,
    LightCrafterSettings,
    StoredPicture,
    TriggerOutput,
)

if TYPE_CHECKING:
    from drivers.devices import Clock, SequencePlayer

__all__ = [
    "UDEV_RULE",
    "UDEV_RULE_PATH",
    "LightCrafter4500Settings",
    "LightCrafter6500Settings",
    "LightCrafter9000Settings",
    "LightCrafterSettings",
    "StoredPicture",
    "TriggerOutput",
    "UsbProjector",
    "find_projectors",
    "make_lightcrafter",
]


def make_lightcrafter(
    settings: LightCrafterSettings, clock: Clock, *, screen: SequencePlayer | None = None, backend: Any = None
) -> SequencePlayer:
    """Give the closed projector that ``settings`` describe.

    Parameters
    ----------
    settings
        Of the projector.
    clock
        Time.
    screen
        What shows the pictures in the modes ``video`` and ``video_pattern``; None for the window of the settings.
    backend
        A `usb.backend.IBackend` to find the projector on; None for libusb.
    """
    if settings.mode == "prestored":
        from drivers.lightcrafter.stored import StoredProjector

        return StoredProjector(settings, clock, backend=backend)
    if not isinstance(settings, LightCrafter4500Settings) and settings.mode == "on_the_fly":
        from drivers.lightcrafter.on_the_fly import OnTheFlyProjector

        return OnTheFlyProjector(settings, clock, backend=backend)
    from drivers.lightcrafter.video import VideoPatternProjector

    if screen is None:
        from drivers.window import WindowProjector

        assert settings.window is not None  # the settings have seen to it
        screen = WindowProjector(settings.window, clock)
    return VideoPatternProjector(settings, clock, screen=screen, backend=backend)
