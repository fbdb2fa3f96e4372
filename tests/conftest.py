"""A bench for tests whose truth is an array: every pixel sees one or two given places of the projector's picture."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splines import coefficients, looked_up

from drivers import FrameFormat, FrameStamp, NoiseModel


def pytest_addoption(parser):
    parser.addoption(
        "--hardware",
        metavar="FILE",
        help="bench file of real devices: the conformance suites run on them as well (they light up and flash)",
    )


HERE = Path(__file__).parent
TIMED = (
    "conformance", "drivers/test_doctor", "drivers/test_genicam_faults", "drivers/test_genicam_traps",
    "drivers/test_process", "drivers/test_trigger_box", "drivers/test_window", "scanner/test_cli_interrupted",
    "scanner/test_preview", "sim_backend/gentl", "sim_backend/test_trigger_box", "sim_backend/test_world",
    "sim_backend/test_xserver", "test_virtual",
)  # fmt: skip
"""Where tests live on real time, windows or processes of their own: they have the machine to themselves, two by two."""

LONGEST = (
    "test_numbers", "test_calibration_numbers", "calibration/test_wizard", "scanner/test_ripples",
    "scanner/test_acquisition", "real/test_slstudio_calibration", "calibration/test_detection",
    "scanner/test_folds", "scanner/test_matt_objects", "sim_backend/test_scenes", "scanner/test_cli",
    "scanner/test_regional", "calibration/test_person",
    "test_virtual_faults", "test_virtual_bench", "scanner/test_cli_interrupted", "drivers/test_window_faults",
)  # fmt: skip
"""What takes longest begins first, so that no worker is left with it when the others have nothing to do any more."""


def pytest_collection_modifyitems(items):
    places = {item: item.path.relative_to(HERE).as_posix() for item in items if item.path.is_relative_to(HERE)}
    for item, place in places.items():
        if place.startswith(TIMED):
            item.add_marker(pytest.mark.timed)
    turns = {f"{name}.py": turn for turn, name in enumerate(LONGEST)}
    items.sort(key=lambda item: turns.get(places.get(item, ""), len(turns)))


def pytest_configure(config):
    # A shell that starts the tests in the background has them ignore Ctrl-C, and with them all they start.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # The suites look for their subjects while tests are collected.
    if config.getoption("--hardware"):
        os.environ["MFS_SCANNER_HARDWARE"] = str(Path(config.getoption("--hardware")).resolve())


class CountingClock:
    """Time that passes only when somebody sleeps."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


@dataclass
class ArrayBench:
    """Pixel = ambient + gain·(P(x, y) + α·P(x', y')) + noise, P the picture between its pixels.

    The noise is that of reading and, with ``dn_per_electron``, of light.

    ``on_expose(number, index)`` may raise, or return the index of the picture that is really exposed.
    """

    x: np.ndarray
    y: np.ndarray
    alpha: np.ndarray
    x_bounce: np.ndarray
    y_bounce: np.ndarray
    size: tuple[int, int] = (320, 200)
    gain: float = 0.6
    ambient: float = 4.0
    sigma: float = 1.5
    dn_per_electron: float = 0.0
    seed: int = 0
    rig: Any = None
    on_expose: Any = None
    name: str = "array"
    simulated: bool = True
    clock: CountingClock = field(default_factory=CountingClock)
    exposures: int = 0
    dark: bool = True
    darkened: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._pictures: list[np.ndarray] = []
        self._looked_up: list[tuple[np.ndarray, np.ndarray, Any]] = []

    @property
    def projector_size(self) -> tuple[int, int]:
        return self.size

    @property
    def frame_format(self) -> FrameFormat:
        return FrameFormat(self.x.shape[1], self.x.shape[0], 8)

    @property
    def noise(self) -> NoiseModel | None:
        return NoiseModel(float(np.sqrt(self.sigma**2 + 1 / 12)), self.dn_per_electron)

    def prepare(self, patterns) -> None:
        self._pictures = [p.astype(np.float32) for p in patterns]

    def light(self, picture: np.ndarray) -> np.ndarray:
        spline = coefficients(picture).ravel()

        def at(x, y):
            return (self._weights(x, y, picture.shape) @ spline).reshape(x.shape)

        bounce = self.alpha * at(self.x_bounce, self.y_bounce) if self.alpha.any() else 0.0
        return self.ambient + self.gain * (at(self.x, self.y) + bounce)

    def _weights(self, x, y, shape):
        for known_x, known_y, weights in self._looked_up:
            if np.array_equal(known_x, x) and np.array_equal(known_y, y):
                return weights
        self._looked_up.append((x.copy(), y.copy(), looked_up(x, y, shape)))
        return self._looked_up[-1][2]

    def expose(self, index, out) -> FrameStamp:
        number, self.exposures, self.dark = self.exposures, self.exposures + 1, False
        shown = index
        if self.on_expose is not None:
            answer = self.on_expose(number, index)
            shown = index if answer is None else answer
        ideal = self.light(self._pictures[shown])
        deviation = np.sqrt(self.sigma**2 + self.dn_per_electron * np.maximum(ideal, 0))
        out[:] = np.clip(np.rint(ideal + deviation * self._rng.normal(0, 1, ideal.shape)), 0, 255)
        self.clock.sleep(0.05)
        return FrameStamp(number, self.clock.now(), self.clock.now(), self.clock.now())

    def darken(self) -> None:
        self.dark = True
        self.darkened += 1

    def describe(self) -> dict[str, Any]:
        return {"name": self.name}


@pytest.fixture
def array_bench():
    """A slanted surface of 120 × 160 pixels; a rectangle of it also sees a mirror image, shifted by 130 px."""

    def make(**changes: Any) -> ArrayBench:
        rows, columns = np.mgrid[0:120, 0:160].astype(float)
        x, y = 20.3 + 1.1 * columns + 0.05 * rows, 15.7 + 1.2 * rows
        alpha = np.zeros_like(x)
        alpha[30:90, 20:70] = 0.5
        values: dict[str, Any] = {
            "x": x,
            "y": y,
            "alpha": alpha,
            "x_bounce": 290 - 0.9 * (x - 40),
            "y_bounce": y + 11,
        }
        return ArrayBench(**(values | changes))

    return make


@pytest.fixture(scope="session")
def transport_cache(tmp_path_factory):
    """Keep traced light in a folder of this test run."""
    folder = tmp_path_factory.mktemp("transport")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFS_SCANNER_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def scan_simulated(transport_cache, tmp_path_factory):
    """Scan a simulated scene with a method; returns (maps, truth). The same scan is made once."""
    import json

    from scanner.acquisition import Acquisition
    from scanner.config import ScanSection
    from scanner.decoding import Decoder
    from scanner.methods import METHODS
    from scanner.rig import Rig
    from scanner.take import TakeWriter
    from sim_backend.bench import kind, truth_of
    from sim_backend.settings import SimulatedSettings

    done: dict[str, Any] = {}

    def scan(scene: dict[str, Any], method: str = "mfs", options: dict[str, Any] | None = None, **settings: Any):
        key = json.dumps([scene, method, options, settings], sort_keys=True)
        if key not in done:
            done[key] = run(scene, method, options, settings)
        return done[key]

    def run(scene, method, options, settings):
        wanted = SimulatedSettings.model_validate({"scene": scene, **settings})
        section, chosen = ScanSection(method=method, **(options or {})), METHODS[method]
        with kind.open(wanted) as bench:
            plan = chosen.first_round(section, bench.projector_size)
            folder = tmp_path_factory.mktemp("scan")
            manifest = {"method": method, "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": True}
            with TakeWriter.create(
                folder / "take", frame_format=bench.frame_format, slots=plan.frame_count, manifest=manifest
            ) as take:
                decoder = Decoder(chosen, section, bench.noise, Rig.from_json(bench.rig))
                maps = Acquisition(bench, chosen, section, decoder, take).run()
        # The frames of one scan fill 340 MB; the maps are all that is judged.
        (folder / "take" / "frames.bin").unlink()
        return maps, truth_of(wanted)

    return scan
