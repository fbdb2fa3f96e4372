"""Cameras that can be had without one: viky, which comes with the GenICam binding, and the simulated producer.

In its own file so that tests of drivers, conformance and speed use the same.
"""

import functools
import os
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
from leftovers import shared_memory
from requirements import require

from drivers import HardwareError, MissingLibraryError, SystemClock
from drivers.genicam import GenICamCamera, GenICamSettings


def viky():
    """The producer that the genicam wheel carries; nobody here wrote it."""
    try:
        import genicam
    except ImportError:
        require(False, "needs the packages genicam and harvesters: pip install 'mfs-scanner[genicam]'")
    path = Path(genicam.__file__).parent / "viky.cti"
    require(path.exists(), "this genicam wheel has no viky.cti")
    return path


def simulator():
    """The simulated producer, compiled when it is first needed."""
    from sim_backend.gentl.build import producer_path

    try:
        return producer_path()
    except MissingLibraryError as error:
        require(False, str(error))


@contextmanager
def plugged_in(folder, devices="SIM0001:bench:MFS Sim:64x48", world=None):
    """Simulated cameras ``serial:user name:model:size;…`` of this test alone, whatever other tests unplug."""
    changes = {"MFS_SIM_GENTL_DEVICES": devices, "MFS_SIM_GENTL_DIR": str(folder), "MFS_SIM_WORLD": world}
    former = {name: os.environ.get(name) for name in changes}
    try:
        _set(changes)
        yield simulator()
    finally:
        _set(former)


def _set(changes):
    for name, value in changes.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = str(value)


def simulated(**settings):
    """A camera of the simulated producer that is plugged in."""
    values = {"producer": simulator(), "exposure_us": 1000.0} | settings
    return GenICamCamera(GenICamSettings(**values), SystemClock())


def free_running(**settings):
    """A camera of viky, small and fast; it knows neither triggers nor exposure times."""
    rate = {"AcquisitionFrameRate": 200.0} | settings.pop("features", {})
    values = {"producer": viky(), "serial": "1", "trigger": "free_run", "width_px": 128, "height_px": 104}
    return GenICamCamera(GenICamSettings(**(values | settings), features=rate), SystemClock())


@contextmanager
def running(camera):
    """The camera, started, and a place for its frames."""
    try:
        camera.open()
        frame_format = camera.configure()
        camera.arm()
        camera.start()
        yield camera, np.empty(frame_format.shape, frame_format.dtype)
    finally:
        camera.close()


def exposure_picture(shape, bits, number):
    """What the simulated producer says it delivers as exposure ``number`` where there is no world to look at."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    return (column + 3 * row + 5 * number) % (1 << bits)


class NumberedPictures:
    """What simulated cameras see where a test gives them a world: the exposure's number is in every pixel."""

    def picture(self, request):
        shape = (request.height_px, request.width_px)
        dtype = np.uint8 if request.bits == 8 else np.uint16
        return exposure_picture(shape, request.bits, request.frame_id).astype(dtype)


def shot(camera, out, timeout_s=10.0):
    """Trigger and fetch; returns the stamp."""
    camera.trigger()
    return camera.fetch(out, timeout_s)


def shot_until_fault(camera, out, timeout_s=10.0):
    """Trigger and fetch until a fault shows: one that was injected reaches the camera a moment later.

    Returns the stamp of the last good frame and the error.
    """
    stamp = None
    for _ in range(100):
        try:
            stamp = shot(camera, out, timeout_s)
        except HardwareError as error:
            return stamp, error
    raise AssertionError("no fault came")


def counters(camera):
    """What the camera has counted since it was opened."""
    return camera.describe()["counters"]


def wait_for(condition, within_s=20.0):
    """Wait until the condition holds; fails the test where it does not."""
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def left_behind():
    """Processes and shared memory that a device could have left."""
    children = [
        child
        for child in psutil.Process().children(recursive=True)
        if child.is_running() and child.status() != psutil.STATUS_ZOMBIE and "resource_tracker" not in _line(child)
    ]
    return children, {name for name in shared_memory() if name.startswith("psm_")}


def _line(process):
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return ""


def give_edges(path, serial, frames, rate_hz, bits):
    """A program of its own that a camera looks at: one constant picture, and ``frames`` edges on its line 0."""
    from sim_backend.gentl.feed import PictureServer

    class Constant:
        def picture(self, request):
            return constant(request.height_px, request.width_px)

    @functools.cache
    def constant(height, width):
        return np.full((height, width), 99, np.uint8 if bits == 8 else np.uint16)

    with PictureServer(Path(path), Constant()) as server:
        wait_for(lambda: serial in server.cameras, within_s=60.0)
        time.sleep(0.2)
        for _ in range(frames):
            time.sleep(1 / rate_hz)  # never less, for a camera answers no edge while it exposes
            server.edge(0, True, time.monotonic(), serial)
            server.edge(0, False, time.monotonic(), serial)
        wait_for(lambda: serial not in server.cameras, within_s=60.0)
