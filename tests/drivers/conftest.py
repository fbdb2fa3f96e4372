"""Simulated cameras that tests of the GenICam driver can trigger, disturb and unplug."""

import time

import numpy as np
import pytest
from cameras import NumberedPictures, plugged_in, running, simulated, wait_for

from drivers import DeviceState


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Who gives the cameras A, B and C of a file pictures, edges and faults."""
    from sim_backend.gentl.feed import PictureServer

    folder = tmp_path_factory.mktemp("world")
    with (
        PictureServer(folder / "world", NumberedPictures()) as server,
        plugged_in(folder, ";".join(f"{serial}::MFS Sim:64x48" for serial in "ABC"), folder / "world"),
    ):
        yield server


@pytest.fixture(scope="module")
def standing(world):
    """Camera A for many tests, since opening takes longest."""
    camera = simulated(
        serial="A",
        pixel_format="Mono12",
        features={"SimLateBy": 400_000, "SimReturnAfter": 200, "SimIdJumpBy": 3},
    )
    yield camera
    camera.close()


@pytest.fixture
def ready(standing, world):
    """Camera A, triggered by software, a place for its frames, and its world."""
    if standing.state is DeviceState.FAULT:
        standing.close()
    if standing.state is DeviceState.CLOSED:
        standing.open()
        standing.configure()
    if standing.state is DeviceState.RUNNING:
        standing.stop()
    standing.arm()
    standing.start()
    wait_for(lambda: "A" in world.cameras)
    return standing, np.empty((48, 64), np.uint16), world


@pytest.fixture(scope="module")
def burst(world):
    """Camera B, on a line and with little room; ``give(n)`` gives n edges and waits until all were exposed."""
    with running(simulated(serial="B", trigger="line", exposure_us=100.0, ring_frames=4, buffers=16)) as (camera, out):

        def give(number):
            for _ in range(number):
                world.edge(0, True, time.monotonic(), "B")
                time.sleep(0.005)
                world.edge(0, False, time.monotonic(), "B")

        yield camera, out, give


@pytest.fixture
def streaming(burst, world):
    """The same, with nothing left of an earlier test."""
    camera, out, give = burst
    camera.stop()
    wait_for(lambda: "B" not in world.cameras)
    camera.arm()
    camera.start()
    wait_for(lambda: "B" in world.cameras)
    return camera, out, give
