"""The emulated LightCrafters: decoder against bytes written by hand, time, and what the chips refuse."""

import numpy as np
import pytest
import usb.core

from sim_backend.clock import VirtualClock
from sim_backend.lightcrafter import EmulatedDlpc350, EmulatedDlpc900, EmulatedUsb, SimulatedScreen, VideoSource
from sim_backend.lightcrafter.decoder import BadImageError, decode
from sim_backend.lightcrafter.sequencer import Run, Sequencer, Step

SIZE = (8, 4)
WHITE = np.full(SIZE[::-1], 255, np.uint8)


def header(width, height, size, compression):
    return b"".join(
        (b"Spld", width.to_bytes(2, "little"), height.to_bytes(2, "little"), size.to_bytes(4, "little"), b"\xff" * 8)
    ) + bytes((0, 0, 0, 0, 0, compression, 1)) + bytes(21)  # fmt: skip


@pytest.mark.parametrize(
    ("compression", "body"),
    [
        (0, "000001 000001 000002 000003 800000 000001"),
        (1, "02 000001 01 000002 0000 0000 01 000003 01 800000 01 000001 0000 0000 0001"),
        (1, "0003 000001 000001 000002 0000 000000 01 000003 01 800000 01 000001 0000 0000 0001"),
        (2, "02 000001 01 000002 0000 0003 000003 800000 000001 0000 000100"),
        (2, "02 000001 01 000002 0002 000003 800000 01 000001 000100"),  # without ends of lines
    ],
)
def test_images_are_read_as_the_manual_writes_them(compression, body):
    data = bytes.fromhex(body)
    data += bytes(-len(data) % 4)
    image = decode(header(3, 2, len(data), compression) + data)
    assert image.tolist() == [[1, 1, 2], [3, 0x800000, 1]]


def test_a_copy_takes_the_line_above_and_long_counts_two_bytes():
    data = bytes.fromhex("88 01 0a0b0c 01 000001 0000 0001 8901 000100".replace(" ", ""))
    data += bytes(-len(data) % 4)
    image = decode(header(137, 2, len(data), 2) + data)  # 0x88 & 0x7f | 1 << 7 = 136
    assert (image[:, :136] == 0x0A0B0C).all()
    assert image[:, 136].tolist() == [1, 1]
    with pytest.raises(BadImageError, match="nothing above"):
        decode(header(3, 1, 8, 2) + bytes.fromhex("0001 03 0000 000100"))


def test_steps_come_and_go_on_the_clock():
    edges = []
    sequencer = Sequencer(0 * WHITE, lambda *edge: edges.append(edge))
    pictures = [WHITE // 3, WHITE // 2]
    steps = [Step(lambda _, n=n: pictures[n], 0.010, 0.005, True, n == 0) for n in range(2)]
    sequencer.begin(Run(1.0, steps, 3))
    sequencer.tell(2.0)
    assert edges == [
        (1, True, 1.0), (2, True, 1.0), (2, False, pytest.approx(1.00002)), (1, False, pytest.approx(1.010)),
        (1, True, pytest.approx(1.015)), (1, False, pytest.approx(1.025)),
        (1, True, pytest.approx(1.030)), (2, True, pytest.approx(1.030)),
        (2, False, pytest.approx(1.03002)), (1, False, pytest.approx(1.040)),
    ]  # fmt: skip
    seen = [sequencer.surface(moment)[0, 0] for moment in (0.999, 1.001, 1.012, 1.016, 1.031, 1.044)]
    assert seen == [0, 85, 0, 127, 85, 0]
    assert sequencer.running(1.0449)
    assert not sequencer.running(1.0451)


def test_what_is_stopped_stays_on_the_mirrors_until_the_light_goes_out():
    sequencer = Sequencer(0 * WHITE, lambda *edge: None)
    sequencer.begin(Run(0.0, [Step(lambda _: WHITE, 0.01, 0.0, True, True)], 0))
    sequencer.stop(0.5)
    assert sequencer.surface(9.0).all()
    sequencer.light(5.0, False)
    assert sequencer.surface(4.9).all()
    assert not sequencer.surface(5.1).any()


def test_a_round_that_is_too_long_misses_every_other_refresh():
    source = VideoSource(SIZE, 50.0, VirtualClock())
    fits = Run(0.02, [Step(lambda _: WHITE, 0.02, 0.0, True, True)], 0, source)
    assert [fits.step_begin(n) for n in range(3)] == pytest.approx([0.02, 0.04, 0.06])
    late = Run(0.02, [Step(lambda _: WHITE, 0.0201, 0.0, True, True)], 0, source)
    assert [late.step_begin(n) for n in range(3)] == pytest.approx([0.02, 0.06, 0.10])


def test_the_screen_sends_from_the_next_refresh_on():
    clock = VirtualClock()
    source = VideoSource(SIZE, 50.0, clock)
    screen = SimulatedScreen(source, clock)
    screen.open()
    assert not source.locked(clock.now())
    clock.sleep(0.205)
    assert source.locked(clock.now())
    screen.configure()
    screen.load([WHITE, WHITE // 2])
    screen.play()
    record = screen.finish(1.0)
    assert record.shown_s == pytest.approx((0.22, 0.24))
    assert [source.frame(number)[0, 0].tolist() for number in (10, 11, 12, 13)] == [
        [0, 0, 0], [255, 255, 255], [127, 127, 127], [127, 127, 127],
    ]  # fmt: skip
    source.connect(False)
    assert not source.locked(clock.now() + 1.0)


@pytest.fixture
def dlpc900():
    return talking(EmulatedDlpc900(VirtualClock(), SIZE))


def talking(device):
    usb_device = usb.core.find(backend=EmulatedUsb(device), idVendor=0x0451)
    usb_device.detach_kernel_driver(0)

    def write(command, data=""):
        """Send a write command; gives the error code of a refusal, 0 where it was taken."""
        body = command.to_bytes(2, "little") + bytes.fromhex(data)
        stream = bytes((0x40, 1)) + len(body).to_bytes(2, "little") + body
        for at in range(0, len(stream), 64):
            usb_device.write(0x01, stream[at : at + 64])
        device._clock.sleep(0.02)
        return device._error if usb_device.read(0x81, 64)[0] & 0x20 else 0

    write.device, write.usb = device, usb_device
    return write


LINE_0 = "0000 C80000 11 000000 00 0000"
LINE_1 = "0100 900100 23 000000 00 0008"


def test_the_dlpc900_takes_the_manual_s_example(dlpc900):
    assert dlpc900(0x1A24, "00") == 0
    assert dlpc900(0x1A1B, "03") == 0
    assert dlpc900(0x1A24, "00") == 0
    assert dlpc900(0x1A34, LINE_0) == 0
    assert dlpc900(0x1A34, LINE_1) == 0
    assert dlpc900(0x1A31, "0200 00000000") == 0
    assert dlpc900(0x1A24, "02") == 11  # no image yet
    image = header(8, 4, 8, 2) + bytes.fromhex("20 000003 0001 00 00")  # 32 pixels on planes 0 and 1
    assert dlpc900(0x1A2A, "0000" + len(image).to_bytes(4, "little").hex()) == 0
    assert dlpc900(0x1A2B, len(image).to_bytes(2, "little").hex() + image.hex()) == 0
    assert dlpc900(0x1A24, "02") == 0
    begun = dlpc900.device._clock.now() - 0.02
    # Plane 0 for 200 µs, planes 1 and 2 for 400 µs: 255 and 85 of 255.
    seen = [dlpc900.device.surface(begun + at * 1e-6)[0, 0] for at in (100, 300, 500, 700, 1100)]
    assert seen == [255, 85, 85, 255, 85]


@pytest.mark.parametrize(
    ("commands", "code"),
    [
        ([(0x1A1B, "03")], 5),  # the splash pattern runs
        ([(0x1A24, "00"), (0x1A1B, "04")], 6),
        ([(0x1A24, "00"), (0x1A1B, "02")], 5),  # not from here, and no video
        ([(0x1A24, "00"), (0x1A1B, "00"), (0x1A34, LINE_0)], 5),
        ([(0x1A24, "00"), (0x1A1B, "00"), (0x1A24, "02")], 5),
        ([(0x1A24, "00"), (0x1A34, "0000 680000 11 000000 00 0000")], 14),  # 104 µs
        ([(0x1A24, "00"), (0x1A34, "0000 CD0F00 1F 000000 00 0000")], 14),  # 4045 µs for 8 bits
        ([(0x1A24, "00"), (0x1A34, "0000 400000 1F 000000 00 0088")], 14),
        ([(0x1A24, "00"), (0x1A34, "0000 409C00 1F 000000 00 0088")], 10),  # 8 bits from plane 17 on
        ([(0x1A24, "00"), (0x1A34, "9001 C80000 11 000000 00 0000")], 15),  # line 400
        ([(0x1A24, "00"), (0x1A34, LINE_0), (0x1A24, "02")], 5),  # not configured
        ([(0x1A24, "00"), (0x1A34, LINE_0), (0x1A31, "0200 00000000")], 7),
        ([(0x1A24, "00"), (0x1A34, LINE_0), (0x1A31, "0000 00000000")], 6),
        ([(0x1A24, "00"), (0x1A34, LINE_0), (0x1A31, "0100 00000000"), (0x1A32, "0100 00000000 0100")], 15),
        ([(0x1A2A, "0000 00010000")], 5),  # not on the fly
        ([(0x1A1D, "00 EBFF 0000")], 13),  # -21 µs
        ([(0x7777, "")], 3),
        ([(0x1008, "0000")], 6),
    ],
)
def test_the_dlpc900_refuses(dlpc900, commands, code):
    *before, (command, data) = commands
    assert [dlpc900(*each) for each in before] == [0] * len(before)
    assert dlpc900(command, data) == code


def test_pictures_of_more_planes_than_its_memory_has_are_refused(dlpc900):
    dlpc900(0x1A24, "00")
    dlpc900(0x1A1B, "03")
    dlpc900(0x1A24, "00")
    for index in range(51):
        place = (index // 3 | index % 3 * 8 << 11).to_bytes(2, "little").hex()
        assert dlpc900(0x1A34, index.to_bytes(2, "little").hex() + "409C00 1F 000000 00" + place) == 0
    assert dlpc900(0x1A31, "3200 00000000") == 0
    assert dlpc900(0x1A31, "3300 00000000") == 8


def test_the_dlpc350_starts_what_was_validated_and_at_the_second_try():
    image = np.full(SIZE[::-1], 200 << 8, np.uint32)
    write = talking(EmulatedDlpc350(VirtualClock(), SIZE, flash=[image]))

    def running():
        return write.device._running

    assert write(0x1A24, "02") == 5  # video mode
    assert write(0x1A1B, "01") == 0
    for command, data in (
        (0x1A22, "03"), (0x1A31, "00 01 00 00"), (0x1A23, "01"), (0x1A29, "10270000 10270000"),
        (0x1A33, "02"), (0x1A32, "00"), (0x1A34, "04 28 04"), (0x1A33, "00"),
    ):  # fmt: skip
        assert write(command, data) == 0
    write(0x1A24, "02")
    assert not running()
    write(0x1A1A, "00")
    write.device._clock.sleep(0.1)
    write.usb.write(0x01, bytes((0xC0, 2, 2, 0, 0x1A, 0x1A)))
    assert write.usb.read(0x81, 64)[4] == 0
    write.device._clock.sleep(0.02)
    write(0x1A24, "02")
    assert not running()
    write(0x1A24, "02")
    assert running()
    assert (write.device.surface() == 200).all()
    assert write(0x1A29, "10270000 10270000") == 5  # while it runs


@pytest.mark.parametrize(("timing", "found"), [("8C200000 8C200000", 1), ("8D200000 8D200000", 0),
                                               ("8D200000 72210000", 17), ("8D200000 73210000", 0)])  # fmt: skip
def test_the_dlpc350_s_validation(timing, found):
    write = talking(EmulatedDlpc350(VirtualClock(), SIZE))
    for command, data in ((0x1A1B, "01"), (0x1A31, "00 01 00 00"), (0x1A29, timing), (0x1A33, "02"), (0x1A32, "00"),
                          (0x1A34, "01 28 00"), (0x1A33, "00"), (0x1A1A, "00")):  # fmt: skip
        assert write(command, data) == 0
    write.usb.write(0x01, bytes((0xC0, 2, 2, 0, 0x1A, 0x1A)))
    assert write.usb.read(0x81, 64)[4] == 0x80
    write.device._clock.sleep(0.1)
    write.usb.write(0x01, bytes((0xC0, 2, 2, 0, 0x1A, 0x1A)))
    assert write.usb.read(0x81, 64)[4] == found
