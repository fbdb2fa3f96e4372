"""A bench with parts of very different brightness and an exposure that can be set, and how it is scanned."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from conftest import ArrayBench

from drivers import DeviceSettingError, FrameStamp, NoiseModel
from scanner.acquisition import Acquisition, Silence
from scanner.config import ScanSection
from scanner.decoding import Decoder
from scanner.exposures import agree
from scanner.methods import METHODS
from scanner.take import TakeWriter

READ, ELECTRONS = 1.2, 0.025
"""Noise of a frame: σ in the dark, DN, and DN for each electron."""

DARK, MATT, GLOSSY, GLINT = 0.03, 0.5, 5.0, 60.0
"""Grey value for a projected one at the bench's own exposure; the first is too dark, the last two saturate."""

EXPOSURES = (1.0, 4.0, 0.125)
OWN_S = 0.04


@dataclass
class GradedBench(ArrayBench):
    """Four stripes of other brightness, and an exposure that can be set.

    The camera clamps at ``longest_s``, and says so or not; its grey values follow light to the power of ``gamma``.
    """

    exposure_s: float = OWN_S
    longest_s: float = 1.0
    says_so: bool = True
    gamma: float = 1.0
    black: float = 3.0
    asked: list[float] = field(default_factory=list)

    def check_exposure(self, exposure_s):
        if exposure_s > 10:
            raise DeviceSettingError("too long", "shorter")

    def set_exposure(self, exposure_s):
        self.asked.append(exposure_s)
        self.exposure_s = min(exposure_s, self.longest_s)
        return self.exposure_s if self.says_so else exposure_s

    @property
    def noise(self):
        return NoiseModel(float(np.sqrt(READ**2 + 1 / 12)), ELECTRONS)

    def expose(self, index, out):
        if self.on_expose is not None:
            self.on_expose(self.exposures, index)
        self.exposures += 1
        light = np.maximum(self.light(self._pictures[index]), 0)
        light = 255 * (light / 255 * self.exposure_s / OWN_S) ** self.gamma
        spread = np.sqrt(READ**2 + ELECTRONS * np.maximum(light, 0))
        out[:] = np.clip(np.rint(light + self.black + self._rng.normal(0, 1, light.shape) * spread), 0, 255)
        self.clock.sleep(0.05)
        return FrameStamp(self.exposures, self.clock.now(), self.clock.now(), self.clock.now())


def graded_bench(**changes) -> GradedBench:
    """A slanted surface without bounces in stripes of the four brightnesses."""
    rows, columns = np.mgrid[0:120, 0:160].astype(float)
    x, y = 20.3 + 1.1 * columns + 0.05 * rows, 15.7 + 1.2 * rows
    gain = np.full(x.shape, MATT)
    gain[:, :50], gain[:, 90:140], gain[50:56, 140:150] = DARK, GLOSSY, GLINT
    bounce = {"x_bounce": 290 - 0.9 * (x - 40), "y_bounce": y + 11}
    values = {"x": x, "y": y, "alpha": np.zeros_like(x), **bounce, "gain": gain, "ambient": 1.0, "seed": 11}
    return GradedBench(**(values | changes))


def job_of(bench, folder, method="mfs1", steps=6, exposures=EXPOSURES, **scan):
    section = ScanSection(
        method=method, steps=steps, exposures=exposures, max_saturated_share=0.9, detector="misfit", **scan
    )
    chosen = METHODS[method]
    plan, series = chosen.first_round(section, bench.projector_size), agree(bench, exposures)
    take = TakeWriter.create(
        folder / "take",
        frame_format=bench.frame_format,
        slots=plan.frame_count,
        manifest={
            "method": method,
            "bench": {},
            "config": {},
            "plans": [plan.to_json() if series is None else series.recorded(plan)],
            "simulated": True,
            "noise": {"read_dn": bench.noise.read_dn, "dn_per_electron": bench.noise.dn_per_electron},
        },
    )
    decoder = Decoder(chosen, section, bench.noise, None)
    return Acquisition(bench, chosen, section, decoder, take, Silence(), exposures=series)


def run(job):
    with job.take:
        return job.run()


def zone(bench, gain):
    """Pixels of a stripe, without its border."""
    inner = np.zeros(bench.gain.shape, bool)
    inner[2:-2, 2:-2] = True
    return (bench.gain == gain) & inner
