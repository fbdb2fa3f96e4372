"""Stock harvesters on the simulated GenTL producer, for tests of what lies below every driver."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import textwrap
import time
import warnings

import numpy as np

from sim_backend.gentl import SimulatedCameraId, installed

with warnings.catch_warnings():  # harvesters changes the filters when it is imported
    try:
        from genicam import genapi, gentl
        from harvesters.core import Harvester
    except ImportError:
        genapi = gentl = Harvester = None

SMALL = SimulatedCameraId(width_px=64, height_px=48)


@contextlib.contextmanager
def harvester(producer):
    """A harvester of that producer; leaves nothing open and the handler of Ctrl-C as it was."""
    on_interrupt = signal.getsignal(signal.SIGINT)
    harvester = Harvester()
    try:
        harvester.add_file(str(producer), check_existence=True, check_validity=True)
        harvester.update()
        yield harvester
    finally:
        harvester.reset()
        signal.signal(signal.SIGINT, on_interrupt)


@contextlib.contextmanager
def camera(folder, identity=SMALL, world=None):
    """An acquirer of the one camera there is."""
    with installed(folder, [identity], world) as producer, harvester(producer) as h:
        yield h.create({"serial_number": identity.serial})


def software_triggered(acquirer, exposure_us=100.0, buffers=16):
    """Set the camera so; gives its features."""
    nodes = acquirer.remote_device.node_map
    nodes.TriggerSelector.value = "FrameStart"
    nodes.TriggerSource.value = "Software"
    nodes.TriggerMode.value = "On"
    nodes.ExposureTime.value = exposure_us
    acquirer.num_buffers = buffers
    return nodes


def next_frame(acquirer, timeout=2.0):
    """(id, time stamp in ns, picture) of the next complete frame."""
    with acquirer.fetch(timeout=timeout) as buffer:
        component = buffer.payload.components[0]
        picture = component.data.reshape(component.height, component.width).copy()
        return buffer.module.frame_id, buffer.timestamp_ns, picture


def shoot(acquirer, timeout=20.0):
    """Trigger a frame and fetch it."""
    acquirer.remote_device.node_map.TriggerSoftware.execute()
    return next_frame(acquirer, timeout)


def wait_for(condition, timeout=20.0):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def documented_picture(width, height, bits, frame_id, x=0, y=0, black=0):
    """The picture that a camera without a world is said to make."""
    row, column = np.mgrid[y : y + height, x : x + width]
    return (column + 3 * row + 5 * frame_id + black) % 2**bits


def good(frame, frame_id, shown=None):
    """Whether a frame has that id and shows that exposure (by default the same one)."""
    expected = documented_picture(64, 48, 8, frame_id if shown is None else shown)
    return frame[0] == frame_id and np.array_equal(frame[2], expected)


IN_ANOTHER_PROCESS = """
    import sys, warnings
    warnings.simplefilter("ignore")
    from genicam import gentl
    from harvesters.core import Harvester
    harvester = Harvester()
    harvester.add_file(sys.argv[1])
    harvester.update()
    print([d.access_status for d in harvester.device_info_list], flush=True)
    try:
        acquirer = harvester.create(0)
    except gentl.GenericException as error:
        print(type(error).__name__, flush=True)
        sys.exit(0)
    print("open", flush=True)
    nodes = acquirer.remote_device.node_map
    nodes.TriggerMode.value = "On"
    acquirer.start()
    if len(sys.argv) > 2:
        getattr(nodes, sys.argv[2]).value = 2
        for _ in range(2):
            nodes.TriggerSoftware.execute()
            with acquirer.fetch(timeout=20.0) as buffer:
                print(buffer.module.frame_id, flush=True)
    sys.stdin.read()
"""


def another_process(producer, *fault):
    """A process that opens the first camera and prints what it sees; ends when its input does.

    With a fault's feature it takes two frames, the second of which suffers that fault.
    """
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(IN_ANOTHER_PROCESS), str(producer), *fault],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
