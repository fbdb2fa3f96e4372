"""What a calibration promises, picture by picture on a small simulated bench; `tests/benchmarks` does forty rigs."""

import numpy as np
import pytest
from simulated_calibration import Simulated, accepted, calibrated, figures, random_settings

from sim_backend.scenes import PlaneScene

SEED = 1


@pytest.fixture(scope="module")
def one_rig(transport_cache):
    """A quarter of the pixels; lenses that distort, a projector of gamma 2.2 whose response is measured first."""
    rng = np.random.default_rng([9, SEED])
    settings = random_settings(rng, shrink=2)
    wall = PlaneScene(width_mm=400, height_mm=300)
    with Simulated.of(settings.model_copy(update={"scene": wall})) as bench:
        bench.measure_response()
        found = calibrated(bench, settings, rng)
        artefacts = accepted(bench, found.rig, settings)
        response = bench.response
    return settings.rig(), found, artefacts, response


def test_gamma_is_found_and_corrected(one_rig):
    _, found, _, response = one_rig
    assert response.gamma == pytest.approx(2.2, rel=0.01)
    assert "fringe_residuals" not in {finding.code for finding in found.findings}


def test_focal_lengths_baseline_and_residuals(one_rig, capsys):
    rig, found, _, _ = one_rig
    figure = figures(found, rig)
    with capsys.disabled():
        print("\ncalibration of a random rig:", {name: float(f"{value:.4g}") for name, value in figure.items()})
    assert found.usable
    assert found.dropped == ()
    assert figure["camera"] <= 3e-4
    assert figure["projector"] <= 6e-4
    assert abs(figure["baseline"]) <= 2e-4
    # Two hundred residuals and ten times as many scatter by a few per cent; the rest is for what the models leave out.
    for lens in ("camera", "projector"):
        assert figure[f"ratio_{lens}"] == pytest.approx(1, abs=0.15)
    # Twenty-odd correlated errors of one rig; intervals that are too narrow by half would give 2.
    assert figure["spread"] < 1.7


def test_artefacts_by_the_rig_found_are_as_good_as_by_the_true_one(one_rig, capsys):
    _, _, artefacts, _ = one_rig
    with capsys.disabled():
        print(
            "\nrig found, true rig, mm:", {name: tuple(round(v, 4) for v in pair) for name, pair in artefacts.items()}
        )
    for name in ("FLATNESS", "PROBING_FORM"):
        found, true = artefacts[name]
        assert found <= 1.5 * true
