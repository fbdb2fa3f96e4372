"""A bench that is handed one object after the other."""

import numpy as np
import pytest

from drivers import Bench, DeviceSettingError, Presenter
from scanner.rig import Rig
from sim_backend import cache
from sim_backend.bench import kind, truth_of

QUIET = {"read_noise_dn": 0.0, "ambient_dn": 0.0}
WHITE = np.full((400, 640), 255, np.uint8)
BOARD = {"name": "board", "discs": [[0.0, 0.0, 40.0]], "distance_mm": 580.0, "yaw_deg": 12.0}


def _shot(bench):
    frame = np.empty(bench.frame_format.shape, bench.frame_format.dtype)
    bench.prepare([WHITE])
    return frame, bench.expose(0, frame)


def _expected(truth):
    return np.clip(np.rint(truth.optics.grey([(1.0, WHITE)])), 0, 255)


def test_what_is_presented_is_what_is_seen(small):
    settings = small(scene={"name": "plane"}, camera=QUIET)
    with kind.open(settings) as bench:
        assert isinstance(bench, Presenter)
        assert isinstance(bench, Bench)
        first, stamp = _shot(bench)
        bench.present(BOARD)
        second, later = _shot(bench)
        bench.present({"name": "sphere"})
        third, _ = _shot(bench)
        assert bench.describe()["synchronisation"] == "stepped"
        assert bench.name == "simulated sphere"
    for frame, presented in ((first, None), (second, BOARD), (third, {"name": "sphere"})):
        np.testing.assert_allclose(frame, _expected(truth_of(settings, presented)), atol=1)
    assert second[96, 128] < 20 < 120 < first[96, 128]
    # Time and counts go on.
    assert later.frame_id == stamp.frame_id + 1
    assert later.t_device_s > stamp.t_device_s


def test_noise_goes_on_from_object_to_object(small):
    def frames(presented):
        with kind.open(small(scene=BOARD, seed=3)) as bench:
            first, _ = _shot(bench)
            if presented:
                bench.present(BOARD)
            return first, _shot(bench)[0]

    (first, second), undisturbed = frames(True), frames(False)
    np.testing.assert_array_equal(second, undisturbed[1])
    assert (first != second).mean() > 0.3


@pytest.mark.parametrize(
    ("thing", "says"),
    [
        ({"name": "cathedral"}, "cathedral"),
        ({}, "name"),
        ({"name": "board", "width": 100}, "width"),
        ({"name": "board", "polygons": [[[0, 0], [1, 0]]]}, "polygons"),
        ({"name": "ball_bar", "spacing_mm": 10}, "spacing_mm must be at least"),
        ({"name": "board", "discs": [[0, 0]] * 9}, "and 6 more"),
        ({"name": "board", "discs": [[0, 0, 6], [10, 0, 6]]}, "radius"),
    ],
)
def test_what_is_no_object_is_refused_and_the_former_stays(small, thing, says):
    with kind.open(small(scene={"name": "plane"}, camera=QUIET)) as bench:
        before, _ = _shot(bench)
        with pytest.raises(DeviceSettingError, match="is no object it knows") as refusal:
            bench.present(thing)
        assert says in refusal.value.message
        assert "document" in refusal.value.remedy
        np.testing.assert_array_equal(_shot(bench)[0], before)


def test_another_exposure_needs_no_tracing(small, monkeypatch):
    traced = []
    original = cache.trace
    monkeypatch.setattr(cache, "trace", lambda *a: traced.append(1) or original(*a))
    board = {**BOARD, "roll_deg": 3.0}

    def frame(exposure_us):
        with kind.open(small(scene={"name": "plane"}, camera={**QUIET, "exposure_us": exposure_us})) as bench:
            bench.present(board)
            return _shot(bench)[0].astype(float)

    long, short = frame(16_000.0), frame(4_000.0)
    bright = long > 100
    np.testing.assert_allclose(short[bright] / long[bright], 0.25, atol=0.01)
    truth_of(small(scene=board))
    assert len(traced) <= 2  # the plane, perhaps, and the board


def test_boards_leave_nothing_in_the_cache_and_artefacts_do(small, tmp_path):
    settings = small(scene={**BOARD, "roll_deg": 4.0}, cache_dir=tmp_path / "cache", transport={"supersample": 1})
    with kind.open(settings) as bench:
        assert not (tmp_path / "cache").exists()
        bench.present({"name": "sphere", "radius_mm": 33.0})
    assert len(list((tmp_path / "cache").iterdir())) == 1


@pytest.mark.parametrize("knows", [True, False])
def test_a_bench_may_not_know_its_rig_but_the_truth_does(small, knows):
    settings = small(scene={"name": "plane"}, knows_rig=knows)
    with kind.open(settings) as bench:
        assert (bench.rig is not None) is knows
        if knows:
            Rig.from_json(bench.rig)
    np.testing.assert_allclose(truth_of(settings).rig.projector_centre_cam, [-180, 0, 0], atol=1e-9)
