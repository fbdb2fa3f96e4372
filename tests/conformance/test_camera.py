"""What every camera does, whoever drives it.

A subject is a file in ``subjects/`` with a context manager ``camera(tmp_path)`` that yields a closed camera which is
triggered by software or runs freely, with something to look at.
"""

import importlib.util
import json
import time
from pathlib import Path

import numpy as np
import pytest
from cameras import left_behind, wait_for

from drivers import (
    AdjustableCamera,
    Camera,
    DeviceSettingError,
    DeviceState,
    FrameTimeoutError,
    IllegalCallError,
    NoiseModel,
)

PATIENCE_S = 2.0


def _modules():
    for file in sorted((Path(__file__).parent / "subjects").glob("*.py")):
        spec = importlib.util.spec_from_file_location(f"subject_{file.stem}", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        if hasattr(module, "camera"):
            yield pytest.param(module, id=file.stem)


SUBJECTS = list(_modules())


@pytest.fixture(params=SUBJECTS)
def subject(request, tmp_path, transport_cache):
    """A closed camera."""
    with request.param.camera(tmp_path) as camera:
        try:
            yield camera
        finally:
            camera.close()


@pytest.fixture(params=SUBJECTS, scope="module")
def standing(request, tmp_path_factory, transport_cache):
    """One open camera for many tests, since opening a device takes longer than most of them, and its format."""
    with request.param.camera(tmp_path_factory.mktemp("subject")) as camera:
        try:
            camera.open()
            yield camera, camera.configure()
        finally:
            camera.close()


@pytest.fixture
def ready(standing):
    """A camera that waits for triggers, and a place for its frames."""
    camera, frame_format = standing
    if camera.state is DeviceState.CONFIGURED:
        camera.arm()
        camera.start()
    return camera, np.empty(frame_format.shape, frame_format.dtype)


def shot(camera, out):
    camera.trigger()
    return camera.fetch(out, PATIENCE_S)


def described(camera):
    """The camera's state, as it describes itself."""
    snapshot = json.loads(json.dumps(dict(camera.describe()), allow_nan=False))
    assert snapshot["name"] == camera.name
    return snapshot["state"]


def test_goes_through_its_states_and_leaves_nothing(subject):
    before = left_behind()
    assert isinstance(subject, Camera)
    assert subject.noise is None or isinstance(subject.noise, NoiseModel)
    for life in range(2):
        assert described(subject) == "CLOSED"
        subject.open()
        assert described(subject) == "OPEN"
        frame_format = subject.configure()
        assert subject.configure() == frame_format
        assert described(subject) == "CONFIGURED"
        out = np.empty(frame_format.shape, frame_format.dtype)
        for _ in range(2 - life):
            subject.arm()
            assert described(subject) == "ARMED"
            subject.start()
            assert described(subject) == "RUNNING"
            shot(subject, out)
            subject.stop()
            assert described(subject) == "CONFIGURED"
        subject.close()
        subject.close()
    assert subject.state is DeviceState.CLOSED
    wait_for(lambda: left_behind() == before)  # another program's memory may be seen before it is known as such


def test_refuses_what_its_state_does_not_allow(subject):
    everything = {"configure", "arm", "start", "trigger", "fetch", "stop"}
    for state, refusals in (
        ("CLOSED", everything),
        ("OPEN", everything - {"configure"} | {"open"}),
        ("CONFIGURED", {"open", "start", "trigger", "fetch", "stop"}),
        ("ARMED", {"open", "configure", "trigger", "fetch"}),
        # Settings are for a camera that is not exposing, whether or not its own library would refuse.
        ("RUNNING", {"open", "configure", "arm", "start"}),
    ):
        moves = {"OPEN": "open", "CONFIGURED": "configure", "ARMED": "arm", "RUNNING": "start"}
        if state in moves:
            getattr(subject, moves[state])()
        for call in refusals:
            arguments = (np.empty((1, 1), np.uint8), 0.1) if call == "fetch" else ()
            with pytest.raises(IllegalCallError, match=rf"{call}\(\).*{state}"):
                getattr(subject, call)(*arguments)
        assert subject.state.name == state


def test_every_pixel_is_written(ready):
    camera, out = ready
    untouched = np.ones(out.shape, bool)
    for sentinel in (0, 85, np.iinfo(out.dtype).max):
        out[:] = sentinel
        shot(camera, out)
        untouched &= out == sentinel
    assert not untouched.any()


def test_grey_values_stay_within_the_bits(standing, ready):
    camera, out = ready
    shot(camera, out)
    assert out.max() <= standing[1].saturated_dn
    assert out.std() > 0


def test_stamps_run_forward(ready):
    camera, out = ready
    stamps = [shot(camera, out) for _ in range(5)]
    assert (np.diff([s.frame_id for s in stamps]) >= 1).all()
    assert (np.diff([s.t_host_s for s in stamps]) > 0).all()
    device = np.array([s.t_device_s for s in stamps])
    assert np.isnan(device).all() or (np.diff(device) > 0).all()
    assert all(np.isnan(s.t_shown_s) for s in stamps)


def test_as_many_frames_as_triggers(ready):
    camera, out = ready
    for _ in range(4):
        camera.trigger()
    stamps = [camera.fetch(out, PATIENCE_S) for _ in range(4)]
    assert (np.diff([s.frame_id for s in stamps]) >= 1).all()
    with pytest.raises(FrameTimeoutError):
        camera.fetch(out, 0.1)


def test_without_a_trigger_there_is_no_frame(ready):
    camera, out = ready
    began = time.monotonic()
    with pytest.raises(FrameTimeoutError, match=r"0\.2 s") as caught:
        camera.fetch(out, 0.2)
    assert time.monotonic() - began < 5.0
    assert camera.name in caught.value.message
    assert caught.value.remedy
    assert shot(camera, out).frame_id >= 0


def test_a_frame_that_nobody_fetched_is_not_taken_for_a_later_one(ready):
    camera, out = ready
    old = shot(camera, out)
    camera.trigger()
    time.sleep(0.05)
    camera.stop()
    camera.arm()
    camera.start()
    with pytest.raises(FrameTimeoutError):
        camera.fetch(out, 0.1)
    new = shot(camera, out)
    assert new.t_host_s > old.t_host_s


def test_a_place_of_another_shape_is_refused_and_costs_no_frame(ready):
    camera, out = ready
    other = np.uint16 if out.dtype == np.uint8 else np.uint8
    camera.trigger()
    for place in (np.empty(out.shape, other), np.empty((out.shape[0] + 2, out.shape[1]), out.dtype)):
        with pytest.raises(DeviceSettingError, match=r"configure\(\)"):
            camera.fetch(place, PATIENCE_S)
    camera.fetch(out, PATIENCE_S)


def test_a_place_may_be_any_view(ready):
    camera, out = ready
    wide = np.zeros((out.shape[0], 2 * out.shape[1]), out.dtype)
    camera.trigger()
    camera.fetch(wide[:, ::2], PATIENCE_S)
    assert wide[:, ::2].any()
    assert not wide[:, 1::2].any()


def test_an_exposure_that_can_be_changed_stays_until_the_next_configuration(ready):
    camera, out = ready
    if not isinstance(camera, AdjustableCamera):
        return
    if camera.describe().get("exposure_us") is None:
        # Nobody has told it one: it may not have the feature at all, and then says so.
        camera.stop()
        with pytest.raises(DeviceSettingError, match="ExposureTime"):
            camera.set_exposure(0.002)
        return
    with pytest.raises(IllegalCallError):
        camera.set_exposure(0.002)
    own_s = 1e-6 * camera.describe()["exposure_us"]
    for exposure_s in (own_s / 2, own_s):
        camera.stop()
        assert camera.set_exposure(exposure_s) == pytest.approx(exposure_s, rel=0.01)
        camera.arm()
        camera.start()
        shot(camera, out)
    camera.stop()
    camera.set_exposure(own_s / 2)
    camera.configure()
    assert camera.describe()["exposure_us"] == pytest.approx(1e6 * own_s)
