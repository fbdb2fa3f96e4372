"""What the projector window costs under Xvfb, with software OpenGL: a virtual bench's numbers, not a projector's."""

import time

import numpy as np
import psutil
import pytest
from windows import require_display, settings_for

from drivers import SystemClock
from drivers.window import WindowProjector
from sim_backend.xserver import XServer

pytestmark = pytest.mark.bench
SIZE = 1280, 800


@pytest.fixture(scope="module")
def server():
    require_display()
    with XServer(*SIZE) as server:
        yield server


@pytest.fixture
def device(server):
    device = WindowProjector(settings_for(server, refresh_hz=60, timing_flips=200), SystemClock())
    device.open()
    device.configure()
    yield device
    device.close()


def pictures(count):
    return list(np.random.default_rng(0).integers(0, 256, (count, SIZE[1], SIZE[0]), np.uint8))


def test_opening(server):
    begin = time.monotonic()
    device = WindowProjector(settings_for(server, refresh_hz=60), SystemClock())
    device.open()
    opened = time.monotonic()
    device.configure()
    print(f"\nopen {opened - begin:.2f} s, configure {time.monotonic() - opened:.2f} s")
    device.close()
    assert opened - begin < 5.0


def test_flips_per_second(device):
    flip_s = device.describe()["timing"]["flip_s"]
    print(f"\n{1 / flip_s:.0f} flips of {SIZE[0]} × {SIZE[1]} px per second")
    assert flip_s < 1 / 60


@pytest.mark.parametrize("count", [12, 216])
def test_upload(device, count):
    sequence = pictures(count)
    memory = psutil.Process(device.pid).memory_info().rss
    begin = time.monotonic()
    device.load(sequence)
    took = time.monotonic() - begin
    grown = (psutil.Process(device.pid).memory_info().rss - memory) / (count * SIZE[0] * SIZE[1])
    print(f"\n{count} pictures loaded in {took:.2f} s ({took / count * 1e3:.1f} ms each); {grown:.2f} bytes per pixel")
    assert took / count < 0.05
    assert grown < 2


def test_late_flips_of_long_sequences(device):
    sequence = pictures(200)
    device.load(sequence)
    late, gaps = 0, []
    for _ in range(10):
        device.play()
        record = device.finish(30.0)
        late += len(record.late)
        gaps.extend(np.diff(record.shown_s))
    off_ms = np.abs(np.array(gaps) - 1 / 60) * 1e3
    print(
        f"\n{late} of 2000 flips late; intervals off by {np.median(off_ms):.2f} ms (median), {off_ms.max():.2f} (max)"
    )


def test_showing_one_after_the_other(device, server):
    sequence = pictures(12)
    device.load(sequence)
    took = []
    for number in range(120):
        begin = time.monotonic()
        device.show(number % 12)
        took.append(time.monotonic() - begin)
    print(f"\nshow() takes {np.median(took) * 1e3:.1f} ms, 99 % within {np.quantile(took, 0.99) * 1e3:.1f} ms")
    assert np.array_equal(server.channel(), sequence[119 % 12])
    assert np.median(took) < 2 / 60
