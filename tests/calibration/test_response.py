"""Response, harmonics and MTF of a projector, against the simulated one's true gamma, blur and coordinates."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.integrate import quad

from calibration.photometry import (
    MTF_PERIODS_PX,
    Mtf,
    PhotometryError,
    Ramp,
    camera_linearity,
    fit_gamma,
    fringe_harmonics,
    gamma_of_harmonics,
    gamma_of_ratio,
    measure_harmonics,
    measure_mtf,
    mtf_of_modulation,
    mtf_plan,
    phase_error_curve,
    power_harmonics,
    predict_phase_error,
    response_of_ramp,
    take_ramp,
)
from drivers import FrameFormat, NoiseModel
from scanner.patterns import Plan, phase_steps
from scanner.phasors import RoundPhasors
from scanner.response import ProjectorResponse
from sim_backend.bench import kind, truth_of
from sim_backend.settings import SimulatedSettings

PROJECTOR = (640, 400)


@cache
def settings(gamma: float, **camera: float) -> SimulatedSettings:
    return SimulatedSettings.model_validate(
        {
            "scene": {"name": "plane", "yaw_deg": 12.0},
            "camera": {"width_px": 256, "height_px": 192, **camera},
            "projector": {"width_px": PROJECTOR[0], "height_px": PROJECTOR[1], "gamma": gamma},
            "transport": {"photons": 200_000},
        }
    )


def photographed(bench, plan):
    """Frames of all sequences of a plan, (N, H, W) each."""
    stacks = []
    for number, sequence in enumerate(plan.sequences):
        bench.prepare(plan.render(number))
        frames = np.empty((len(sequence.fringes), *bench.frame_format.shape), np.uint8)
        for index in range(len(frames)):
            bench.expose(index, frames[index])
        stacks.append(frames)
    return stacks


def collected(bench, plan):
    phasors = RoundPhasors(plan, bench.frame_format)
    for number, frames in enumerate(photographed(bench, plan)):
        phasors.add(number, frames)
    return phasors


@pytest.fixture(scope="module")
def bench22(transport_cache):
    with kind.open(settings(2.2)) as bench:
        yield bench


@pytest.fixture(scope="module")
def measured22(bench22):
    return response_of_ramp(take_ramp(bench22))


@pytest.fixture(scope="module")
def mtf22(bench22):
    return measure_mtf(collected(bench22, mtf_plan(PROJECTOR)), bench22.noise)


# Analysis


@pytest.mark.parametrize("gamma", [0.6, 1.0, 1.7, 2.2, 3.1])
def test_harmonics_of_a_power_law_are_its_fourier_integrals(gamma):
    def amplitude(k):
        return quad(lambda t: ((1 + np.cos(t)) / 2) ** gamma * np.cos(k * t), 0, np.pi, epsabs=1e-12, limit=200)[0]

    expected = [amplitude(k) / amplitude(1) for k in range(1, 6)]
    assert power_harmonics(gamma, 5) == pytest.approx(expected, abs=1e-7)
    assert expected[1] == pytest.approx((gamma - 1) / (gamma + 2), abs=1e-9)
    assert gamma_of_ratio(expected[1]) == pytest.approx(gamma, rel=1e-7)
    b = fringe_harmonics(ProjectorResponse.power(gamma).light, count=5)
    # Straight lines between 256 levels cut the corner at black where the law is steep there.
    assert b[1:] / b[1] == pytest.approx(expected, abs=1e-3 if gamma < 1 else 1e-4)


def test_three_step_error_is_the_one_of_its_definition():
    # Independent: three frames of the distorted fringe at every phase, demodulated by the arctangent formula.
    gamma, theta = 1.8, np.linspace(0, 2 * np.pi, 720, endpoint=False)
    frames = [((1 + np.cos(theta + 2 * np.pi * n / 3)) / 2) ** gamma for n in (-1, 0, 1)]
    phase = np.arctan2(np.sqrt(3) * (frames[0] - frames[2]), 2 * frames[1] - frames[0] - frames[2])
    direct = np.angle(np.exp(1j * (phase - theta)))
    _, error = phase_error_curve(fringe_harmonics(ProjectorResponse.power(gamma).light), 3)
    assert np.abs(direct).max() > 0.2
    assert error == pytest.approx(direct, abs=1e-3)


def test_gamma_is_found_under_an_offset_and_its_sigma_is_honest():
    rng = np.random.default_rng(7)
    grey, off = np.linspace(0, 1, 17), []
    for _ in range(200):
        gamma, sigma = fit_gamma(grey, 12 + 150 * grey**1.8 + rng.normal(0, 0.5, 17), np.full(17, 0.5))
        off.append((gamma - 1.8) / sigma)
    assert np.std(off) == pytest.approx(1, abs=0.2)
    assert abs(np.mean(off)) < 0.3


# Measured on the simulated bench


@pytest.mark.parametrize("gamma", [0.7, 1.0, 2.2])
def test_ramp_gives_the_true_gamma_and_curve(transport_cache, gamma):
    with kind.open(settings(gamma)) as bench:
        result = response_of_ramp(take_ramp(bench))
    assert result.findings == ()
    response = result.response
    assert abs(response.gamma - gamma) < 3 * response.gamma_sigma
    assert response.gamma_sigma < 0.001
    true = (np.arange(256) / 255) ** gamma
    assert np.all(np.abs(response.light - true) < 4 * response.sigma + 1e-4)
    assert response.sigma.max() < 0.001


def test_harmonics_give_the_same_gamma_once_the_optics_are_known(bench22, measured22, mtf22):
    plan = Plan(PROJECTOR, (phase_steps("x", 1 / 32, 12),))
    harmonics = measure_harmonics(photographed(bench22, plan)[0], plan.sequences[0], 255)
    gamma = gamma_of_harmonics(harmonics, mtf=mtf22)
    assert abs(gamma.gamma - 2.2) < 2 * gamma.sigma
    assert gamma.gamma == pytest.approx(measured22.response.gamma, rel=0.005)
    assert gamma.sigma < 0.01
    assert gamma_of_harmonics(harmonics).gamma < 2.1  # blur weakens the second harmonic
    # Blur takes more of the higher ones; what is left has the sign and size that the power law says.
    fall = mtf22.at(np.arange(1, 4) / 32) / mtf22.at(1 / 32)
    expected = power_harmonics(2.2, 3) * fall
    assert harmonics.ratio[:3] == pytest.approx(expected, abs=0.002)


def test_weak_fringes_give_the_same_gamma(bench22, mtf22):
    plan = Plan(PROJECTOR, (phase_steps("x", 1 / 32, 8),), mean=0.55, amplitude=0.3)
    harmonics = measure_harmonics(photographed(bench22, plan)[0], plan.sequences[0], 255)
    gamma = gamma_of_harmonics(harmonics, mean=0.55, amplitude=0.3, mtf=mtf22)
    assert abs(gamma.gamma - 2.2) < 2 * gamma.sigma
    assert gamma.sigma < 0.04


def test_mtf_is_that_of_the_simulated_optics(mtf22, transport_cache):
    # Truth: amplitudes of noiseless frames under the projector's exact light, f(u) = cos and sin.
    truth = truth_of(settings(2.2))
    optics = truth.optics
    columns = np.arange(PROJECTOR[0])[None]
    b = []
    for period in MTF_PERIODS_PX:
        turns = np.broadcast_to(2 * np.pi * columns / period, PROJECTOR[::-1])
        parts = [
            optics.camera_blurred(optics.transport.direct_light(optics.projector_blurred(f(turns).astype(np.float32))))
            for f in (np.cos, np.sin)
        ]
        b.append(np.hypot(*parts))
    b = np.array(b).reshape(len(b), -1)
    lit = b[0] > 0.25 * np.quantile(b[0], 0.99)
    relative = b[:, lit].sum(axis=1) / b[0, lit].sum()
    # The mean falls as the model does over the whole range; normalised at the coarsest, where noise is least.
    assert mtf22.contrast / mtf22.contrast[0] == pytest.approx(relative, abs=0.005)
    assert mtf22.misfit < 0.006
    assert np.all(np.diff(mtf22.at(np.linspace(0, 0.5, 100))) <= 1e-9)
    assert mtf22.at(0.0) == 1


def test_mtf_sigma_is_honest():
    rng = np.random.default_rng(3)
    f, spot = 1 / np.array(MTF_PERIODS_PX), 0.9
    off = []
    for _ in range(60):
        brightness = rng.uniform(40, 90, 3000)
        b = brightness * (np.sinc(f) * np.exp(-2 * np.pi**2 * spot**2 * f**2))[:, None]
        mtf = mtf_of_modulation(f, b + rng.normal(0, 1.0, b.shape))
        off.append((mtf.at(1 / 8) - np.sinc(1 / 8) * np.exp(-2 * np.pi**2 * spot**2 / 64)) / mtf.sigma_at(1 / 8))
    assert np.std(off) == pytest.approx(1, abs=0.3)
    assert abs(np.mean(off)) < 0.5


def test_mtf_document_round_trip(mtf22):
    again = Mtf.from_json(mtf22.to_json())
    assert np.array_equal(again.at([0.01, 0.2]), mtf22.at([0.01, 0.2]))


# Correction


@pytest.mark.parametrize("steps", [3, 12])
def test_correction_lowers_the_phase_error_as_predicted(bench22, measured22, mtf22, steps):
    """Phase of a plane's fringes against the true projector column, with and without correction."""
    frequency = 1 / 64
    truth = truth_of(settings(2.2))
    light = (np.arange(256) / 255) ** 2.2
    rms = {}
    for name, response in (("off", None), ("on", measured22.response.values)):
        plan = Plan(PROJECTOR, (phase_steps("x", frequency, steps),), response=response)
        phasors = collected(bench22, plan)
        stack = phasors.axis("x")
        z = stack.z[0]
        good = np.isfinite(truth.x_p) & ~truth.edge & (np.abs(z) > 30) & ~phasors.saturated
        error = np.angle(z[good] * np.exp(-2j * np.pi * frequency * truth.x_p[good]))
        noise = np.sqrt(np.mean((stack.sigma_z(bench22.noise, phasors.mean)[good] / np.abs(z[good])) ** 2))
        predicted = predict_phase_error(
            light, frequency, steps, correction=None if response is None else np.array(response), mtf=mtf22
        )
        rms[name] = np.sqrt(np.mean(error**2))
        # Rounding noise is averaged over the camera's spot: it lies between none and what single pixels have.
        low = np.hypot(predicted.rms_rad, noise)
        high = np.hypot(low, predicted.rounding_rad)
        assert 0.95 * low < rms[name] < 1.05 * high
        if name == "off" and steps == 3:
            assert predicted.rms_rad > 0.15
            uncorrected = predicted
        elif name == "on":
            assert predicted.rms_rad < 0.0005
    if steps == 3:
        assert rms["off"] > 8 * rms["on"]
        assert uncorrected.second_harmonic > 0.27
    else:
        # Twelve steps do not see the second harmonic; correction costs no more than its rounding.
        assert rms["on"] < 1.2 * rms["off"]


def test_correction_of_a_scan_from_the_rig(transport_cache, measured22, tmp_path):
    """End to end: three steps on a plane, decoded to x_p, with the response that the acquisition is given."""
    from scanner.acquisition import Acquisition
    from scanner.config import ScanSection
    from scanner.decoding import Decoder
    from scanner.methods import METHODS
    from scanner.rig import Rig
    from scanner.take import TakeWriter

    truth = truth_of(settings(2.2))
    section = ScanSection(method="tps", steps=3, axes=["x"], periods_px=[32, 160, 640])
    off = {}
    for name, response in (("off", None), ("on", measured22.response.values)):
        with kind.open(settings(2.2)) as bench:
            plan = METHODS["tps"].first_round(section, PROJECTOR)
            manifest = {"method": "tps", "bench": {}, "config": {}, "plans": [], "simulated": True}
            with TakeWriter.create(
                tmp_path / name, frame_format=bench.frame_format, slots=plan.frame_count, manifest=manifest
            ) as take:
                decoder = Decoder(METHODS["tps"], section, bench.noise, Rig.from_json(bench.rig))
                maps = Acquisition(bench, METHODS["tps"], section, decoder, take, response=response).run()
        error = (maps.x_p - truth.x_p)[np.isfinite(maps.x_p) & np.isfinite(truth.x_p) & ~truth.edge]
        off[name] = np.sqrt(np.mean(error**2))
        if name == "on":
            assert error.size > 0.9 * np.isfinite(truth.x_p).sum()
    assert off["off"] > 0.5
    assert off["on"] < 0.12


# What is refused


def ramp_of(light, levels=None, ambient=10.0, gain=150.0, seed=0, shape=(60, 80), sigma=1.0, curve=lambda v: v):
    levels = list(levels if levels is not None else (0, 255, *range(16, 255, 16), 255, 0))
    rng = np.random.default_rng(seed)
    shade = rng.uniform(0.5, 1, shape)
    frames = [
        np.clip(np.rint(curve(ambient + gain * shade * light(level)) + rng.normal(0, sigma, shape)), 0, 255).astype(
            np.uint8
        )
        for level in levels
    ]
    return Ramp.of_frames(levels, frames, 255)


def power(level):
    return (level / 255) ** 1.8


def codes(ramp):
    return [f.code for f in response_of_ramp(ramp).findings]


def test_a_good_ramp_has_no_finding():
    assert codes(ramp_of(power)) == []


def test_what_is_wrong_with_a_ramp_is_named():
    assert codes(ramp_of(lambda v: power(v) if v < 180 else power(v) - 0.1 * (v < 240))) == ["ramp_not_monotone"]
    assert codes(ramp_of(lambda v: np.clip((v - 16) / 219, 0, 1))) == ["limited_range"]
    assert codes(ramp_of(lambda v: np.clip(v / 200, 0, 1))) == ["white_clipped"]
    assert codes(ramp_of(power, curve=lambda v: 200 * np.sin(v / 200 * np.pi / 2))) == ["camera_not_linear"]
    assert codes(ramp_of(power, gain=300)) == ["ramp_saturated"]
    flickering = iter(1 + np.random.default_rng(1).normal(0, 0.03, 40))
    assert "ramp_flicker" in codes(ramp_of(lambda v: power(v) * next(flickering)))


def test_a_response_that_is_no_power_law_is_followed_all_the_same():
    # An S-curve, as some picture modes have it.
    def light(level):
        return 0.5 - 0.5 * np.cos(np.pi * level / 255)

    result = response_of_ramp(ramp_of(light, levels=(0, 255, *range(8, 255, 8), 255, 0)))
    true = np.array([light(v) for v in range(256)])
    assert np.abs(result.response.light - true).max() < 0.003
    assert result.response.gamma_sigma > 0.05


def test_darkness_and_too_few_levels_are_refused():
    with pytest.raises(PhotometryError, match="little difference"):
        ramp_of(power, gain=5)
    with pytest.raises(PhotometryError, match="grey levels"):
        response_of_ramp(ramp_of(power, levels=(0, 64, 128, 192, 255)))


def test_camera_linearity_from_two_exposures():
    rng = np.random.default_rng(2)
    light = rng.uniform(20, 110, (200, 200))
    noisy = [light * k + rng.normal(0, 1, light.shape) for k in (1, 2)]
    deviation, finding = camera_linearity(noisy[0], noisy[1], 2.0, np.zeros(()))
    assert deviation < 0.01
    assert finding is None
    bent = [255 * (v / 255) ** 0.9 for v in (light, 2 * light)]
    deviation, finding = camera_linearity(bent[0], bent[1], 2.0, np.zeros(()))
    assert deviation == pytest.approx(1 - 2**-0.1, abs=0.003)
    assert finding is not None
    assert finding.code == "camera_not_linear"


def test_frames_without_fringes_have_no_harmonics():
    frames = np.random.default_rng(0).integers(255, 256, (6, 50, 50)).astype(np.uint8)
    with pytest.raises(PhotometryError, match="unsaturated fringes"):
        measure_harmonics(frames, phase_steps("x", 1 / 16, 6), 255)
    with pytest.raises(ValueError, match="at least 5 steps"):
        measure_harmonics(frames[:4], phase_steps("x", 1 / 16, 4), 255)
    plan = mtf_plan(PROJECTOR, steps=4)
    phasors = RoundPhasors(plan, FrameFormat(50, 50, 8))
    for number in range(len(plan.sequences)):
        phasors.add(number, np.full((4, 50, 50), 90, np.uint8))
    with pytest.raises(PhotometryError, match="clearly"):
        measure_mtf(phasors, NoiseModel(1.5))
