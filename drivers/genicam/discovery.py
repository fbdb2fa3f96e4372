"""Which cameras each GenTL producer sees, without running a vendor's code in this process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import DeviceLostError, DeviceNotFoundError, OperatorError
from drivers.genicam.library import silence_output
from drivers.genicam.producers import SEARCH_PATH, DeviceReport, load, producer_files
from drivers.genicam.settings import GenICamSettings
from drivers.process import DeviceProcess, Emit


@dataclass(frozen=True)
class ProducerReport:
    """What became of loading one producer.

    Parameters
    ----------
    path
        The .cti file.
    error
        What went wrong; None where nothing did.
    devices
        The cameras it sees.
    """

    path: Path
    error: str | None
    devices: tuple[DeviceReport, ...]


def discover(producers: Sequence[Path] | None = None, timeout_s: float = 15.0) -> list[ProducerReport]:
    """Load each producer in a process of its own and list its cameras.

    Parameters
    ----------
    producers
        The .cti files; None for all in the folders of GENICAM_GENTL64_PATH.
    timeout_s
        How long one producer may take, s.

    Raises
    ------
    MissingLibraryError
        harvesters or the GenICam binding is not installed.
    """
    return [_examine(path, timeout_s) for path in producer_files(producers)]


def _examine(path: Path, timeout_s: float) -> ProducerReport:
    process = DeviceProcess(f"GenTL producer {path}", Enumerator)
    try:
        process.start()
        devices = process.call("devices", path, timeout_s=timeout_s)
    except DeviceLostError as error:
        return ProducerReport(path, error.message, ())
    except OperatorError as error:
        if not process.alive:
            raise
        return ProducerReport(path, error.message, ())
    finally:
        process.stop()
    return ProducerReport(path, None, tuple(devices))


class Enumerator:
    """What runs in the process: loads one producer and says what it sees."""

    def __init__(self, emit: Emit) -> None:
        from drivers.genicam.library import load_harvesters

        silence_output()
        load_harvesters()

    def devices(self, path: Path) -> list[DeviceReport]:
        """Load the producer at ``path`` and let go of it again."""
        harvester, devices = load(path)
        harvester.reset()
        return devices

    def idle(self) -> float:
        """Nothing to do."""
        return 60.0

    def close(self) -> None:
        """Nothing is held."""


def choose(reports: Sequence[ProducerReport], settings: GenICamSettings) -> DeviceReport:
    """The one camera that the settings mean.

    Raises
    ------
    DeviceNotFoundError
        None is, or more than one; the message lists all that are there.
    """
    wanted = {
        name: value for name in ("serial", "model", "user_name") if (value := getattr(settings, name)) is not None
    }
    there = [device for report in reports for device in report.devices]
    meant = [d for d in there if all(getattr(d, name) == value for name, value in wanted.items())]
    if len(meant) == 1:
        return meant[0]
    words = " and ".join(f"{name} {value!r}" for name, value in wanted.items())
    if not reports:
        what = f"no GenTL producer was found: {SEARCH_PATH} names no folder with a .cti file"
        remedy = "Install the camera vendor's software, or give the path of its .cti file as `producer`."
    elif meant:
        what = f"{len(meant)} cameras are meant" + (f" by {words}" if words else "; the bench file names none")
        remedy = "Choose one by its `serial` in the bench file."
    else:
        what = f"no camera has {words}" if words else "no camera was found"
        remedy = (
            "Check the camera's cable and power, and that no other program holds it; for a camera on the network, "
            "that it is in the network of its port."
        )
    lines = [f"there is: {device}" for device in there] or ["no camera is there"]
    lines += [f"{report.path.name}: {report.error}" for report in reports if report.error]
    raise DeviceNotFoundError("\n    ".join([what, *lines]), remedy)
