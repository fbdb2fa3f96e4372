"""Measuring the display latency of a configured bench, and where it is kept."""

from __future__ import annotations

import json

import pytest

from drivers import DeviceSettingError, HardwareError
from scanner.acquisition import Silence
from scanner.config import load_config
from scanner.rig import Rig
from scanner.session import latency_of, measure_latency, run_scan

LATENCY_S, REFRESH_HZ = 0.035, 60

BENCH = """
bench:
  kind: simulated
  scene: {name: plane}
  camera: {width_px: 96, height_px: 72, exposure_us: 4000}
  projector: {width_px: 160, height_px: 100, latency_s: 0.035, refresh_hz: 60}
  transport: {photons: 1000, supersample: 1}
"""


class Notes(Silence):
    """Keeps what the operator reads, in the order of the first frame and the notes."""

    def __init__(self):
        self.said = []

    def note(self, text):
        self.said.append(text)

    def frame(self, progress):
        if "frame" not in self.said:
            self.said.append("frame")


def silent(done, total):
    pass


def test_latency_is_kept_with_the_rig(transport_cache, tmp_path):
    config = tmp_path / "bench.yaml"
    config.write_text(BENCH)
    loaded = load_config(config)
    Rig.from_json(loaded.config.bench.settings.rig().to_json()).save(tmp_path / "rig.json")
    before = json.loads((tmp_path / "rig.json").read_text())
    config.write_text(BENCH + "rig: rig.json\n")
    steps = []
    latency, path = measure_latency(load_config(config), lambda done, total: steps.append((done, total)))
    assert path == tmp_path / "rig.json"
    assert steps[-1] == (50, 50)
    # A picture appears at the first refresh after the latency; the camera resolves a read-out of 5 ms.
    assert LATENCY_S <= latency.median_s <= latency.p99_s <= LATENCY_S + 1 / REFRESH_HZ + 0.0055
    after = json.loads(path.read_text())
    assert latency_of(Rig.load(path)) == latency
    assert after["metadata"].pop("display_latency")
    assert after == before
    assert not list(tmp_path.glob(".*partial"))


def test_latency_without_a_rig_is_told_and_nothing_is_written(transport_cache, tmp_path):
    config = tmp_path / "bench.yaml"
    config.write_text(BENCH)
    latency, path = measure_latency(load_config(config), silent)
    assert path is None
    assert latency.median_s > LATENCY_S
    assert [p.name for p in tmp_path.iterdir()] == ["bench.yaml"]


def test_rig_whose_latency_is_nonsense_is_refused(transport_cache, tmp_path):
    config = tmp_path / "bench.yaml"
    config.write_text(BENCH)
    rig = load_config(config).config.bench.settings.rig()
    with pytest.raises(DeviceSettingError, match="scan latency"):
        latency_of(Rig(rig.camera, rig.projector, rig.rotation, rig.translation, {"display_latency": {"median": 1}}))


def test_bench_that_knows_when_a_pattern_is_on_needs_no_latency(array_bench, monkeypatch, tmp_path):
    from contextlib import nullcontext

    from scanner import session

    monkeypatch.setattr(session, "open_bench", lambda loaded: nullcontext(array_bench()))
    with pytest.raises(HardwareError, match="knows by itself"):
        measure_latency(None, silent)


def test_the_rig_of_another_program_scans_and_what_it_lacks_is_said_first(transport_cache, tmp_path):
    config = tmp_path / "bench.yaml"
    scan = "scan: {method: tps, steps: 4, axes: [x]}\noutput: {report: false, keep_take: false}\nrig: rig.json\n"
    config.write_text(BENCH)
    rig = load_config(config).config.bench.settings.rig()
    metadata = {"calibration": {"parameters": ["tripod.height"], "covariance": [[1.0]]}}
    Rig(rig.camera, rig.projector, rig.rotation, rig.translation, metadata).save(tmp_path / "rig.json")
    config.write_text(BENCH.replace("camera:", "settle_s: 0.2\n  camera:", 1) + scan)
    notes = Notes()
    result, _ = run_scan(load_config(config), tmp_path / "out", False, notes)
    (said,) = (w for w in result.warnings if "sigma_rig" in w)
    assert "tripod.height" in said
    assert notes.said.index(said) < notes.said.index("frame")
    assert result.maps.sigma_rig is None
    assert result.maps.valid.any()
