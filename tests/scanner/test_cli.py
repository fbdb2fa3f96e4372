"""`scan` as an operator uses it: right and wrong, interrupted and killed, in a process of its own."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from scanner.take import Take

SCAN = [sys.executable, "-c", "from scanner.cli import main; main()"]

BENCH = """\
bench:
  kind: simulated
  seed: 3
  scene: {name: mirror}
  camera: {width_px: 256, height_px: 192, exposure_us: 14000}
  transport: {supersample: 2, photons: 400000}
scan:
  steps: 4
output: {report: false}
"""


@pytest.fixture
def ask(tmp_path, transport_cache, monkeypatch):
    """The same within this process, which has everything imported: for what needs no process of its own."""
    from scanner.cli import main

    monkeypatch.chdir(tmp_path)

    def go(*args: str) -> subprocess.CompletedProcess[str]:
        out, err = io.StringIO(), io.StringIO()
        monkeypatch.setattr(sys, "argv", ["scan", *args])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as ended:
            main()
        return subprocess.CompletedProcess(sys.argv, ended.value.code or 0, out.getvalue(), err.getvalue())

    return go


@pytest.fixture
def run(tmp_path, transport_cache):
    def go(*args: str, **changes: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*SCAN, *args],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
            env={**os.environ, **changes},
            check=False,
        )

    return go


@pytest.fixture
def bench_file(tmp_path):
    path = tmp_path / "bench.yaml"
    path.write_text(BENCH, encoding="utf-8")
    return path


def refused(done, *words, code=2):
    said = done.stderr + done.stdout
    assert done.returncode == code, said
    assert "Traceback" not in said
    assert "→" in said or "Usage" in said or "Invalid" in said
    for word in words:
        assert word in said, said
    return said


def test_scan_process_and_compare(run, ask, bench_file, tmp_path):
    done = run("--config", "bench.yaml", "--out", "result", "--set", "output.report=true")
    assert done.returncode == 0, done.stderr
    assert "round 2" in done.stdout
    assert "SIMULATED DATA" in done.stdout
    out = tmp_path / "result"
    assert {p.name for p in out.iterdir()} == {
        "result.json", "maps.npz", "cloud.ply", "report.html", "rig.json", "config.yaml", "take",
    }  # fmt: skip
    document = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert document["simulated"] is True
    maps = np.load(out / "maps.npz")
    for name in ("x_p", "y_p", "sigma_x", "sigma_y", "modulation", "interreflection", "flags", "depth", "points"):
        assert maps[name].shape[:2] == (192, 256)
    assert maps["lit"].shape == (800, 1280)
    assert maps["x_p"].dtype == np.float32
    assert (maps["flags"][np.isnan(maps["x_p"])] != 0).all()

    # The recording gives the same result again, to the last bit: nothing of the scan is lost in it.
    again = ask("process", "result/take", "--out", "again")
    assert again.returncode == 0, again.stderr
    assert "18 of 18 sequences" in again.stdout
    second = np.load(tmp_path / "again" / "maps.npz")
    for name in ("x_p", "y_p", "flags", "depth"):
        np.testing.assert_array_equal(maps[name], second[name])

    compared = ask(
        "compare", "--config", "bench.yaml", "--methods", "mfs,tps", "--reuse", "result", "--out", "comparison"
    )
    assert compared.returncode == 0, compared.stderr
    assert "TPS" in compared.stdout
    assert (tmp_path / "comparison" / "comparison.png").stat().st_size > 1000
    rows = json.loads((tmp_path / "comparison" / "comparison.json").read_text(encoding="utf-8"))["rows"]
    assert [r["method"] for r in rows] == ["mfs", "tps"]
    assert rows[0]["std_mm"] < rows[1]["std_mm"]

    refused(ask("--config", "bench.yaml", "--out", "result"), "exists", "--overwrite")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seed: 3", "sead: 3", ["line 3", "sead", "seed"]),
        ("exposure_us: 14000", "exposure_ms: 14", ["line 5", "exposure_ms", "exposure_us"]),
        ("name: mirror", "name: miror", ["line 4", "miror", "mirror"]),
        ("steps: 4", "steps: 2", ["line 8", "steps"]),
        ("steps: 4", "periods_px: [16, 32]", ["periods_px", "1280"]),
        ("steps: 4", "frequencies_per_px: [0.7, 0.001]", ["frequencies_per_px"]),
        ("kind: simulated", "kind: hardwear", ["line 2", "hardwear", "simulated"]),
        ("scan:", "rig: nowhere.json\nscan:", ["nowhere.json"]),
        ("exposure_us: 14000", "exposure_us: 40000", ["exposure check", "saturated"]),
        ("exposure_us: 14000", "exposure_us: 5", ["exposure check", "brighter"]),
    ],
)
def test_bad_configuration(ask, bench_file, tmp_path, old, new, words):
    bench_file.write_text(BENCH.replace(old, new, 1), encoding="utf-8")
    refused(ask("--config", "bench.yaml", "--out", "result"), *words)
    assert not (tmp_path / "result").exists()


def test_missing_file_and_bad_usage(ask, bench_file):
    refused(ask("--config", "bensch.yaml"), "bensch.yaml", "bench.yaml")
    refused(ask("--confg", "bench.yaml"), "--config")
    refused(ask("--config", "bench.yaml", "--method", "mfss"), "mfss", "mfs")


def test_rig_of_another_camera(ask, bench_file, tmp_path):
    from sim_backend.settings import SimulatedSettings

    SimulatedSettings().rig().save(tmp_path / "rig.json")
    bench_file.write_text("rig: rig.json\n" + BENCH, encoding="utf-8")
    refused(ask("--config", "bench.yaml", "--out", "result"), "1024 × 768", "256 × 192")


def test_what_is_no_recording(ask, tmp_path):
    (tmp_path / "empty").mkdir()
    refused(ask("process", "empty"), "plan file")
    refused(ask("process", "nowhere"), "nowhere")


def test_device_that_fails_ends_with_code_3_and_keeps_the_recording(ask, bench_file, tmp_path):
    done = ask("--config", "bench.yaml", "--out", "result", "--set", "bench.faults={lose_camera_at: 50}")
    refused(done, "camera", code=3)
    take = Take.open(tmp_path / "result.incomplete" / "take")
    assert take.status == "failed"
    assert take.sequences(1)
    assert not (tmp_path / "result").exists()


def test_stale_and_repeated_frames_are_taken_again(ask, bench_file, tmp_path):
    done = ask(
        "--config", "bench.yaml", "--out", "result", "--set", "bench.faults={repeat_frame_at: [9], stale_at: [30]}",
        "--set", "scan.steps=6",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    assert done.stdout.count("taken again") >= 2
    document = json.loads((tmp_path / "result" / "result.json").read_text(encoding="utf-8"))
    assert document["frames"]["repeated"] == 12


def test_gates_end_with_code_4_and_keep_the_result(ask, bench_file, tmp_path):
    done = ask("--config", "bench.yaml", "--out", "result", "--method", "tps", "--set", "gates.min_valid_share=0.99")
    assert done.returncode == 4, done.stderr
    assert "FAILED" in done.stdout
    assert (tmp_path / "result" / "result.json").exists()


def test_a_strangers_bench_is_found_by_its_entry_point(run, tmp_path):
    site = tmp_path / "site"
    info = site / "stranger-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("[scanner.benches]\nflat_wall = stranger:kind\n", encoding="utf-8")
    (site / "stranger.py").write_text(
        textwrap.dedent(
            """
            from contextlib import contextmanager
            import numpy as np
            from pydantic import BaseModel, ConfigDict
            from drivers import FrameFormat, FrameStamp, NoiseModel, SystemClock

            class Settings(BaseModel):
                model_config = ConfigDict(extra="forbid")
                level: float = 0.5

            class Wall:
                name, simulated, projector_size = "flat wall", False, (1280, 800)
                frame_format, noise, clock = FrameFormat(160, 100, 8), NoiseModel(1.0), SystemClock()

                def __init__(self, level):
                    self.level, self.random, self.count = level, np.random.default_rng(0), 0
                    lens = {"matrix": [[640, 0, 639.5], [0, 640, 399.5], [0, 0, 1]],
                            "distortion": [0, 0, 0, 0, 0], "size": [1280, 800]}
                    camera = {"matrix": [[80, 0, 79.5], [0, 80, 49.5], [0, 0, 1]],
                              "distortion": [0, 0, 0, 0, 0], "size": [160, 100]}
                    from scanner.rig import Lens, Rig
                    make = lambda d: Lens(np.array(d["matrix"], float), np.zeros(5), tuple(d["size"]))
                    self.rig = Rig(make(camera), make(lens), np.eye(3), np.array([-100.0, 0, 0])).to_json()

                def prepare(self, patterns):
                    self.patterns = patterns

                def expose(self, index, out):
                    # A wall at 1 m: the projector, 100 mm to the right, sees it shifted by 64 px.
                    rows, columns = np.mgrid[0:100, 0:160]
                    x, y = (columns - 79.5) * 8 + 639.5 - 64, (rows - 49.5) * 8 + 399.5
                    inside = (x >= 0) & (x <= 1278)
                    picture = self.patterns[index].astype(float)
                    left = np.clip(np.floor(x).astype(int), 0, 1278)
                    top = np.floor(y).astype(int)
                    row = picture[top, left], picture[top, left + 1], picture[top + 1, left], picture[top + 1, left + 1]
                    light = np.where(inside, np.mean(row, axis=0), 0) * self.level
                    out[:] = np.clip(np.rint(light + 5 + self.random.normal(0, 1, light.shape)), 0, 255)
                    self.count += 1
                    return FrameStamp(self.count, 0.0, 0.0, 0.0)

                def darken(self):
                    pass

                def describe(self):
                    return {"name": self.name}

            class Kind:
                settings = Settings

                @contextmanager
                def open(self, settings):
                    yield Wall(settings.level)

            kind = Kind()
            """
        ),
        encoding="utf-8",
    )
    (tmp_path / "mine.yaml").write_text(
        "bench: {kind: flat_wall, level: 0.7}\nscan: {steps: 4}\noutput: {report: false}\n", encoding="utf-8"
    )
    done = run("--config", "mine.yaml", "--out", "wall", PYTHONPATH=str(site))
    assert done.returncode == 0, done.stderr + done.stdout
    maps = np.load(tmp_path / "wall" / "maps.npz")
    depth = maps["depth"][np.isfinite(maps["depth"])]
    assert depth.size > 0.85 * 16_000
    # Means of four neighbours sample the fringes exactly half a pixel on: the wall is at 1000 mm.
    assert np.median(depth) == pytest.approx(1000, abs=1)
    assert "SIMULATED" not in done.stdout

    # The same bench without a rig: refused before anything is projected.
    text = (site / "stranger.py").read_text(encoding="utf-8")
    (site / "stranger.py").write_text(text.replace("self.rig = Rig", "self.rig = None and Rig"), encoding="utf-8")
    refused(run("--config", "mine.yaml", "--out", "none", PYTHONPATH=str(site)), "mine.yaml: rig", "flat wall")
    assert not (tmp_path / "none").exists()


def test_schema_is_json(run):
    done = run("schema")
    assert done.returncode == 0
    assert "bench" in json.loads(done.stdout)["properties"]


def test_methods_and_configuration_know_the_same_names():
    from scanner.config import METHOD_NAMES
    from scanner.methods import METHODS

    assert set(METHODS) == set(METHOD_NAMES)


def test_help_imports_nothing_heavy():
    code = "import sys; import scanner.cli; print([m for m in ('numba', 'open3d', 'cv2', 'scipy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_latency_is_measured_and_told(tmp_path, ask):
    (tmp_path / "bench.yaml").write_text(
        "bench: {kind: simulated, scene: {name: plane}, camera: {width_px: 96, height_px: 72, exposure_us: 4000},\n"
        "  projector: {width_px: 160, height_px: 100, latency_s: 0.035}, transport: {photons: 1000, supersample: 1}}\n"
    )
    done = ask("latency", "--config", "bench.yaml", "--quiet")
    assert done.returncode == 0, done.stderr
    # At 60 Hz a picture appears at the first refresh after 35 ms; the camera resolves its read-out of 5 ms.
    median = float(re.search(r"surface: ([\d.]+) ms", done.stdout)[1])
    assert 35 <= median <= 35 + 16.7 + 5.5
    assert "bench.settle_s: 0.0" in done.stdout
