"""A scan corrects its patterns for the response that the rig holds, and says so."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from scanner.acquisition import Silence
from scanner.config import load_config
from scanner.processing import process_take
from scanner.response import PROJECTOR_RESPONSE, ProjectorResponse, ResponseError
from scanner.rig import Rig
from scanner.session import run_scan
from scanner.take import Take
from sim_backend.bench import truth_of

BENCH = """
bench:
  kind: simulated
  scene: {name: plane, yaw_deg: 10}
  camera: {width_px: 128, height_px: 96}
  projector: {width_px: 320, height_px: 200, gamma: 2.2}
  transport: {photons: 1000, supersample: 1}
rig: rig.json
gates: {min_valid_share: 0, max_misfit_share: 1, max_excess_misfit: 1000}
output: {ply: false, report: false}
"""


@pytest.fixture
def scan(transport_cache, tmp_path):
    """Scan a plane with three steps through a projector of γ = 2.2; gives the result, its folder and the x_p error."""

    def run(response=None, extra=""):
        config = tmp_path / "bench.yaml"
        (tmp_path / "rig.json").write_text("{}")
        config.write_text(
            BENCH + "scan: {method: tps, steps: 3, axes: [x], periods_px: [40, 320]" + extra + "}\n", encoding="utf-8"
        )
        settings = load_config(config).config.bench.settings
        rig = settings.rig()
        notes = {} if response is None else {PROJECTOR_RESPONSE: response}
        replace(rig, metadata={**rig.metadata, **notes}).save(tmp_path / "rig.json")
        result, folder = run_scan(load_config(config), tmp_path / "out", True, Silence())
        truth = truth_of(settings)
        error = (result.maps.x_p - truth.x_p)[~truth.edge]
        return result, folder, error[np.isfinite(error)]

    return run


def test_scan_corrects_what_the_rig_knows_and_says_so(scan, tmp_path):
    _, _, uncorrected = scan()
    result, folder, corrected = scan(ProjectorResponse.power(2.2).to_json())
    # Three steps at 40 px: 0.17 rad rms of harmonics are 1.1 px.
    assert np.sqrt(np.mean(uncorrected**2)) > 0.7
    assert np.sqrt(np.mean(corrected**2)) < 0.15
    config = load_config(tmp_path / "bench.yaml").config
    said = json.loads((folder / "result.json").read_text())["projector response"]
    assert said == result.summary["projector response"]
    assert "γ = 2.200" in said
    take = Take.open(folder / "take")
    assert take.manifest["plans"][0]["response"][128] == pytest.approx((128 / 255) ** 2.2, abs=1e-6)
    assert take.rounds[1]["response"] == take.manifest["plans"][0]["response"]
    again = process_take(take, config.scan, config.gates, Rig.load(folder / "rig.json"))
    assert again.summary["projector response"] == said


def test_correction_can_be_switched_off(scan):
    result, _, error = scan(ProjectorResponse.power(2.2).to_json(), ", correct_response: false")
    assert np.sqrt(np.mean(error**2)) > 0.7
    assert result.summary["projector response"] == "response taken as linear"


def test_a_response_that_is_none_is_refused_before_anything_is_projected(scan):
    with pytest.raises(ResponseError, match="cannot be used") as refusal:
        scan({"light": [0, 1]})
    assert "correct_response" in refusal.value.remedy
