"""What the simulated producer sees is what the world shows."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from stock_harvesters import camera, gentl, harvester, next_frame, shoot, software_triggered, wait_for

from sim_backend.gentl import Fault, PictureServer, SimulatedCameraId, installed


class Scene:
    """Gives pictures that nobody else makes, and remembers what it was asked."""

    def __init__(self):
        self.requests = []

    def picture(self, request):
        self.requests.append(request)
        random = np.random.default_rng(request.frame_id)
        kind = np.uint8 if request.bits == 8 else np.uint16
        return random.integers(0, 2**request.bits, (request.height_px, request.width_px), kind)


def seen(frame_id, shape=(48, 64), bits=8):
    return np.random.default_rng(frame_id).integers(0, 2**bits, shape, np.uint8 if bits == 8 else np.uint16)


@pytest.fixture
def world(folder):
    scene, exposures, threads = Scene(), [], threading.active_count()
    with PictureServer(folder / "world", scene, exposures.append) as server:
        server.scene, server.exposures = scene, exposures
        yield server
    assert threading.active_count() == threads
    assert not (folder / "world").exists()


def test_the_camera_sees_the_world(folder, world):
    with camera(folder, SimulatedCameraId("S7", width_px=640, height_px=480), world.path) as acquirer:
        nodes = software_triggered(acquirer, exposure_us=2500.0)
        nodes.PixelFormat.value = "Mono12"
        nodes.Width.value, nodes.Height.value, nodes.OffsetX.value, nodes.OffsetY.value = 320, 200, 24, 6
        nodes.Gain.value, nodes.BlackLevel.value = 6.5, 3.0
        assert world.cameras == ()
        acquirer.start()
        assert world.cameras == ("S7",)
        for number in range(3):
            frame_id, stamp, picture = shoot(acquirer)
            assert frame_id == number
            assert np.array_equal(picture, seen(number, (200, 320), 12))
            request = world.scene.requests[number]
            assert (request.serial, request.frame_id, request.bits) == ("S7", number, 12)
            assert (request.offset_x_px, request.offset_y_px) == (24, 6)
            assert (request.width_px, request.height_px) == (320, 200)
            assert (request.gain_db, request.black_level_dn, request.exposure_s) == (6.5, 3.0, 0.0025)
            assert request.t_begin_s == pytest.approx(stamp / 1e9, abs=1e-9)
            wait_for(lambda expected=number + 1: len(world.exposures) == expected)
            exposure = world.exposures[number]
            assert (exposure.serial, exposure.frame_id) == ("S7", number)
            assert exposure.t_begin_s == request.t_begin_s
            assert exposure.t_end_s - exposure.t_begin_s == pytest.approx(0.0025, abs=1e-9)
        acquirer.stop()
        wait_for(lambda: world.cameras == ())


def test_sixty_edges_a_second_give_sixty_frames_a_second(folder, world):
    fresh = np.random.default_rng(1).integers(0, 256, (768, 1024), np.uint8)
    world.scene.picture = lambda request: fresh
    count, period = 90, 1 / 60
    with camera(folder, SimulatedCameraId(), world.path) as acquirer:
        nodes = software_triggered(acquirer, exposure_us=15_000.0, buffers=count)
        nodes.TriggerSource.value = "Line0"
        acquirer.start()
        begin = time.monotonic() + 0.02

        def shine():
            for number in range(count):
                time.sleep(max(0.0, begin + number * period - time.monotonic()))
                assert world.edge(0, True, begin + number * period) == 1
                world.edge(0, False, begin + number * period + 0.001)

        projector = threading.Thread(target=shine)
        projector.start()
        frames, stream = [], acquirer.data_streams[0]
        while len(frames) < count:
            wait_for(lambda: stream.num_awaiting_delivery)
            frames.append(next_frame(acquirer))
        projector.join()
        assert [frame_id for frame_id, _, _ in frames] == list(range(count))
        stamps = np.array([stamp for _, stamp, _ in frames]) / 1e9
        # An exposure begins at its edge, however late the edge was heard of.
        assert np.allclose(stamps, begin + np.arange(count) * period, atol=1e-6)
        assert all(np.array_equal(picture, fresh) for _, _, picture in frames)
        assert (nodes.SimTriggersIgnored.value, stream.num_underrun) == (0, 0)
        wait_for(lambda: len(world.exposures) == count)


def test_faults_come_from_the_world_too(folder, world):
    with camera(folder, world=world.path) as acquirer:
        nodes = software_triggered(acquirer)
        assert world.inject(Fault.DROP) == 0
        acquirer.start()
        assert world.inject(Fault.REPEAT, 2) == 1
        wait_for(lambda: nodes.SimRepeatIn.value == 2)
        pictures = [shoot(acquirer)[2] for _ in range(3)]
        assert np.array_equal(pictures[0], seen(0))
        assert np.array_equal(pictures[1], seen(0))
        assert np.array_equal(pictures[2], seen(2))
        assert world.inject(Fault.INCOMPLETE, 2, every=True, serial="another") == 0
        assert world.inject(Fault.INCOMPLETE, 2, every=True, serial="SIM0001") == 1
        wait_for(lambda: nodes.SimIncompleteEvery.value == 2)
        whole = []
        for _ in range(4):
            nodes.TriggerSoftware.execute()
            buffer = acquirer.try_fetch(timeout=20.0)
            whole.append(buffer is not None)
            if buffer is not None:
                buffer.queue()
        assert whole == [True, False, True, False]


@pytest.mark.parametrize("fault", Fault)
def test_faults_have_the_same_numbers_everywhere(folder, world, fault):
    with camera(folder, world=world.path) as acquirer:
        nodes = acquirer.remote_device.node_map
        acquirer.start()
        acquirer.remote_device.node_map.AcquisitionStop.execute()
        world.inject(fault, 1000)
        name = "".join(word.capitalize() for word in fault.name.split("_"))
        wait_for(lambda: getattr(nodes, f"Sim{name}In").value > 900)


def test_a_world_without_a_picture_gives_an_incomplete_frame(folder, world, caplog):
    with camera(folder, world=world.path) as acquirer:
        nodes = software_triggered(acquirer)
        acquirer.start()
        answers = [RuntimeError("too dark"), np.zeros((3, 4), np.uint8), np.zeros((48, 64), np.uint16)]

        def picture(request):
            answer = answers.pop(0)
            if isinstance(answer, Exception):
                raise answer
            return answer

        world.scene.picture = picture
        for _ in range(3):
            nodes.TriggerSoftware.execute()
            assert acquirer.try_fetch(timeout=20.0) is None
        assert [str(failure)[:12] for failure in world.failures] == ["too dark", "the source g", "the source g"]
        assert acquirer.data_streams[0].num_delivered == 3
        del world.scene.picture
        assert np.array_equal(shoot(acquirer)[2], seen(3))


def test_a_world_that_ends(folder):
    with PictureServer(folder / "world", Scene()) as server, camera(folder, world=server.path) as acquirer:
        nodes = software_triggered(acquirer)
        acquirer.start()
        shoot(acquirer)
        server.close()
        nodes.TriggerSoftware.execute()
        assert acquirer.try_fetch(timeout=20.0) is None
        acquirer.stop()
        with pytest.raises(gentl.IoException):
            acquirer.start()


def test_stopping_does_not_wait_for_a_slow_world(folder, world):
    asked, release = threading.Event(), threading.Event()

    def picture(request):
        asked.set()
        release.wait(10.0)
        return seen(0)

    world.scene.picture = picture
    with camera(folder, world=world.path) as acquirer:
        software_triggered(acquirer)
        acquirer.start()
        acquirer.remote_device.node_map.TriggerSoftware.execute()
        assert asked.wait(20.0)
        begin = time.monotonic()
        acquirer.stop()
        assert time.monotonic() - begin < 5.0
        release.set()


def test_two_cameras_at_once(folder, world):
    pair = [SimulatedCameraId("L", width_px=64, height_px=48), SimulatedCameraId("R", width_px=128, height_px=96)]
    with installed(folder, pair, world.path) as producer, harvester(producer) as h:
        left, right = (h.create({"serial_number": serial}) for serial in ("L", "R"))
        for acquirer in (left, right):
            nodes = software_triggered(acquirer)
            nodes.TriggerSource.value = "Line0"
            acquirer.start()
        assert world.edge(0, True, time.monotonic()) == 2
        assert np.array_equal(next_frame(left)[2], seen(0, (48, 64)))
        assert np.array_equal(next_frame(right)[2], seen(0, (96, 128)))
        assert world.edge(0, True, time.monotonic(), serial="R") == 1
        assert next_frame(right)[0] == 1
        assert left.try_fetch(timeout=0.05) is None
