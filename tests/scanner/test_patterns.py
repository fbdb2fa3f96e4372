"""What is projected, against the formula."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from scanner.patterns import Plan, phase_steps
from scanner.response import PROJECTOR_RESPONSE, ProjectorResponse, ResponseError, quantisation_sigma, response_of


def test_pattern_is_the_formula_rounded():
    plan = Plan((64, 48), (phase_steps("x", 1 / 16, 12), phase_steps("y", 1 / 12.5, 3)), mean=0.5, amplitude=0.4)
    x = np.arange(64)
    for n, picture in enumerate(plan.render(0), start=1):
        exact = 255 * (0.5 + 0.4 * np.cos(2 * np.pi * x / 16 + 2 * np.pi * n / 12))
        assert picture.dtype == np.uint8
        assert np.abs(picture - exact).max() <= 0.5 + 1e-9
    y = np.arange(48)[:, None]
    exact = 255 * (0.5 + 0.4 * np.cos(2 * np.pi * y / 12.5 + 2 * np.pi * 2 / 3))
    assert np.abs(plan.render(1)[1] - exact).max() <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("frequency", "steps", "what"), [(0.5, 4, "between 0 and 1/2"), (1 / 16, 2, "at least 3"), (-0.1, 4, "between 0")]
)
def test_what_cannot_be_decoded_is_refused(frequency, steps, what):
    with pytest.raises(ValueError, match=what):
        phase_steps("x", frequency, steps)


def test_levels_outside_full_scale_are_refused():
    with pytest.raises(ValueError, match=r"within 0\.\.1"):
        Plan((64, 48), (phase_steps("x", 1 / 16, 4),), mean=0.6, amplitude=0.5)


def test_corrected_pattern_gives_the_light_of_the_formula():
    light = (np.arange(256) / 255) ** 2.2
    plan = Plan((64, 48), (phase_steps("x", 1 / 16, 4),), mean=0.5, amplitude=0.4, response=tuple(light))
    x = np.arange(64)
    for n, picture in enumerate(plan.render(0), start=1):
        wanted = 0.5 + 0.4 * np.cos(2 * np.pi * x / 16 + 2 * np.pi * n / 4)
        # No other level comes nearer.
        best = np.abs(light[:, None] - wanted).min(axis=0)
        assert np.abs(np.abs(light[picture[0]] - wanted) - best).max() < 1e-12
    linear = Plan((64, 48), (phase_steps("x", 1 / 16, 4),), mean=0.5, amplitude=0.4)
    assert np.abs(light[linear.render(0)[0][0]] - (0.5 + 0.4 * np.cos(2 * np.pi * x / 16 + np.pi / 2))).max() > 0.2


def test_correction_leaves_masked_pixels_black_and_follows_into_round_two():
    mask = np.zeros((48, 64), bool)
    mask[10:20] = True
    plan = Plan((64, 48), (phase_steps("x", 1 / 16, 4),), response=ProjectorResponse.power(0.5).values)
    second = replace(plan, mask=mask)
    assert second.response == plan.response
    for whole, lit in zip(plan.render(0), second.render(0), strict=True):
        assert np.array_equal(lit, np.where(mask, whole, 0))


def test_plan_documents_round_trip_and_old_ones_still_read():
    mask = np.random.default_rng(0).random((48, 64)) > 0.5
    plan = Plan((64, 48), (phase_steps("y", 1 / 16, 4),), mask=mask, response=ProjectorResponse.power(2.2).values)
    document = json.loads(json.dumps(plan.to_json()))
    again = Plan.from_json(document)
    assert again == plan
    assert np.array_equal(again.mask, mask)
    assert np.array_equal(again.render(0), plan.render(0))
    del document["response"]
    assert Plan.from_json(document).response is None


@pytest.mark.parametrize(
    "bad", [np.linspace(0, 1, 255), np.linspace(1, 0, 256), np.full(256, 0.5), np.full(256, np.nan)]
)
def test_what_is_no_response_is_refused(bad):
    with pytest.raises(ValueError, match="response"):
        Plan((64, 48), (phase_steps("x", 1 / 16, 4),), response=tuple(bad))
    with pytest.raises(ResponseError, match="cannot be used"):
        ProjectorResponse.from_json({"light": list(bad), "sigma": [0] * 256, "gamma": 1, "gamma_sigma": 0})


def test_response_document_round_trip():
    response = ProjectorResponse.power(2.2)
    again = ProjectorResponse.from_json(json.loads(json.dumps(response.to_json())))
    assert again.values == response.values
    assert (again.gamma, again.source) == (2.2, "power law")
    assert response_of({PROJECTOR_RESPONSE: response.to_json()}).values == response.values
    assert response_of({}) is None


def test_lut_is_the_inverse_of_the_response():
    response = ProjectorResponse.power(2.2)
    wanted = np.arange(256) / 255
    # Half the coarsest step, γ/255, is the most that may be off.
    assert np.abs(response.light[response.lut] - wanted).max() <= 2.2 / 255 / 2 + 1e-6
    assert np.array_equal(ProjectorResponse.power(1.0).lut, np.arange(256))


def test_rounding_noise_of_levels():
    # A uniform error of a step s has the variance s²/12.
    assert quantisation_sigma(ProjectorResponse.power(1.0).light) == pytest.approx(1 / 255 / np.sqrt(12), rel=0.02)
    theta = np.linspace(0, 2 * np.pi, 10001)
    light = 0.5 + 0.5 * np.cos(theta)
    steps = 2.2 * light ** (1 - 1 / 2.2) / 255
    expected = np.sqrt(np.mean(steps**2) / 12)
    assert quantisation_sigma(ProjectorResponse.power(2.2).light) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("steps", [3, 4, 5, 12])
@pytest.mark.parametrize("amplitude", [0.5, 0.3])
def test_what_grey_levels_add_to_phasors(steps, amplitude):
    frequencies = [(80 + t) / 1280 for t in range(9)]
    plan = Plan((1280, 800), tuple(phase_steps("x", f, steps) for f in frequencies), 0.5, amplitude)
    found = plan.rounding()
    assert set(found) == {("x", f) for f in frequencies}
    # Rounding errors are uniform; of an even number of steps those of opposite ones are opposite, and add up.
    one = 1 / np.sqrt(12) / (255 * amplitude)
    expected = one * np.sqrt((4 if steps % 2 == 0 else 2) / steps)
    assert np.sqrt(np.mean(np.square(np.abs(list(found.values())))) / 2) == pytest.approx(expected, rel=0.15)
    x = np.arange(1280)
    for number, f in enumerate(frequencies):
        pictures = np.stack([p[0] for p in plan.render(number)]) / 255
        z = np.fft.fft(pictures, axis=0)[1] * 2 / steps * np.exp(-2j * np.pi / steps)
        assert z / amplitude - np.exp(2j * np.pi * f * x) == pytest.approx(found["x", f], abs=1e-9)


def test_grey_levels_of_a_corrected_projector():
    response = ProjectorResponse.power(2.2)
    plan = Plan((320, 200), (phase_steps("y", 1 / 13, 5),), 0.5, 0.5, response=response.values)
    off = np.abs(plan.rounding()["y", 1 / 13]) / np.sqrt(2)
    expected = quantisation_sigma(response.light) / 0.5 * np.sqrt(2 / 5)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(expected, rel=0.25)
