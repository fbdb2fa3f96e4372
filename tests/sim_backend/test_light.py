"""The light that the world computes ahead, against the optics of the simulation in process."""

from dataclasses import replace

import numpy as np
import pytest

from drivers import FrameFormat
from sim_backend.cache import transport_of
from sim_backend.light import DirectLight
from sim_backend.optics import Optics, Sensor
from sim_backend.scene_light import SceneLight

FORMAT = FrameFormat(256, 192, 8)


@pytest.fixture(scope="module")
def optics(small):
    settings = small(scene={"name": "plane"}, camera={"read_noise_dn": 1.5, "ambient_dn": 3.0})
    return Optics.of(settings, transport_of(settings))


@pytest.fixture
def light(optics):
    light = SceneLight(optics, seed=5)
    yield light
    light.close()


@pytest.fixture(scope="module")
def pictures():
    random = np.random.default_rng(2)
    fringes = (127.5 + 127.5 * np.cos(np.arange(640) / 9)).astype(np.uint8)
    return [np.tile(fringes, (400, 1)), random.integers(0, 256, (400, 640), np.uint8)]


def expected(optics, shown, exposure_us):
    """Expected grey value by the optics themselves, which make one sum of the light before it is transported."""
    return replace(optics, camera=optics.camera.model_copy(update={"exposure_us": exposure_us})).grey(shown)


def test_a_frame_is_what_the_optics_expect_with_the_cameras_noise(optics, light, pictures):
    light.expect(pictures[0])
    shown = [(0.25, pictures[0]), (0.75, pictures[1])]
    frame = light.frame(shown, 0.012, 1.0, 0.0, FORMAT)
    assert frame.dtype == np.uint8
    error = frame - expected(optics, shown, 12_000)
    inside = (frame > 8) & (frame < 247)
    assert inside.mean() > 0.5
    assert error[inside].mean() == pytest.approx(0, abs=0.03)
    assert error[inside].std() == pytest.approx(1.5, rel=0.03)


def test_gain_is_a_factor_and_depth_scales(optics, light, pictures):
    shown = [(1.0, pictures[0])]
    frame = light.frame(shown, 0.004, 2.0, 0.0, FrameFormat(256, 192, 12))
    assert frame.dtype == np.uint16
    wanted = expected(optics, shown, 8_000) * Sensor(optics.camera.model_copy(update={"bits": 12})).scale
    error = frame - wanted
    inside = (wanted > 150) & (wanted < 3900)
    assert error[inside].mean() == pytest.approx(0, abs=0.5)
    assert error[inside].std() == pytest.approx(1.5 * 4095 / 255, rel=0.03)


def test_noise_is_new_in_each_frame_and_repeats_with_the_seed(optics, pictures):
    def two():
        light = SceneLight(optics, seed=7)
        try:
            return [light.frame([(1.0, pictures[0])], 0.01, 1.0, 0.0, FORMAT) for _ in range(2)]
        finally:
            light.close()

    first, again = two(), two()
    assert (first[0] != first[1]).any()
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_light_is_computed_once_for_a_picture(optics, pictures, monkeypatch):
    computed = []
    grey = Optics.grey
    monkeypatch.setattr(Optics, "grey", lambda self, shown: computed.append(1) or grey(self, shown))
    light = SceneLight(optics, seed=1)
    try:
        light.expect(pictures[0])
        for _ in range(5):
            light.frame([(0.5, pictures[0]), (0.5, pictures[1])], 0.01, 1.0, 0.0, FORMAT)
    finally:
        light.close()
    assert len(computed) == 2


def test_direct_light_shows_the_pictures_pixels():
    light = DirectLight()
    picture = np.arange(400 * 640, dtype=np.uint32).reshape(400, 640).astype(np.uint8)
    same = light.frame([(1.0, picture)], 0.01, 1.0, 0.0, FrameFormat(640, 400, 8))
    np.testing.assert_array_equal(same, picture)
    half = light.frame([(1.0, picture)], 0.01, 1.0, 0.0, FrameFormat(320, 200, 12))
    np.testing.assert_array_equal(half, picture[::2, ::2].astype(np.uint16) * 16)


def test_direct_light_mixes_what_one_exposure_saw():
    shown = [(0.25, np.full((4, 4), 200, np.uint8)), (0.75, np.full((4, 4), 40, np.uint8))]
    assert (DirectLight().frame(shown, 0.01, 1.0, 0.0, FrameFormat(4, 4, 8)) == 80).all()
