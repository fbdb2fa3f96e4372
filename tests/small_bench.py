"""A small simulated bench to be calibrated, and the command that does it."""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

BOARD = """\
kind: chessboard
name: small board
columns: 8
rows: 5
square_mm: 22
margin_mm: 14
"""

BENCH = """\
bench:
  kind: simulated
  seed: 3
  scene: {name: plane}
  camera: {width_px: 288, height_px: 216, exposure_us: 16667}
  projector: {width_px: 320, height_px: 200, gamma: 1.6}
  transport: {supersample: 1, photons: 1000}
scan: {method: tps, axes: [x, y], steps: 5}
output: {ply: false, report: false}
calibration:
  board: board.yaml
  geometry: {poses: 5, nearest_mm: 600, farthest_mm: 720, steps: 5}
  response: {levels: 9}
  expected: {baseline_mm: 180}
  acceptance:
    artefacts:
      - artefact: {kind: plane, width_mm: 200, height_mm: 150}
        yaw_deg: 12
    limits: {flatness_mm: 1.0}
"""


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    out: str
    err: str


def calibrate(*args: object) -> Ran:
    """Run the command in this process."""
    from calibration.cli import main

    out, err = io.StringIO(), io.StringIO()
    argv = sys.argv
    sys.argv = ["calibrate", *map(str, args)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as ended:
            main()
    finally:
        sys.argv = argv
    code = ended.value.code
    return Ran(code if isinstance(code, int) else 0, out.getvalue(), err.getvalue())


@dataclass(frozen=True)
class Calibrated:
    """A finished calibration."""

    config: Path
    folder: Path
    ran: Ran

    def copied(self, place: Path) -> Path:
        """A copy that may be changed."""
        return Path(shutil.copytree(self.folder, place))
