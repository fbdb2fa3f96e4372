"""The parts of the GenICam driver that need no camera."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers import DeviceNotFoundError, DeviceSettingError, FrameFormat
from drivers.genicam.camera_time import CameraTime
from drivers.genicam.continuity import Continuity
from drivers.genicam.discovery import ProducerReport, choose
from drivers.genicam.pixels import PIXEL_FORMATS
from drivers.genicam.producers import SEARCH_PATH, DeviceReport, producer_files
from drivers.genicam.ring import FrameRing
from drivers.genicam.settings import GenICamSettings
from drivers.genicam.triggering import FreeRunGate, LineGate, SoftwareGate


def stored(name, values):
    """The bytes of some pixels, written bit by bit as the PFNC (p: lowest bit first) and GigE Vision define them."""
    bits = PIXEL_FORMATS[name].bits
    if name.endswith("p"):
        number = sum(int(v) << (bits * i) for i, v in enumerate(values))
        return number.to_bytes(-(-bits * len(values) // 8), "little")
    if name.endswith("Packed"):
        low = bits - 8
        groups = zip(values[0::2], values[1::2], strict=True)
        return b"".join(
            bytes([int(a) >> low, int(a) % (1 << low) | int(b) % (1 << low) << 4, int(b) >> low]) for a, b in groups
        )
    return b"".join(int(v).to_bytes(1 if bits == 8 else 2, "little") for v in values)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_grey_values_of_every_pixel_format(name):
    pixel_format = PIXEL_FORMATS[name]
    picture = np.random.default_rng(3).integers(0, 1 << pixel_format.bits, (6, 20))
    picture[0, :4] = 0, (1 << pixel_format.bits) - 1, 1, (1 << pixel_format.bits) - 2
    out = np.zeros(picture.shape, FrameFormat(20, 6, pixel_format.bits).dtype)
    raw = stored(name, picture.ravel())
    assert len(raw) == pixel_format.line_bytes(20) * 6
    pixel_format.read(b"abc" + raw, 3, 0, out)
    assert np.array_equal(out, picture)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_trap_14_padded_lines_lose_their_padding(name):
    """harvesters leaves padding in; neither viky nor the simulated producer pads, so the buffer is made here."""
    pixel_format = PIXEL_FORMATS[name]
    picture = np.random.default_rng(4).integers(0, 1 << pixel_format.bits, (5, 12))
    out = np.zeros(picture.shape, FrameFormat(12, 5, pixel_format.bits).dtype)
    for end in (b"", b"\xee\xee\xee"):  # the last line may come without its padding
        raw = b"\xee\xee\xee".join(stored(name, line) for line in picture) + end
        out[:] = 0
        pixel_format.read(raw, 0, 3, out)
        assert np.array_equal(out, picture)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_a_buffer_that_is_too_short_is_no_picture(name):
    pixel_format = PIXEL_FORMATS[name]
    out = np.zeros((4, 8), FrameFormat(8, 4, pixel_format.bits).dtype)
    size = pixel_format.line_bytes(8) * 4
    with pytest.raises(ValueError, match=f"holds {size - 1} bytes, the picture {size}"):
        pixel_format.read(bytes(size - 1), 0, 0, out)


def test_the_codes_of_the_pixel_formats_are_those_of_the_standard():
    pfnc = pytest.importorskip("harvesters.util.pfnc")
    assert {f.code: f.name for f in PIXEL_FORMATS.values()}.items() <= pfnc.dict_by_ints.items()


def test_widths_that_leave_half_a_group_are_refused():
    with pytest.raises(ValueError, match="4 pixels together"):
        PIXEL_FORMATS["Mono10p"].line_bytes(1022)


def judged(*frames):
    """What is said of a run of (number, time stamp) or numbers."""
    continuity = Continuity()
    pairs = [f if isinstance(f, tuple) else (f, None) for f in frames]
    return [continuity.judge(*pair) for pair in pairs]


@given(st.integers(0, 1 << 62), st.integers(2, 30))
def test_numbers_that_follow_one_another_are_no_loss(first, count):
    assert judged(*range(first, first + count)) == [(0, None)] * count


def test_gaps_are_counted_and_named():
    assert judged(7, 8, 10)[-1] == (1, "frame 9 did not arrive (1 missing)")
    assert judged(7, 11)[-1] == (3, "frames 8 to 10 did not arrive (3 missing)")
    assert judged(7, 11, 12)[-1] == (0, None)


def test_frames_that_come_twice_or_out_of_order_are_named():
    assert judged(7, 7)[-1] == (0, "frame 7 came twice")
    assert judged(7, 6)[-1] == (0, "frame 6 came after frame 7")


def test_counters_of_16_bits_go_round_without_a_loss():
    # GigE Vision 1.x counts from 1 to 65535 and begins again with 1.
    assert judged(65534, 65535, 1, 2) == [(0, None)] * 4
    assert judged(65535, 0) == [(0, None)] * 2
    assert judged(65534, 1)[-1][0] == 1
    assert judged(65535, 65536)[-1] == (0, None)


def test_incomplete_frames_are_not_counted_as_lost_again():
    continuity = Continuity()
    continuity.judge(1, None)
    continuity.excuse()
    assert continuity.judge(3, None) == (0, None)
    continuity.excuse()
    assert continuity.judge(6, None) == (1, "frames 4 to 5 did not arrive (2 missing, 1 of them incomplete)")


def test_time_stamps_must_go_forward_where_there_are_any():
    assert judged((1, 100), (2, 200), (3, None), (4, 50), (5, 60)) == [(0, None)] * 5
    assert "time stamp" in judged((1, 100), (2, 100))[-1][1]
    assert "time stamp" in judged((1, 100), (2, 99))[-1][1]


def test_frames_without_numbers_are_not_judged():
    assert judged(None, None, None) == [(0, None)] * 3


def test_a_software_trigger_waits_for_the_frame_of_the_one_before():
    gate = SoftwareGate()
    assert not gate.open
    assert not gate.fire()
    gate.request()
    gate.request()
    assert [gate.fire(), gate.fire(), gate.open] == [True, False, True]
    assert gate.arrive()
    assert [gate.open, gate.fire(), gate.fire()] == [False, True, False]
    assert gate.arrive()
    assert not gate.arrive()
    assert not gate.fire()


def test_a_frame_of_a_free_running_camera_is_the_first_that_began_later():
    gate = FreeRunGate(2)
    assert [gate.arrive() for _ in range(3)] == [False] * 3
    gate.request()
    assert [gate.arrive() for _ in range(5)] == [False, False, True, False, False]
    gate.request()
    gate.request()
    assert [gate.arrive() for _ in range(5)] == [False, False, True, True, False]


def test_a_camera_on_a_line_takes_no_software_trigger():
    gate = LineGate("camera 7")
    assert gate.open
    assert gate.arrive()
    with pytest.raises(DeviceSettingError, match="camera 7 is triggered by an edge"):
        gate.request()


def test_only_a_frame_of_the_same_clock_can_be_too_old():
    second = 1_000_000_000
    assert CameraTime.is_before(5 * second, 6 * second)
    assert not CameraTime.is_before(6 * second, 6 * second)
    assert not CameraTime.is_before(7 * second, 6 * second)
    assert not CameraTime.is_before(5 * second, 5000 * second)
    assert not CameraTime.is_before(None, second)
    assert not CameraTime.is_before(second, None)


def test_two_rings_of_one_name_are_one_memory_and_leave_none(tmp_path):
    made = FrameRing(FrameFormat(5, 3, 12), 4)
    shared = FrameRing(FrameFormat(5, 3, 12), 4, made.name)
    made.forget_name()
    with pytest.raises(FileNotFoundError):
        FrameRing(FrameFormat(5, 3, 12), 4, made.name)
    for slot in range(4):
        shared[slot][...] = 1000 + slot
    assert [int(made[slot].max()) for slot in range(4)] == [1000, 1001, 1002, 1003]
    assert made[0].shape == (3, 5)
    assert made[0].dtype == np.uint16
    made.close()
    assert int(shared[3][2, 4]) == 1003
    shared.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux says how much shared memory there is")
def test_a_ring_that_has_no_room_is_refused_before_it_is_touched():
    with pytest.raises(DeviceSettingError, match=r"MB of shared memory, /dev/shm has") as caught:
        FrameRing(FrameFormat(100_000, 100_000, 16), 512)
    assert "ring_frames" in caught.value.remedy


def device(serial, model="A", user_name="", producer="one.cti"):
    return DeviceReport(producer, serial, "Vendor", model, serial, user_name, "free")


def test_a_camera_is_chosen_by_what_the_file_names(tmp_path):
    one, two = tmp_path / "one.cti", tmp_path / "two.cti"
    devices = (device("1", producer=one), device("2", "B", "left", one), device("3", "B", "right", one))
    reports = [ProducerReport(one, None, devices), ProducerReport(two, "its process was ended by SIGSEGV", ())]

    def chosen(**keys):
        return choose(reports, GenICamSettings(**keys)).serial

    assert chosen(serial="2") == "2"
    assert chosen(serial=3) == "3"
    assert chosen(model="A") == "1"
    assert chosen(model="B", user_name="right") == "3"
    for keys, words in (
        ({}, "3 cameras are meant; the bench file names none"),
        ({"model": "B"}, "2 cameras are meant by model 'B'"),
        ({"serial": "9"}, "no camera has serial '9'"),
        ({"model": "A", "user_name": "left"}, "no camera has model 'A' and user_name 'left'"),
    ):
        with pytest.raises(DeviceNotFoundError, match=words) as caught:
            chosen(**keys)
        message = caught.value.message
        assert all(f"serial {n}" in message for n in "123")
        assert "user name 'left'" in message
        assert "one.cti" in message
        assert "two.cti: its process was ended by SIGSEGV" in message
    with pytest.raises(DeviceNotFoundError, match="no GenTL producer was found") as caught:
        choose([], GenICamSettings())
    assert ".cti" in caught.value.remedy


def test_trap_16_producers_are_found_where_vendors_leave_them(tmp_path, monkeypatch):
    """A universal producer is not to be had: each vendor's own is found through its environment variable."""
    for name in ("a/one.cti", "a/two.cti", "a/readme.txt", "b/three.cti"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "b/again.cti").symlink_to(tmp_path / "a/one.cti")
    entries = [tmp_path / "a", tmp_path / "nowhere", tmp_path / "b/three.cti", tmp_path / "b/again.cti"]
    monkeypatch.setenv(SEARCH_PATH, ":".join(map(str, entries)))
    assert sorted(p.resolve().name for p in producer_files(None)) == ["one.cti", "three.cti", "two.cti"]
    assert producer_files([tmp_path / "x.cti"]) == [tmp_path / "x.cti"]
    monkeypatch.delenv(SEARCH_PATH)
    assert producer_files(None) == []


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"buffers": 15}, "greater than or equal to 16"),
        ({"exposure_us": 0}, "greater than 0"),
        ({"pixel_format": "RGB8"}, "Mono8"),
        ({"features": {"ExposureTime": 5}}, "ExposureTime has a setting of its own: exposure_us"),
        ({"features": {"TriggerSource": "Line1"}}, "TriggerSource has a setting of its own: trigger"),
        ({"features": {"Gamma": [1]}}, "features"),
        ({"shutter": 3}, "Extra inputs"),
        ({"trigger": "hardware"}, "software"),
    ],
)
def test_settings_refuse_what_cannot_be_meant(values, words):
    with pytest.raises(ValidationError, match=words):
        GenICamSettings(**values)


def test_settings_take_one_producer_or_many_and_keep_the_order_of_features(tmp_path):
    assert GenICamSettings(producer="/a.cti").producer == GenICamSettings(producer=["/a.cti"]).producer
    assert len(GenICamSettings(producer=["/a.cti", "/b.cti"]).producer) == 2
    features = {"B": 1, "A": True, "C": "x", "D": 2.5}
    kept = GenICamSettings(features=features).features
    assert list(kept.items()) == list(features.items())
    assert kept["A"] is True


def test_the_driver_is_imported_without_the_vendors_libraries():
    code = (
        "import sys, drivers.genicam, drivers.genicam.discovery, drivers.genicam.server;"
        "print(sorted({'harvesters', 'genicam', 'cv2', 'open3d'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
