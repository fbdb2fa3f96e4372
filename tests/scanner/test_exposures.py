"""Several exposures of one scan, on a bench whose truth is an array: what is gained, and that σ stays true.

The grey values of the scene were chosen on seed 0; all is judged on seeds 11 and above.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from graded import DARK, ELECTRONS, EXPOSURES, GLINT, GLOSSY, MATT, OWN_S, READ, graded_bench, job_of, run, zone

from drivers import NoiseModel
from scanner.config import GatesSection, ScanSection
from scanner.decoding import Decoder
from scanner.exposures import read_plan
from scanner.methods import METHODS
from scanner.processing import process_take
from scanner.quality import exposures_said
from scanner.result import Flag
from scanner.take import Take, TakeError


@pytest.fixture(scope="module")
def _shared():
    return {}


@pytest.fixture
def fused(tmp_path_factory, _shared):
    """Bench, job and maps of a scan at three exposures; made once."""
    if not _shared:
        bench = graded_bench()
        job = job_of(bench, tmp_path_factory.mktemp("fused"))
        _shared["of"] = bench, job, run(job)
    return _shared["of"]


def test_one_exposure_loses_what_several_have(fused, tmp_path):
    bench, _, maps = fused
    alone = run(job_of(graded_bench(), tmp_path, exposures=(1.0,)))
    shares = {gain: (alone.valid[zone(bench, gain)].mean(), maps.valid[zone(bench, gain)].mean()) for gain in
              (DARK, MATT, GLOSSY)}  # fmt: skip
    assert shares[DARK][0] < 0.05
    assert shares[GLOSSY][0] == 0
    assert shares[MATT][0] > 0.99
    for _, together in shares.values():
        assert together > 0.99
    assert (alone.valid & ~maps.valid).mean() < 0.001


def test_several_exposures_measure_the_union_of_what_each_measures(tmp_path):
    """Each alone is a scan of a bench whose own exposure it is."""
    union, scans = np.zeros((120, 160), bool), (4.0, 1.0, 0.125)
    for k, e in enumerate(scans):
        alone = run(job_of(graded_bench(seed=20 + k, exposure_s=e * OWN_S), tmp_path / str(k), "tps", 4, (1.0,)))
        assert alone.valid.mean() < 0.75
        union |= alone.valid
    together = run(job_of(graded_bench(seed=23), tmp_path / "all", "tps", 4, scans))
    assert union.mean() > 0.97
    # Where a pixel is barely bright enough, noise decides, and it helps the fused one.
    assert (union & ~together.valid).mean() < 0.002


def test_sigma_stays_true_in_every_stripe(fused):
    bench, _, maps = fused
    for gain in (DARK, MATT, GLOSSY):
        there = zone(bench, gain) & maps.valid
        for u, sigma, truth in ((maps.x_p, maps.sigma_x, bench.x), (maps.y_p, maps.sigma_y, bench.y)):
            z = ((u - truth) / sigma)[there]
            # Of n pixels the ratio is known to 1/√(2n); the noise model, estimated from the frames, adds its own 2 %.
            assert np.std(z) == pytest.approx(1, abs=0.03 + 3 / np.sqrt(2 * z.size))
            assert abs(z.mean()) < 4 / np.sqrt(z.size) + 0.03


def test_sigma_is_that_of_inverse_variances(fused):
    bench, job, maps = fused
    frequencies = np.array([s.frequency for s in METHODS["mfs1"].first_round(job.scan, bench.size).fringes("x")])
    for gain in (DARK, MATT, GLOSSY):
        light = bench.ambient + gain * 127.5
        information = 0.0
        for e in EXPOSURES:
            if e * (bench.ambient + gain * 255) + bench.black < 0.95 * 255:
                information += e**2 / (READ**2 + 1 / 12 + ELECTRONS * e * light)
        sigma_z = np.sqrt(2 / 6 / information)
        # The projector's pixels sample a fringe of 16 px; its modulation is that of the picture, to rounding.
        expected = sigma_z / (gain * 127.5) / (2 * np.pi * np.sqrt(np.square(frequencies).sum()))
        found = np.median(maps.sigma_x[zone(bench, gain) & maps.valid])
        assert found == pytest.approx(expected, rel=0.04)


def test_what_saturates_in_all_is_never_decoded(fused):
    bench, _, maps = fused
    glint = bench.gain == GLINT
    assert not maps.valid[glint].any()
    assert (maps.flags[glint] & Flag.SATURATED).all()
    assert not (maps.flags[~glint] & Flag.SATURATED).any()


def test_figures_say_what_each_exposure_was_good_for(fused):
    bench, job, _ = fused
    own, long, short = job.exposure_figures
    assert [f["exposure_s"] for f in (own, long, short)] == [OWN_S, 4 * OWN_S, OWN_S / 8]
    assert own["used_share"] == pytest.approx((bench.gain <= MATT).mean(), abs=1e-3)
    assert long["used_share"] == pytest.approx((bench.gain == DARK).mean(), abs=1e-3)
    assert short["saturated_share"] == pytest.approx((bench.gain == GLINT).mean(), abs=1e-3)
    assert own["measured_relative"] == pytest.approx(1, rel=0.02)
    assert not [n for n in job.notes if "linear" in n]


def test_the_bench_is_left_as_it_was_and_dark(fused):
    bench, _, _ = fused
    assert bench.exposure_s == OWN_S
    assert bench.dark
    # Agreed to first; then looked at; then one whole pass after the other.
    wanted = [OWN_S * e for e in EXPOSURES]
    assert bench.asked == [*wanted, OWN_S, *wanted, *wanted, OWN_S]


def test_processing_the_take_gives_the_same_maps(fused):
    _, job, maps = fused
    take = Take.open(job.take.path)
    plan, series = read_plan(take.rounds[1])
    assert series is not None
    assert series.made_s == tuple(OWN_S * e for e in EXPOSURES)
    assert len(take.sequences(1)) == 3 * len(plan.sequences)
    again = process_take(take, job.scan, GatesSection(), None)
    for name in ("x_p", "y_p", "sigma_x", "sigma_y", "modulation", "flags", "interreflection"):
        assert np.array_equal(getattr(again.maps, name), getattr(maps, name), equal_nan=name not in ("flags",)), name
    assert again.summary["exposures"] == job.exposure_figures
    json.dumps(again.summary)
    assert exposures_said(again).startswith("40 ms for 68.4 %, 160 ms for 31.2 %, 5 ms for 99.7 %")


@pytest.mark.parametrize("method", ["tps", "mps_gn", "embedded", "xor", "modulated"])
def test_every_method_gets_fused_frames(tmp_path, method):
    bench = graded_bench(seed=12)
    maps = run(job_of(bench, tmp_path, method, steps=4, exposures=(4.0, 0.125, 1.0), axes=("x",)))
    assert not maps.valid[bench.gain == GLINT].any()
    for gain in (MATT, GLOSSY):
        there = zone(bench, gain)
        assert maps.valid[there].mean() > 0.8
        z = ((maps.x_p - bench.x) / maps.sigma_x)[there & maps.valid]
        # The coarse code of few steps leaves a wrong fringe here and there: the middle of the distribution is judged.
        assert 1.4826 * np.median(np.abs(z - np.median(z))) == pytest.approx(1, abs=0.1)


def test_two_rounds_fuse_each_and_the_bounce_goes(array_bench, tmp_path):
    bounced = array_bench()
    bench = graded_bench(alpha=bounced.alpha, seed=13)
    bench.gain = np.where(bench.gain == DARK, 0.15, bench.gain)
    job = job_of(bench, tmp_path, "mfs", steps=4, exposures=(1.0, 0.125))
    maps = run(job)
    region = (bench.alpha > 0) & zone(bench, 0.15)
    assert (maps.interreflection[region]).mean() > 0.98
    second = region & ((maps.flags & Flag.SECOND_ROUND) != 0)
    assert second.sum() / region.sum() > 0.95
    z = ((maps.x_p - bench.x) / maps.sigma_x)[second]
    assert 1.4826 * np.median(np.abs(z)) == pytest.approx(1, abs=0.08)
    assert job.frames == {1: 144, 2: 144}
    again = process_take(Take.open(job.take.path), job.scan, GatesSection(), None)
    assert np.array_equal(again.maps.x_p, maps.x_p, equal_nan=True)


def test_a_dark_round_does_not_lower_the_noise(array_bench, tmp_path):
    # Round two lights little of the picture; its σ is that of the light there, as round one has measured it.
    bench = graded_bench(alpha=np.zeros_like(array_bench().alpha), seed=14)
    bench.alpha[54:62, 62:70] = 0.5
    job = job_of(bench, tmp_path, "mfs", steps=4, exposures=(1.0, 0.5))
    noises = []
    at = job.decoder.noise_at
    job.decoder.noise_at = lambda exposure, frames: noises.append((exposure, at(exposure, frames))) or noises[-1][1]
    run(job)
    assert [exposure for exposure, _ in noises] == [0, 1, 0, 1]
    for exposure, noise in noises:
        assert noise.variance(120.0) == pytest.approx(READ**2 + 1 / 12 + 120 * ELECTRONS, rel=0.25), exposure


def test_an_exposure_that_round_one_lacks_has_round_ones_noise_in_round_two(array_bench, tmp_path, monkeypatch):
    bench = graded_bench(alpha=np.zeros_like(array_bench().alpha), seed=15)
    bench.alpha[54:62, 62:70] = 0.5
    job = job_of(bench, tmp_path, "mfs", steps=4, exposures=(1.0, 0.5))
    run(job)
    take, noises = Take.open(job.take.path), []
    frames, at = Take.frames, Decoder.noise_at

    def without_one(self, number, sequence, *, verify=True):
        if (number, sequence) == (1, len(self.sequences(1)) // 2):
            raise TakeError("damaged", "")
        return frames(self, number, sequence, verify=verify)

    def noted(self, exposure, collected):
        noises.append((exposure, at(self, exposure, collected)))
        return noises[-1][1]

    monkeypatch.setattr(Take, "frames", without_one)
    monkeypatch.setattr(Decoder, "noise_at", noted)
    process_take(take, job.scan, GatesSection(), None)
    assert [exposure for exposure, _ in noises] == [0, 0, 1]  # round one at one exposure, round two at both
    assert noises[0][1] == noises[1][1] == noises[2][1]
    assert noises[0][1].variance(120.0) == pytest.approx(READ**2 + 1 / 12 + 120 * ELECTRONS, rel=0.25)


def test_noise_is_warned_of_once_whatever_the_ratio():
    class Frames:
        def __init__(self, read_dn):
            self.found = None if read_dn is None else NoiseModel(read_dn)

        def estimate_noise(self):
            return self.found

    decoder = Decoder(METHODS["tps"], ScanSection(), NoiseModel(1.0), None)
    for exposure, read_dn in enumerate((2.0, 3.0, 4.0)):
        assert decoder.noise_at(exposure, Frames(read_dn)).read_dn == read_dn
    assert len(decoder.warnings) == 1
    assert "2.0 × as noisy" in decoder.warnings[0]
    unknown = Decoder(METHODS["tps"], ScanSection(), None, None)
    for exposure in range(3):
        unknown.noise_at(exposure, Frames(None))
    assert len(unknown.warnings) == 1


def test_newer_takes_are_told_from_older_ones(fused):
    _, job, _ = fused
    assert json.loads((job.take.path / "manifest.json").read_text())["schema"] == 2
    plan, series = read_plan(Take.open(job.take.path).rounds[1])
    assert read_plan(series.recorded(replace(plan, mask=None)))[1] == series
