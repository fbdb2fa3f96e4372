"""Several exposures of one scan: recordings that end early, cameras that do not obey, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from graded import GLOSSY, MATT, OWN_S, graded_bench, job_of, run, zone
from pydantic import ValidationError

from drivers import DeviceSettingError, FrameTimeoutError
from scanner.config import GatesSection, ScanSection
from scanner.exposures import LightRatio, agree, read_plan
from scanner.preflight import ExposureError
from scanner.processing import process_take
from scanner.result import Flag
from scanner.take import Take, TakeWriter


class TestCut:
    """A recording that ends in the second of two exposures."""

    def cut(self, folder, at):
        def stop(number, index):
            if number == at:
                raise KeyboardInterrupt

        bench = graded_bench(seed=14, on_expose=stop)
        job = job_of(bench, folder, "tps", steps=4, exposures=(1.0, 0.125))
        with pytest.raises(KeyboardInterrupt):
            run(job)
        return bench, job

    # Two exposure checks of two frames, then 24 frames at each exposure, in sequences of four.
    def test_one_complete_exposure_is_processed_alone(self, tmp_path):
        bench, job = self.cut(tmp_path, 4 + 24 + 9)
        result = process_take(Take.open(job.take.path), job.scan, GatesSection(), None)
        assert result.maps.valid[zone(bench, MATT)].mean() > 0.99
        assert not result.maps.valid[zone(bench, GLOSSY)].any()
        assert (result.maps.flags[zone(bench, GLOSSY)] & Flag.SATURATED).all()
        assert any("2 of 6 sequences are there; it is left out" in w for w in result.warnings)

    def test_it_can_be_resumed_and_completed(self, tmp_path):
        bench, job = self.cut(tmp_path, 4 + 24 + 9)
        bench.on_expose = None
        resumed = TakeWriter.resume(job.take.path)
        plan, series = read_plan(resumed.take.rounds[1])
        assert resumed.committed == frozenset((1, s) for s in range(6 + 2))
        with resumed.writer as writer:
            writer.begin_round(1, series.recorded(plan))
            bench.set_exposure(series.made_s[1])
            frame = np.empty(bench.frame_format.shape, np.uint8)
            for number in range(8, 12):
                bench.prepare(plan.render(number % 6))
                for index in range(4):
                    writer.write_frame(1, number, 2, index, frame, bench.expose(index, frame))
                writer.commit_sequence(1, number, 2)
        result = process_take(Take.open(job.take.path), job.scan, GatesSection(), None)
        assert result.maps.valid[zone(bench, GLOSSY)].mean() > 0.99
        assert result.maps.valid[zone(bench, MATT)].mean() > 0.99

    def test_with_none_complete_the_fullest_is_taken(self, tmp_path):
        bench, job = self.cut(tmp_path, 4 + 21)
        result = process_take(Take.open(job.take.path), job.scan, GatesSection(), None)
        assert result.maps.y_p is None
        assert np.isfinite(result.maps.x_p[zone(bench, MATT)]).mean() > 0.99


def test_a_device_that_fails_at_one_exposure_costs_one_sequence(tmp_path):
    def once(number, index):
        if number == 40:
            bench.on_expose = None
            raise FrameTimeoutError("late", "wait")

    bench = graded_bench(seed=15, on_expose=once)
    job = job_of(bench, tmp_path, "tps", steps=4, exposures=(1.0, 0.125))
    maps = run(job)
    assert job.repeats == 4
    assert maps.valid[zone(bench, GLOSSY)].mean() > 0.99
    assert any("exposure 2 of 2" in note for note in job.notes)


class TestLinearity:
    def test_a_camera_that_bends_light_is_told(self, tmp_path):
        bench = graded_bench(gamma=0.93, seed=16)
        job = job_of(bench, tmp_path, "tps", steps=6, exposures=(1.0, 0.25))
        run(job)
        said = [n for n in job.notes if "does not respond linearly" in n]
        # 0.25^0.93 = 0.275
        assert len(said) == 1
        assert "gives 0.27" in said[0]

    def test_one_that_clamps_silently_is_refused_before_anything_is_recorded(self, tmp_path):
        bench = graded_bench(longest_s=2 * OWN_S, says_so=False)
        job = job_of(bench, tmp_path, exposures=(4.0, 1.0))
        with pytest.raises(ExposureError, match=r"40 ms give 0.(4[7-9]|5[0-3]) of the light of 160 ms, not 0.25"):
            run(job)
        assert not Take.open(job.take.path).rounds
        assert bench.dark

    def test_one_that_says_that_it_clamps_is_refused_before_anything_is_projected(self):
        bench = graded_bench(longest_s=2 * OWN_S)
        with pytest.raises(DeviceSettingError, match="makes 80000 µs of an exposure of 160000 µs"):
            agree(bench, (4.0, 1.0))
        assert bench.exposures == 0
        assert bench.exposure_s == OWN_S

    def test_noise_does_not_flatten_the_ratio(self):
        random = np.random.default_rng(17)
        light = 20 * np.cos(2 * np.pi * (np.arange(6)[:, None] / 6 + random.uniform(size=4000)))
        long = light + random.normal(0, 3, light.shape)
        short = 5 + 0.25 * light + random.normal(0, 1, light.shape)
        ratio = LightRatio(np.ones(4000, bool), np.full(4000, 9, np.float32))
        ratio.add(long.astype(np.float32), short.astype(np.float32))
        # σ of the slope: noise of both over the spread of the light, 1.25 / 14 / √24000.
        assert ratio.measured == pytest.approx(0.25, abs=4 * 1.25 / 14 / np.sqrt(24000))


def test_without_several_exposures_nothing_is_asked_and_nothing_is_written_of_them(tmp_path):
    bench = graded_bench(seed=18)
    job = job_of(bench, tmp_path, "tps", exposures=(1.0,))
    run(job)
    assert bench.asked == []
    manifest = json.loads((job.take.path / "manifest.json").read_text())
    assert manifest["schema"] == 1
    assert "exposures" not in manifest["plans"][0]
    assert job.frames == {1: 36}


def test_a_bench_that_cannot_change_its_exposure_says_so(array_bench):
    with pytest.raises(DeviceSettingError, match="cannot change its exposure"):
        agree(array_bench(), (1.0, 0.5))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ([], "at least 1 item"),
        ([1, 0], "found 0, expected a factor above 0"),
        ([-1, 1], "found -1, expected a factor above 0"),
        ([1, 0.25, 1], "expected each exposure once"),
        ([0.5], "expected 1 where there is one exposure only"),
        ([1, 2, 3, 4, 5, 6, 7, 8, 9], "at most 8 items"),
        (["fast", 1], "valid number"),
    ],
)
def test_exposures_that_make_no_sense_are_refused_in_the_bench_file(given, says):
    with pytest.raises(ValidationError, match=says):
        ScanSection(exposures=given)


def test_fractions_are_exact():
    assert ScanSection(exposures=[1, "1/3"]).exposures == (1.0, 1 / 3)
