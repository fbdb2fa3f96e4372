"""Cameras of any vendor by the GenICam standard, reached through GenTL producers with harvesters."""

from drivers.genicam.camera import GenICamCamera
from drivers.genicam.settings import GenICamSettings

__all__ = ["GenICamCamera", "GenICamSettings"]
