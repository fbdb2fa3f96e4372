"""Real captures of SLStudio through the product, from images to points: shape, count and noise."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scanner.config import GatesSection, ScanSection
from scanner.images import open_images
from scanner.processing import process_images
from scanner.quality import passed
from scanner.rig import Rig

SLSTUDIO = Path(__file__).resolve().parents[3] / "shared" / "data" / "slstudio"

pytestmark = pytest.mark.skipif(not SLSTUDIO.is_dir(), reason=f"the real captures {SLSTUDIO} are not on this machine")

FINE_AND_COARSE_X = "  - {axis: x, period_px: 114, steps: 3}\n  - {axis: x, period_px: 1824, steps: 3}\n"
FINE_AND_COARSE_Y = "  - {axis: y, period_px: 71.25, steps: 3}\n  - {axis: y, period_px: 1140, steps: 3}\n"


def plan_file(folder: Path, sequences: str, sign: int = -1, extra: str = "") -> Path:
    path = folder / "plan.yaml"
    path.write_text(
        "projector: {width: 1824, height: 1140}\n"
        f"phase: {{sign: {sign}, first_step: 0}}\n{extra}sequences:\n{sequences}",
        encoding="utf-8",
    )
    return path


def test_skull(tmp_path):
    recorded = open_images(SLSTUDIO / "skull_2x3", plan_file(tmp_path, FINE_AND_COARSE_X))
    rig = Rig.load(SLSTUDIO / "calibration" / "calibration.xml")
    scan = ScanSection(method="tps", minimum_modulation_dn=8)
    result = process_images(recorded, scan, GatesSection(), rig)
    assert passed(result)
    depth = result.maps.depth
    known = np.isfinite(depth)
    # 381 000 pixels have B > 8 DN; those whose fringe order the coarse fringe leaves in doubt are not kept.
    assert 0.97 * 381_000 < known.sum() < 1.005 * 381_000
    assert np.median(depth[known]) == pytest.approx(386.4, abs=0.5)

    # Independent: the classical order from the coarse phase, and the plane of light intersected in closed form once the
    # projector's distortion is undone at the point found.
    frames = np.stack([cv2.imread(str(SLSTUDIO / "skull_2x3" / f"{i:02d}.png"), 0) for i in range(6)]).astype(float)
    turn = np.exp(2j * np.pi * np.arange(3) / 3)[:, None, None]
    fine, coarse = (frames[:3] * turn).sum(0), (frames[3:] * turn).sum(0)
    x = np.angle(fine) / (2 * np.pi) * 114
    x += 114 * np.rint((np.angle(coarse) / (2 * np.pi) % 1 * 1824 - x) / 114)
    storage = cv2.FileStorage(str(SLSTUDIO / "calibration" / "calibration.xml"), cv2.FILE_STORAGE_READ)
    kc, dc, kp, dp, r, t = (storage.getNode(n).mat().astype(float) for n in ("Kc", "kc", "Kp", "kp", "Rp", "Tp"))
    rows, columns = np.nonzero(known)
    pixels = np.stack([columns, rows], axis=1).astype(float)
    d = np.c_[cv2.undistortPoints(pixels[:, None], kc, dc)[:, 0], np.ones(len(pixels))]
    xp, y = x[rows, columns], np.full(len(pixels), 570.0)
    for _ in range(4):
        ideal = cv2.undistortPoints(np.stack([xp, y], axis=1)[:, None], kp, dp)[:, 0, 0]
        plane = r[0] - ideal[:, None] * r[2]
        z = -(t[0] - ideal * t[2]) / (plane * d).sum(axis=1)
        y = cv2.projectPoints(z[:, None] * d, cv2.Rodrigues(r)[0], t, kp, dp)[0][:, 0, 1]
    error = np.abs(depth[rows, columns] - z)
    assert np.median(error) < 0.1
    # Both read the same phases; only the weight of the coarse fringe (1/256 in variance) separates them.
    assert np.median(error) < 0.02


@pytest.mark.parametrize("pose", [1, 3, 6])
def test_predicted_noise_on_the_calibration_board(tmp_path, pose):
    recorded = open_images(
        SLSTUDIO / "calibration" / f"calseq{pose}", plan_file(tmp_path, FINE_AND_COARSE_X + FINE_AND_COARSE_Y)
    )
    scan = ScanSection(method="tps", minimum_modulation_dn=20)
    maps = process_images(recorded, scan, GatesSection(), None).maps
    # The board is flat: second derivatives of its coordinates are noise, six times σ by this mask.
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
    for u, sigma in ((maps.x_p, maps.sigma_x), (maps.y_p, maps.sigma_y)):
        rough = cv2.filter2D(u, -1, mask)
        ok = np.isfinite(rough)
        assert ok.sum() > 500_000
        observed = 1.4826 * np.median(np.abs(rough[ok]))
        assert np.median(sigma[ok]) == pytest.approx(observed, rel=0.25)


def test_swapped_images_fail_the_gates_and_the_reason_is_told(tmp_path):
    # Three steps have no redundancy of their own; the two frequencies together tell.
    files = "files: [00.png, 02.png, 01.png, 03.png, 04.png, 05.png]\n"
    recorded = open_images(SLSTUDIO / "skull_2x3", plan_file(tmp_path, FINE_AND_COARSE_X, extra=files))
    result = process_images(recorded, ScanSection(method="tps", minimum_modulation_dn=8), GatesSection(), None)
    assert not passed(result)
    assert any("another order of the frames" in w for w in result.warnings)
