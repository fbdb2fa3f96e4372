"""`scan` interrupted and killed, in a process of its own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from windows import within

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
def run(tmp_path, transport_cache):
    def go(*args: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*SCAN, *args], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)

    return go


@pytest.fixture
def bench_file(tmp_path):
    path = tmp_path / "bench.yaml"
    path.write_text(BENCH, encoding="utf-8")
    return path


def start(tmp_path, *args):
    return subprocess.Popen(
        [*SCAN, "--config", "bench.yaml", "--out", "result", "--set", "bench.real_time=true", *args],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def until(process, words):
    for line in process.stdout:
        if words in line:
            return
    raise AssertionError(f"{words!r} never came: {process.stderr.read()}")


def waited_s(process):
    """Time for which the process's main thread has waited for a processor, s, as Linux counts it; 0 elsewhere."""
    try:
        return int(Path(f"/proc/{process.pid}/schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
    except OSError:
        return 0.0


def seconds_to_the_end(process, patience_s=60.0):
    """How long the process takes to end, s, without what other programs keep it from the processor."""
    began, waited_before = time.monotonic(), waited_s(process)
    waited = waited_before
    while process.poll() is None:
        assert time.monotonic() < began + patience_s
        time.sleep(0.005)
        waited = max(waited, waited_s(process))
    return time.monotonic() - began - (waited - waited_before)


@pytest.mark.parametrize("number", [1, 2])
def test_ctrl_c_ends_within_two_seconds_and_leaves_a_take(run, bench_file, tmp_path, number):
    fast = [] if number == 1 else ["--set", "bench.projector.latency_s=0", "--set", "bench.projector.refresh_hz=2000"]
    with start(tmp_path, *fast) as process:
        until(process, f"round {number}")
        if number == 2:
            time.sleep(0.3)
        else:
            time.sleep(1.5)
        process.send_signal(signal.SIGINT)
        took = seconds_to_the_end(process)
        code = process.returncode
        said = process.stderr.read()
    assert code == 130, said
    assert took < 2
    assert "Traceback" not in said
    assert "result.incomplete" in said
    take = Take.open(tmp_path / "result.incomplete" / "take")
    assert take.status == "cancelled"
    assert number in take.rounds
    if number == 2:
        done = run("process", "result.incomplete", "--out", "rest")
        assert done.returncode in (0, 4), done.stderr
        assert "round two is not complete" in done.stdout
        maps = np.load(tmp_path / "rest" / "maps.npz")
        region = maps["interreflection"]
        assert np.isfinite(maps["x_p"][~region]).mean() > 0.5


@pytest.mark.parametrize("kept", [0, 3, 10])
def test_sigkill_leaves_a_take_that_opens(run, bench_file, tmp_path, kept):
    with start(tmp_path, "--set", "bench.projector.latency_s=0") as process:
        until(process, "round 1")
        (journal,) = tmp_path.glob(".result.partial-*/take/journal.jsonl")
        assert within(60.0, lambda: journal.read_text(encoding="utf-8").count('"sequence_committed"') >= kept)
        process.kill()
        process.wait()
    (partial,) = tmp_path.glob(".result.partial-*")
    take = Take.open(partial / "take")
    assert take.status == "cut off"
    assert any("round 1" in line for line in take.describe())
    done = run("process", str(partial / "take"), "--out", "rest")
    enough = len([s for s in take.sequences(1) if s < 9]) == 9
    if enough:
        assert done.returncode in (0, 4), done.stderr
    else:
        # From about three frequencies on, the fewer are decoded as well; whether that passes the gates, they decide.
        assert done.returncode in (0, 2, 4), done.stderr
        assert "Traceback" not in done.stderr
    shutil.rmtree(partial)
