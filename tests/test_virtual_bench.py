"""The bench kind ``virtual``: whole scans through the real drivers, and what is left when they end."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import psutil
import pytest
from leftovers import shared_memory
from virtual import SMALL, all_photographed, photographed, require_virtual_bench, sequence, small
from windows import within

from drivers import HardwareError
from drivers.examination import Verdict
from scanner.acquisition import Acquisition
from scanner.config import ScanSection, load_config
from scanner.decoding import Decoder
from scanner.methods import METHODS
from scanner.rig import Rig
from scanner.take import TakeWriter
from sim_backend.bench import kind as simulated
from sim_backend.bench import truth_of
from sim_backend.settings import SimulatedSettings
from sim_backend.virtual_bench import kind, open_bench, open_world
from sim_backend.virtual_settings import VirtualSettings

SCENE = {
    "scene": {"name": "mirror", "mirror_tilt_deg": 3.0, "yaw_deg": 2.0},
    "camera": {"width_px": 512, "height_px": 384},
    "projector": {"latency_s": 0.01},
    "transport": {"photons": 1_000_000, "supersample": 2},
}


@pytest.fixture(scope="module", autouse=True)
def _possible():
    require_virtual_bench()


def scanned(bench_kind, settings, folder):
    """Maps of a two-round scan."""
    section, method = ScanSection(method="mfs", steps=6), METHODS["mfs"]
    with bench_kind.open(settings) as bench:
        plan = method.first_round(section, bench.projector_size)
        manifest = {"method": "mfs", "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": bench.simulated}
        with TakeWriter.create(
            folder / "take", frame_format=bench.frame_format, slots=plan.frame_count, manifest=manifest
        ) as take:
            decoder = Decoder(method, section, bench.noise, Rig.from_json(bench.rig))
            return Acquisition(bench, method, section, decoder, take).run()


@pytest.fixture(scope="module")
def truth(transport_cache):
    return truth_of(SimulatedSettings.model_validate(SCENE))


@pytest.fixture(scope="module")
def in_process(transport_cache, tmp_path_factory):
    settings = SimulatedSettings.model_validate(SCENE | {"seed": 1})
    return scanned(simulated, settings, tmp_path_factory.mktemp("simulated"))


@pytest.fixture(scope="module")
def virtual(transport_cache, tmp_path_factory):
    settings = VirtualSettings.model_validate(SCENE | {"seed": 2})
    return scanned(kind, settings, tmp_path_factory.mktemp("virtual"))


@pytest.fixture(scope="module")
def parts(truth):
    """Pixels with direct light, of these with a bounce, and without."""
    direct = np.isfinite(truth.x_p) & ~truth.edge
    with np.errstate(invalid="ignore"):
        bounced = truth.alpha > 0.02
    region, clean = bounced & direct, direct & (np.nan_to_num(truth.alpha, nan=1) < 1e-4)
    assert region.mean() > 0.05
    assert clean.mean() > 0.3
    return direct, region, clean


def test_bounces_are_found_through_the_real_drivers(virtual, parts):
    direct, region, _ = parts
    found = virtual.interreflection & direct
    hits = (found & region).sum()
    assert hits / region.sum() >= 0.98
    assert hits / found.sum() >= 0.98


@pytest.mark.parametrize("axis", ["x", "y"])
def test_coordinates_are_as_good_as_in_process(virtual, truth, parts, axis):
    """The figures of tests/test_numbers.py."""
    _, region, clean = parts
    error = getattr(virtual, f"{axis}_p") - getattr(truth, f"{axis}_p")
    known = np.isfinite(error)
    inside = np.abs(error[region & known])
    assert inside.size / region.sum() >= 0.97
    assert (inside <= 0.25).mean() >= 0.98
    assert (inside > 8).mean() <= 0.005
    assert (clean & known).sum() / clean.sum() > 0.995
    bound = np.median(1 / truth.direct_amplitude[region]) * np.median(truth.direct_amplitude[clean])
    assert np.median(inside) <= 1.2 * max(1.0, bound) * np.median(np.abs(error[clean & known]))
    sigma = getattr(virtual, f"sigma_{axis}")
    assert (error[clean & known] / sigma[clean & known]).std() == pytest.approx(1, abs=0.20)
    # In the small region a single wrong pixel would make a standard deviation; the median says what is typical.
    assert np.median(np.abs(error[region & known]) / sigma[region & known]) == pytest.approx(0.674, abs=0.14)


def test_with_the_same_noise_frames_are_those_of_the_simulation_in_process_to_the_last_bit(transport_cache):
    """Window, X server, GenTL and all that is between them change nothing in a pattern or a frame."""
    settings = SCENE | {"camera": {"width_px": 256, "height_px": 192, "electrons_per_dn": 40.0}, "seed": 9}
    columns = np.arange(1280)
    waves = [np.rint(127.5 + 127.5 * np.cos(columns / 3 + step)).astype(np.uint8) for step in range(4)]
    frames = []
    for bench_kind, model in ((simulated, SimulatedSettings), (kind, VirtualSettings)):
        with bench_kind.open(model.model_validate(settings)) as bench:
            bench.prepare([np.tile(wave, (800, 1)) for wave in waves])
            frames.append(all_photographed(bench, waves)[0])
    np.testing.assert_array_equal(*frames)


def test_its_cloud_agrees_with_the_one_in_process_within_noise(virtual, in_process, parts):
    direct, region, _ = parts
    valid = [np.isfinite(maps.points[..., 2]) for maps in (virtual, in_process)]
    assert (valid[0] == valid[1])[direct].mean() > 0.995
    both = valid[0] & valid[1] & direct
    apart = np.linalg.norm(virtual.points - in_process.points, axis=-1)
    in_sigma = apart / np.hypot(virtual.sigma_point, in_process.sigma_point)
    for part in (both, both & region):
        # Points differ along the camera's ray only: the magnitude of one Gaussian, whose median is 0.674.
        assert np.median(in_sigma[part]) == pytest.approx(0.674, abs=0.07)
        assert (in_sigma[part] > 3).mean() < 0.01


def test_the_shipped_configuration_is_this_kind_with_the_scene_of_the_demo():
    here, demo = (
        load_config(Path(__file__).parents[1] / "configs" / f"{name}.yaml") for name in ("virtual_bench", "demo")
    )
    assert here.bench_kind is kind
    shared = set(SimulatedSettings.model_fields) & set(VirtualSettings.model_fields) - {
        "settle_s",
        "camera",
        "projector",
    }
    for name in shared:
        assert getattr(here.bench_settings, name) == getattr(demo.bench_settings, name), name
    for part in ("camera", "projector"):
        theirs = getattr(demo.bench_settings, part).model_dump()
        assert theirs.items() <= getattr(here.bench_settings, part).model_dump().items()
    assert here.config.scan == demo.config.scan


def test_it_examines_itself():
    (finding,) = kind.examine(small())
    assert finding.verdict is Verdict.OK


def test_what_is_missing_is_found_and_named(nothing_left, monkeypatch):
    monkeypatch.setenv("PATH", "")
    (finding,) = kind.examine(small())
    assert finding.verdict is Verdict.FAULT
    assert "Xvfb" in finding.text
    assert "apt install" in finding.remedy


@pytest.fixture
def nothing_left(tmp_path, monkeypatch):
    """No process, folder, shared memory or variable is left of what the test opens."""

    def processes():
        return {child for child in psutil.Process().children(recursive=True) if "resource_tracker" not in line(child)}

    def variables():
        return {name for name in os.environ if name.startswith("MFS_SIM_")}

    before = processes(), variables(), shared_memory()
    with tempfile.TemporaryDirectory(prefix="vb-") as folder:
        monkeypatch.setattr(tempfile, "tempdir", folder)
        monkeypatch.setenv("TMPDIR", folder)
        yield
        _, alive = psutil.wait_procs(processes() - before[0], 30.0)
        assert not alive
        assert not os.listdir(folder)
    assert variables() == before[1]
    assert within(30.0, lambda: shared_memory() <= before[2])


def line(process):
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


@pytest.fixture(scope="module")
def pattern():
    return np.random.default_rng(3).integers(0, 256, (200, 320), np.uint8)


def test_nothing_is_left_of_a_good_scan_and_a_second_bench_is_refused_meanwhile(nothing_left, pattern):
    with kind.open(small()) as bench:
        assert bench.simulated
        assert bench.rig == small().rig().to_json()
        with pytest.raises(HardwareError, match="another virtual bench is open"), kind.open(small()):
            pass
        (frame,), _ = sequence(bench, [pattern])
    np.testing.assert_array_equal(frame, pattern)


def test_nothing_is_left_after_an_interruption(nothing_left):
    with pytest.raises(KeyboardInterrupt), kind.open(small()):
        raise KeyboardInterrupt


def test_nothing_is_left_when_the_world_dies(nothing_left, pattern):
    with open_world(small()) as (process, ends), pytest.raises(HardwareError), open_bench(small(), ends) as bench:
        kill_and_go_on(bench, process.pid, pattern)


def kill_and_go_on(bench, pid, pattern):
    bench.timeout_s = 0.5
    bench.prepare([pattern])
    os.kill(pid, signal.SIGKILL)
    while True:
        photographed(bench, 0)


_PROGRAM = """
from sim_backend.virtual_bench import kind
from sim_backend.virtual_settings import VirtualSettings

if __name__ == "__main__":
    with kind.open(VirtualSettings.model_validate({settings})):
        print("open", flush=True)
        time.sleep(60)
"""


def test_nothing_is_left_when_the_program_is_killed(nothing_left, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(_PROGRAM.format(settings=SMALL))
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "open\n"
        family = psutil.Process(process.pid).children(recursive=True)
        assert any("Xvfb" in line(child) for child in family)
        process.kill()
    _, alive = psutil.wait_procs(family, 30.0)
    assert not alive
