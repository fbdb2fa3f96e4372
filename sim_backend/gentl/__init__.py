"""A simulated GenTL producer: cameras that any GenICam consumer can use, and a world for them to look at.

The producer is a C library (``*.c``, built by `producer_path`) with the interface of GenTL 1.6. It knows nothing of
Python: what it is told comes through environment variables (before GCInitLib), through the camera's features, and
through a unix socket, the far end of which is `PictureServer`.

    ``MFS_SIM_GENTL_DEVICES``  the cameras: ``serial:user name:model:WIDTHxHEIGHT;…``. What is left out is SIM0001
                               (SIM0002, …), ``bench``, ``MFS Sim``, ``1024x768``. A model with ``Legacy`` in its name
                               has ExposureTimeAbs, GainRaw, AcquisitionFrameRateAbs and TriggerDelayAbs instead of
                               ExposureTime, Gain, AcquisitionFrameRate and TriggerDelay. Unset: one camera, SIM0001.
    ``MFS_SIM_GENTL_DIR``      folder that stands for the bus: who holds a camera, which one is unplugged (`unplug`).
    ``MFS_SIM_WORLD``          socket of a `PictureServer`. Unset: the camera makes its own test picture, pixel in
                               sensor column X and row Y = (X + 3 Y + 5 frame id + BlackLevel) modulo 2^bits.

`installed` sets them for a while. Features are those of SFNC (``device.xml``): geometry, pixel formats Mono8, 10, 12,
16, 10p, 12p, 12Packed, exposure, gain, triggers by software and by Line0 and Line1, frame rate, and Line2 as output
"exposure active". Faults are features too (category SimulatedFaults, ``faults.h``): ``SimDropIn = 1`` drops the next
frame, ``SimDropEvery = 7`` each seventh; or `PictureServer.inject`, which works while a driver holds the camera.

How a camera behaves: a trigger begins an exposure; one that comes during an exposure is ignored and counted in
SimTriggersIgnored. The picture is asked for when the exposure has ended, and delivered at once. The time stamp is the
begin of the exposure on the clock of `time.monotonic`, in ns. Frame ids count exposures from 0 in each acquisition; a
frame that finds no buffer is lost and counted as underrun.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sim_backend.gentl.build import producer_path
from sim_backend.gentl.feed import Exposure, ExposureRequest, Fault, Picture, PictureServer, PictureSource

__all__ = [
    "Exposure",
    "ExposureRequest",
    "Fault",
    "Picture",
    "PictureServer",
    "PictureSource",
    "SimulatedCameraId",
    "installed",
    "plug",
    "producer_path",
    "unplug",
]


@dataclass(frozen=True)
class SimulatedCameraId:
    """Who a simulated camera is; no name may hold ``:`` or ``;`` or be longer than 63 bytes.

    Parameters
    ----------
    serial, user_name, model
        As the camera tells them. A model with ``Legacy`` in its name knows the feature names of SFNC 1 only.
    width_px, height_px
        Of the sensor: 16 to 16384 in steps of 8, 2 to 16384 in steps of 2.
    """

    serial: str = "SIM0001"
    user_name: str = "bench"
    model: str = "MFS Sim"
    width_px: int = 1024
    height_px: int = 768

    def __str__(self) -> str:
        return f"{self.serial}:{self.user_name}:{self.model}:{self.width_px}x{self.height_px}"


@contextlib.contextmanager
def installed(
    folder: Path, cameras: Sequence[SimulatedCameraId] = (SimulatedCameraId(),), world: Path | None = None
) -> Iterator[Path]:
    """Set the producer's environment variables; gives the path of the producer.

    Parameters
    ----------
    folder
        Stands for the bus; processes that are to see the same cameras share it.
    cameras
        That are plugged in.
    world
        Socket of a `PictureServer`; None for the test picture.

    Raises
    ------
    MissingLibraryError
        The producer cannot be built.
    """
    producer = producer_path()
    wanted = {
        "MFS_SIM_GENTL_DEVICES": ";".join(map(str, cameras)),
        "MFS_SIM_GENTL_DIR": str(folder),
        "MFS_SIM_WORLD": "" if world is None else str(world),
    }
    former = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield producer
    finally:
        for name, value in former.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def unplug(folder: Path, serial: str, away_s: float | None = None) -> None:
    """Pull a camera's cable, whoever holds it; with ``away_s`` it comes back by itself so many seconds later.

    A camera that streams is noticed to be gone within 50 ms, any other one when it is next spoken to.
    """
    back_ns = 0 if away_s is None else time.monotonic_ns() + round(away_s * 1e9)
    draft = folder / f"{serial}.unplugging"
    draft.write_text(f"{back_ns}\n")
    draft.replace(folder / f"{serial}.unplugged")


def plug(folder: Path, serial: str) -> None:
    """Plug a camera in again; whoever had it open has to open it anew."""
    (folder / f"{serial}.unplugged").unlink(missing_ok=True)
