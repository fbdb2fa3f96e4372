"""How a camera is set, on the node maps of viky and of the simulated producer: harvesters is loaded right here."""

import json
from contextlib import contextmanager

import pytest
from cameras import plugged_in, viky

from drivers import DeviceSettingError, FrameFormat
from drivers.genicam import GenICamSettings
from drivers.genicam.camera_time import CameraTime
from drivers.genicam.configuration import set_up
from drivers.genicam.features import Features
from drivers.genicam.library import kept_interrupt_handler
from drivers.genicam.producers import load


@contextmanager
def opened(producer, serial):
    harvester, devices = load(producer)
    try:
        with kept_interrupt_handler():
            acquirer = harvester.create([d.serial for d in devices].index(serial))
        yield Features("camera", acquirer.remote_device.node_map)
    finally:
        harvester.reset()


@pytest.fixture(scope="module")
def producer(tmp_path_factory):
    """Two simulated cameras, a modern one and one that knows the names of SFNC 1 only."""
    with plugged_in(tmp_path_factory.mktemp("plugs"), "M::MFS Sim:640x480;L::MFS Sim Legacy:64x48") as path:
        yield path


@pytest.fixture
def modern(producer):
    with opened(producer, "M") as features:
        yield features


@pytest.fixture
def legacy(producer):
    with opened(producer, "L") as features:
        yield features


@pytest.fixture
def ball_game():
    """viky's camera: no trigger, no exposure, sizes of 100 to 800 px, 1 to 200 Hz in steps of 1."""
    with opened(viky(), "0") as features:
        yield features


def test_a_modern_camera_is_set_by_the_names_of_today(modern):
    frame_format = set_up(modern, GenICamSettings(exposure_us=1234.5, gain_db=6.0, pixel_format="Mono12p"))
    assert frame_format == FrameFormat(640, 480, 12)
    values = modern.snapshot()
    expected = {
        "ExposureTime": 1234.5,
        "ExposureAuto": "Off",
        "Gain": 6.0,
        "GainAuto": "Off",
        "PixelFormat": "Mono12p",
        "TriggerSelector": "FrameStart",
        "TriggerMode": "On",
        "TriggerSource": "Software",
        "AcquisitionMode": "Continuous",
    }
    assert {name: values[name] for name in expected} == expected
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert modern.rounded == {}


def test_an_old_camera_is_set_by_its_own_names(legacy):
    set_up(legacy, GenICamSettings(exposure_us=777.0, gain_raw=35, trigger="line", trigger_line="Line1"))
    values = legacy.snapshot()
    assert values["ExposureTimeAbs"] == 777.0
    assert values["GainRaw"] == 35
    assert "ExposureTime" not in values
    assert (values["TriggerSource"], values["TriggerActivation"]) == ("Line1", "RisingEdge")
    with pytest.raises(DeviceSettingError, match="camera has no feature Gain; near: GainRaw"):
        set_up(legacy, GenICamSettings(gain_db=3.0))


def test_what_an_earlier_program_left_is_undone(modern):
    for name, value in (
        ("ExposureAuto", "Continuous"),
        ("GainAuto", "Continuous"),
        ("AcquisitionMode", "SingleFrame"),
        ("Width", 64),
        ("OffsetX", 560),
        ("TriggerSelector", "AcquisitionStart"),
        ("TriggerMode", "On"),
    ):
        modern.write(name, value)
    assert set_up(modern, GenICamSettings(exposure_us=500.0)) == FrameFormat(640, 480, 8)
    assert modern.read("AcquisitionMode") == "Continuous"
    assert modern.read("TriggerMode") == "On"
    modern.write("TriggerSelector", "AcquisitionStart")
    assert modern.read("TriggerMode") == "Off"


def test_an_automatic_that_the_file_names_is_left_to_it(modern):
    set_up(modern, GenICamSettings(features={"GainAuto": "Continuous"}))
    assert modern.read("GainAuto") == "Continuous"


def test_a_window_of_the_sensor_is_read_out(modern):
    settings = GenICamSettings(width_px=320, height_px=100, offset_px=(312, 380))
    for _ in range(2):  # from the whole sensor, and from the window itself
        assert set_up(modern, settings) == FrameFormat(320, 100, 8)
        assert (modern.read("OffsetX"), modern.read("OffsetY")) == (312, 380)


def test_a_free_running_camera_has_all_its_triggers_off(modern):
    set_up(modern, GenICamSettings())
    set_up(modern, GenICamSettings(trigger="free_run"))
    assert modern.read("TriggerMode") == "Off"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"width_px": 642}, r"Width cannot be 642: the camera takes 16 … 640 px in steps of 8"),
        ({"width_px": 325}, r"Width cannot be 325: .*the camera takes 16 … 640 px in steps of 8"),
        ({"offset_px": (8, 0)}, r"OffsetX cannot be 8: the camera takes 0 … 0 px"),
        ({"exposure_us": 3.0}, r"ExposureTime cannot be 3\.0: the camera takes 10 … 10000000 us"),
        ({"gain_db": 30.0}, r"Gain cannot be 30\.0: the camera takes 0 … 24 dB"),
        ({"gain_raw": 3}, r"camera has no feature GainRaw; near: Gain"),
        ({"trigger": "line", "trigger_line": "Line7"}, r"TriggerSource cannot be Line7: the camera takes Software, Li"),
        ({"trigger": "line", "trigger_activation": "AnyEdge"}, r"TriggerActivation cannot be AnyEdge: .*FallingEdge"),
        ({"user_set": "Default"}, r"camera has no feature UserSetSelector"),
        ({"pixel_format": "Mono10Packed"}, r"PixelFormat cannot be Mono10Packed: the camera takes Mono8, Mono10"),
        ({"features": {"BlackLevle": 3}}, r"camera has no feature BlackLevle; near: BlackLevel"),
        ({"features": {"BlackLevel": "dark"}}, r"BlackLevel cannot be dark: the camera takes 0 … 255 DN"),
        ({"features": {"BlackLevel": True}}, r"BlackLevel cannot be True: the camera takes 0 … 255 DN"),
        ({"features": {"SensorWidth": 3}}, r"SensorWidth cannot be set: it is read only.*\(it is 640\)"),
        ({"features": {"LineSelector": "Line0", "LineSource": "ExposureActive"}}, r"LineSource cannot be set: it is r"),
        ({"features": {"AcquisitionFrameRateEnable": 1}}, r"AcquisitionFrameRateEnable cannot be 1: .*true or false"),
        ({"features": {"TimestampLatch": 1}}, r"TimestampLatch cannot be 1: it is a command"),
        ({"features": {"DeviceUserID": 5}}, r"DeviceUserID cannot be 5: the camera takes a text"),
        ({"features": {"Width_Val": 5}}, r"camera has no feature Width_Val"),
        ({"features": {"ImageFormatControl": 5}}, r"ImageFormatControl cannot be"),
    ],
)
def test_a_refusal_quotes_the_cameras_own_limits(modern, values, words):
    with pytest.raises(DeviceSettingError, match=words) as caught:
        set_up(modern, GenICamSettings(**values))
    assert caught.value.remedy


def test_features_are_set_in_the_order_of_the_file(modern):
    features = {
        "LineSelector": "Line2",
        "LineSource": "ExposureActive",
        "DeviceUserID": "left eye",
        "AcquisitionFrameRateEnable": True,
        "AcquisitionFrameRate": 12,
        "TimestampLatch": True,
    }
    set_up(modern, GenICamSettings(features=features))
    values = modern.snapshot()
    assert values["LineSource"] == "ExposureActive"
    assert values["DeviceUserID"] == "left eye"
    assert values["AcquisitionFrameRate"] == 12.0
    assert values["TimestampLatchValue"] > 0


def test_what_the_camera_rounds_within_its_steps_is_reported(ball_game):
    settings = GenICamSettings(trigger="free_run", features={"AcquisitionFrameRate": 33.7})
    assert set_up(ball_game, settings) == FrameFormat(800, 800, 8)
    made = ball_game.read("AcquisitionFrameRate")
    assert made in (33.0, 34.0)
    assert ball_game.rounded == {"AcquisitionFrameRate": (33.7, made)}


def test_a_camera_without_what_is_asked_for_says_so(ball_game):
    with pytest.raises(DeviceSettingError, match="cannot be triggered: it has no feature TriggerMode") as caught:
        set_up(ball_game, GenICamSettings())
    assert "free_run" in caught.value.remedy
    with pytest.raises(DeviceSettingError, match="camera has no feature ExposureTime"):
        set_up(ball_game, GenICamSettings(trigger="free_run", exposure_us=1000.0))
    with pytest.raises(DeviceSettingError, match="PixelFormat cannot be Mono12: the camera takes RGBa8, Mono8"):
        set_up(ball_game, GenICamSettings(trigger="free_run", pixel_format="Mono12"))


def test_a_width_that_cannot_be_packed_is_refused(ball_game, monkeypatch):
    from drivers.genicam import configuration

    monkeypatch.setitem(configuration.PIXEL_FORMATS, "Mono8", configuration.PIXEL_FORMATS["Mono10p"])
    with pytest.raises(DeviceSettingError, match="4 pixels together: 402 px"):
        set_up(ball_game, GenICamSettings(trigger="free_run", width_px=402))


def test_the_cameras_time_is_that_of_its_stamps_or_not_used(modern, ball_game):
    import time

    # The simulated camera stamps with the clock of this machine.
    before = time.monotonic_ns()
    now = CameraTime(modern).now_ns()
    assert before < now < time.monotonic_ns()
    assert CameraTime(ball_game).now_ns() is None
