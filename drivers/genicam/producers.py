"""GenTL producers, the vendors' shared libraries (.cti) that reach cameras: where they are, and what they see.

`load` runs vendors' code and belongs in a process of its own; a producer that lacks a function, or has a fault, takes
its process along.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.errors import MissingLibraryError
from drivers.genicam.library import complaints, is_genicam_error, load_harvesters

SEARCH_PATH = "GENICAM_GENTL64_PATH"
"""The environment variable in which vendors' installers leave the folders of their producers."""

_ACCESS = {
    1: "free",
    2: "read only",
    3: "not accessible",
    4: "in use",
    5: "open here",
    6: "open here, read only",
}
"""DEVICE_ACCESS_STATUS of GenTL 1.6 in words."""


@dataclass(frozen=True)
class DeviceReport:
    """A camera that a producer sees; empty where the producer does not say.

    Parameters
    ----------
    producer
        The .cti file.
    key
        The producer's own name of it, unique within the producer.
    vendor, model, serial, user_name
        What an operator may choose it by.
    access
        ``free``, ``in use``, ``not accessible``, ``read only`` or ``unknown``.
    """

    producer: Path
    key: str
    vendor: str
    model: str
    serial: str
    user_name: str
    access: str

    def __str__(self) -> str:
        name = f", user name {self.user_name!r}" if self.user_name else ""
        return (
            f"{self.vendor} {self.model}, serial {self.serial or 'not given'}{name}, {self.access} "
            f"({self.producer.name})"
        )


def producer_files(paths: Sequence[Path] | None) -> list[Path]:
    """The producers that are meant: the given files, or with None all in the folders of `SEARCH_PATH`."""
    if paths is not None:
        return list(paths)
    entries = [Path(entry) for entry in os.environ.get(SEARCH_PATH, "").split(os.pathsep) if entry]
    found = [file for entry in entries for file in ([entry] if entry.is_file() else sorted(entry.glob("*.cti")))]
    return list({file.resolve(): file for file in found}.values())


def load(path: Path) -> tuple[Any, list[DeviceReport]]:
    """Load one producer and look for its cameras.

    Returns
    -------
    harvester
        The ``harvesters.core.Harvester`` that holds it, for this one producer; reports are in the order of its
        ``device_info_list``.
    devices
        What is there, perhaps nothing.

    Raises
    ------
    MissingLibraryError
        There is no such file, or it is no producer that works.
    """
    core = load_harvesters()
    harvester = core.Harvester()
    try:
        with complaints() as said:
            # Both checks are off by default: a file that is not there would be no error.
            harvester.add_file(str(path), check_existence=True, check_validity=True)
            harvester.update()
    except FileNotFoundError:
        raise MissingLibraryError(
            f"there is no GenTL producer {path}",
            f"Give the path of the vendor's .cti file as `producer`, or its folder in {SEARCH_PATH}.",
        ) from None
    except OSError as error:
        raise _unusable(path, str(error)) from None
    if said and not harvester.device_info_list:
        harvester.reset()
        raise _unusable(path, "; ".join(said))
    return harvester, [_report(path, info) for info in harvester.device_info_list]


def _unusable(path: Path, why: str) -> MissingLibraryError:
    return MissingLibraryError(
        f"GenTL producer {path} cannot be used: {why}",
        "Install the camera vendor's software for this system (64 bit), and leave the .cti file in its own folder.",
    )


def _report(producer: Path, info: Any) -> DeviceReport:
    def ask(name: str) -> Any:
        try:
            return getattr(info, name)
        except Exception as error:
            if is_genicam_error(error):
                return ""
            raise

    return DeviceReport(
        producer=producer,
        key=ask("id_"),
        vendor=ask("vendor"),
        model=ask("model"),
        serial=ask("serial_number"),
        user_name=ask("user_defined_name"),
        access=_ACCESS.get(ask("access_status"), "unknown"),
    )
