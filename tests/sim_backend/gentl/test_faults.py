"""Each fault of the simulated producer is what its name says, pixel by pixel, and nothing more."""

from __future__ import annotations

import signal
import subprocess
import time

import numpy as np
import pytest
from stock_harvesters import (
    SMALL,
    another_process,
    camera,
    documented_picture,
    good,
    next_frame,
    shoot,
    software_triggered,
    wait_for,
)

from sim_backend.gentl import installed


@pytest.fixture
def armed(folder):
    with camera(folder) as acquirer:
        software_triggered(acquirer)
        acquirer.start()
        shoot(acquirer)  # frame 0 is a good one
        yield acquirer, acquirer.remote_device.node_map


def test_drop(armed):
    acquirer, nodes = armed
    nodes.SimDropIn.value = 2
    assert good(shoot(acquirer), 1)
    nodes.TriggerSoftware.execute()
    assert acquirer.try_fetch(timeout=0.05) is None
    wait_for(lambda: nodes.SimDropIn.value == 0)
    assert good(shoot(acquirer), 3)


def test_every_nth(armed):
    acquirer, nodes = armed
    nodes.SimDropEvery.value = 3
    came = []
    for number in range(1, 10):
        nodes.TriggerSoftware.execute()
        buffer = acquirer.try_fetch(timeout=20.0 if number % 3 else 0.05)
        if buffer is not None:
            with buffer:
                came.append(buffer.module.frame_id)
    assert came == [1, 2, 4, 5, 7, 8]


def test_missed_trigger(armed):
    acquirer, nodes = armed
    nodes.SimMissTriggerIn.value = 1
    nodes.TriggerSoftware.execute()
    assert acquirer.try_fetch(timeout=0.05) is None
    assert good(shoot(acquirer), 1)


def test_incomplete(armed):
    acquirer, nodes = armed
    nodes.SimIncompleteIn.value = 1
    nodes.TriggerSoftware.execute()
    assert acquirer.try_fetch(timeout=20.0) is None
    assert acquirer.data_streams[0].num_delivered == 2
    assert good(shoot(acquirer), 2)


def test_truncated(armed):
    acquirer, nodes = armed
    nodes.SimTruncateIn.value = 1
    nodes.TriggerSoftware.execute()
    with acquirer.fetch(timeout=20.0) as buffer:
        assert (buffer.module.size_filled, buffer.module.height) == (64 * 48 // 2, 48)


def test_wrong_size(armed):
    acquirer, nodes = armed
    nodes.SimWrongSizeIn.value = 1
    _, _, picture = shoot(acquirer)
    assert picture.shape == (24, 64)
    assert np.array_equal(picture, documented_picture(64, 24, 8, 1))


def test_late(armed):
    acquirer, nodes = armed
    nodes.SimLateBy.value = 150_000
    nodes.SimLateIn.value = 1
    before = time.monotonic_ns()
    nodes.TriggerSoftware.execute()
    after = time.monotonic_ns()
    frame = next_frame(acquirer)
    assert good(frame, 1)
    assert time.monotonic_ns() - before >= 150_000_000
    assert before <= frame[1] <= after  # the exposure itself was in time


def test_duplicate(armed):
    acquirer, nodes = armed
    nodes.SimDuplicateIn.value = 1
    first, second = shoot(acquirer), next_frame(acquirer)
    assert good(first, 1)
    assert good(second, 1)
    assert first[1] == second[1]
    assert good(shoot(acquirer), 2)


def test_repeated_pixels(armed):
    acquirer, nodes = armed
    nodes.SimRepeatIn.value = 2
    frames = [shoot(acquirer) for _ in range(3)]
    assert good(frames[0], 1)
    assert good(frames[1], 2, shown=1)
    assert frames[1][1] > frames[0][1]
    assert good(frames[2], 3)


def test_torn(armed):
    acquirer, nodes = armed
    nodes.SimTearIn.value = 1
    frame_id, _, picture = shoot(acquirer)
    assert frame_id == 1
    assert np.array_equal(picture[:24], documented_picture(64, 48, 8, 1)[:24])
    assert np.array_equal(picture[24:], documented_picture(64, 48, 8, 0)[24:])


def test_id_jump(armed):
    acquirer, nodes = armed
    nodes.SimIdJumpBy.value = 1000
    nodes.SimIdJumpIn.value = 2
    assert good(shoot(acquirer), 1)
    assert good(shoot(acquirer), 1002, shown=2)
    assert good(shoot(acquirer), 1003, shown=3)


def test_stale(armed):
    acquirer, nodes = armed
    former = shoot(acquirer)
    acquirer.stop()
    nodes.SimStaleIn.value = 1
    acquirer.start()
    stale = next_frame(acquirer)
    assert good(stale, 0, shown=1)
    assert stale[1] == former[1]
    assert good(shoot(acquirer), 1)


def test_crash(folder):
    with installed(folder, [SMALL]) as producer, another_process(producer, "SimCrashIn") as other:
        output, _ = other.communicate(timeout=30)
        assert output.split("\n") == ["[1]", "open", "0", ""]
        assert other.returncode == -signal.SIGSEGV


def test_hang(folder):
    with installed(folder, [SMALL]) as producer, another_process(producer, "SimHangIn") as other:
        assert [other.stdout.readline().strip() for _ in range(3)] == ["[1]", "open", "0"]
        with pytest.raises(subprocess.TimeoutExpired):
            other.communicate(timeout=1.0)
        other.kill()
