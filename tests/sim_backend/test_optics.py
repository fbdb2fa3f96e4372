import numpy as np
import pytest

from sim_backend.optics import Sensor
from sim_backend.settings import CameraSettings


@pytest.fixture(scope="module")
def plane(truth):
    return lambda **changes: truth(scene={"name": "plane"}, **changes).optics


def _picture(level):
    return np.full((400, 640), level, np.uint8)


def _frames(settings, grey, count, seed=0):
    sensor = Sensor(settings)
    random = np.random.default_rng(seed)
    shape = sensor.frame_format.shape
    frames = np.empty((count, *shape), sensor.frame_format.dtype)
    for frame in frames:
        sensor.digitise(np.full(shape, grey, np.float32), random, frame)
    return frames


def test_grey_is_linear_in_exposure_and_in_light(plane):
    short = plane(camera={"exposure_us": 5_000.0, "ambient_dn": 0.0})
    long = plane(camera={"exposure_us": 20_000.0, "ambient_dn": 0.0})
    np.testing.assert_allclose(4 * short.grey([(1.0, _picture(200))]), long.grey([(1.0, _picture(200))]), rtol=1e-5)
    mixed = long.grey([(0.25, _picture(200)), (0.75, _picture(40))])
    parts = 0.25 * long.grey([(1.0, _picture(200))]) + 0.75 * long.grey([(1.0, _picture(40))])
    np.testing.assert_allclose(mixed, parts, rtol=1e-4, atol=1e-3)


def test_ambient_light_follows_the_exposure(plane):
    dark = plane(camera={"exposure_us": 2 * 16_667.0, "ambient_dn": 3.0}).grey([(1.0, _picture(0))])
    np.testing.assert_allclose(dark, 6.0, rtol=1e-6)


def test_gamma_bends_the_response(plane):
    optics = plane(projector={"gamma": 2.2}, camera={"ambient_dn": 0.0})
    full, half = optics.grey([(1.0, _picture(255))]), optics.grey([(1.0, _picture(128))])
    lit = full > 10
    np.testing.assert_allclose(half[lit] / full[lit], (128 / 255) ** 2.2, rtol=1e-5)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0])
def test_blurs_dim_fringes_as_a_gaussian_does(plane, sigma):
    """Transfer function of a Gaussian: exp(-2 π² σ² f²)."""
    optics = plane(projector={"blur_px": sigma}, camera={"blur_px": sigma})
    continuous = np.exp(-2 * (np.pi * sigma / 16) ** 2)
    for blurred, shape in ((optics.projector_blurred, (400, 640)), (optics.camera_blurred, (192, 256))):
        fringe = np.tile(np.cos(2 * np.pi * np.arange(shape[1]) / 16), (shape[0], 1)).astype(np.float32)
        inner = (slice(30, -30), slice(30, -30))
        # On a grid the exponent differs by 1.3 % at this frequency: cos ω - 1 in place of -ω²/2.
        np.testing.assert_allclose(blurred(fringe)[inner], continuous * fringe[inner], atol=5e-3)
        assert np.abs(blurred(fringe)[inner]).max() == pytest.approx(continuous, rel=0.014 * np.log(1 / continuous))


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("electrons_per_dn", [None, 40.0])
def test_noise_has_the_variance_of_its_model(bits, electrons_per_dn):
    settings = CameraSettings(
        width_px=256, height_px=192, bits=bits, read_noise_dn=1.5, electrons_per_dn=electrons_per_dn
    )
    sensor, grey = Sensor(settings), 100.3
    frames = _frames(settings, grey, 4).astype(float)
    n = frames.size
    variance = float(sensor.noise.variance(grey * sensor.scale))
    # What the settings say: 1.5 DN of the 8-bit scale, and Poisson counts of 40 electrons per such DN.
    stated = 1.5**2 + (0 if electrons_per_dn is None else grey / electrons_per_dn)
    assert variance == pytest.approx(stated * sensor.scale**2, rel=1e-6)
    assert frames.mean() == pytest.approx(grey * sensor.scale, abs=4 * np.sqrt(variance / n))
    assert frames.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / n))


def test_noise_is_white_and_differs_from_frame_to_frame():
    frames = _frames(CameraSettings(width_px=256, height_px=192), 100.0, 2).astype(float) - 100
    bound = 4 / np.sqrt(frames[0].size)
    correlation = [
        (frames[0] * frames[1]).mean(),
        (frames[0, :, 1:] * frames[0, :, :-1]).mean(),
        (frames[0, 1:] * frames[0, :-1]).mean(),
    ]
    assert np.abs(correlation).max() / frames.var() < bound


def test_no_noise_leaves_rounding_alone():
    settings = CameraSettings(width_px=64, height_px=32, read_noise_dn=0.0)
    sensor = Sensor(settings)
    ramp = np.linspace(-20, 300, 64 * 32, dtype=np.float32).reshape(32, 64)
    frame = np.empty((32, 64), np.uint8)
    sensor.digitise(ramp, np.random.default_rng(0), frame)
    np.testing.assert_array_equal(frame, np.clip(np.round(ramp), 0, 255).astype(np.uint8))
    assert sensor.noise.read_dn == pytest.approx(np.sqrt(1 / 12))


@pytest.mark.parametrize(("bits", "full"), [(8, 255), (10, 1023), (12, 4095)])
def test_bright_light_saturates_at_full_scale(bits, full):
    settings = CameraSettings(width_px=64, height_px=32, bits=bits)
    assert (_frames(settings, 400.0, 1) == full).all()
    assert Sensor(settings).frame_format.saturated_dn == full


def test_same_seed_same_noise():
    settings = CameraSettings(width_px=64, height_px=32)
    np.testing.assert_array_equal(_frames(settings, 90.0, 2, seed=5), _frames(settings, 90.0, 2, seed=5))
    assert (_frames(settings, 90.0, 1, seed=5) != _frames(settings, 90.0, 1, seed=6)).any()
