"""A projector that is a screen: pictures in a window that fills it, in a process of its own."""

from drivers.window.projector import WindowProjector
from drivers.window.screens import Screen, list_screens
from drivers.window.settings import SyncPatch, WindowSettings

__all__ = ["Screen", "SyncPatch", "WindowProjector", "WindowSettings", "list_screens"]
