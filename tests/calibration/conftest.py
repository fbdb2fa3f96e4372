"""One calibration of a small simulated bench, made once for all tests that look at it or go on from it."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_bench import BENCH, BOARD, Calibrated, calibrate


@pytest.fixture(scope="session")
def bench_file(tmp_path_factory, transport_cache) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    (folder / "board.yaml").write_text(BOARD)
    (folder / "bench.yaml").write_text(BENCH)
    return folder / "bench.yaml"


@pytest.fixture(scope="session")
def calibrated(bench_file, tmp_path_factory) -> Calibrated:
    folder = tmp_path_factory.mktemp("calibrated") / "calibration"
    return Calibrated(bench_file, folder, calibrate("--config", bench_file, "--headless", "--out", folder))
