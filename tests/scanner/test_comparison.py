"""Figures of a comparison against closed forms, and the report of `scan compare` with a method from one file."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scanner.comparison import Trial, Window, fit_sphere, judge, judge_detection, rows_of, windows_of
from scanner.comparison.fitting import residuals
from scanner.config import CompareSection, ConfigError
from scanner.integrity import check_sequence
from scanner.methods.xor_code import xor_planes
from scanner.patterns import Fringe, FringeSequence, Plan, ProfileSequence
from scanner.result import Maps, ScanResult

REPOSITORY = Path(__file__).parents[2]
SHAPE = (40, 60)


def maps(points=None, x_p=None, region=None, score=None):
    plain = np.ones(SHAPE, np.float32)
    return Maps(
        x_p=x_p, y_p=None, sigma_x=plain, sigma_y=None, modulation=plain, brightness=plain, variation=None,
        misfit=plain, interreflection=np.zeros(SHAPE, bool) if region is None else region,
        flags=np.zeros(SHAPE, np.uint16), points=points, score=score,
    )  # fmt: skip


def result(made):
    return ScanResult("any", True, made, {"frames": {"round 1": 12, "repeated": 3}, "timings_s": {"a": 1.5}})


def test_a_sphere_is_found_under_wrong_points():
    rng = np.random.default_rng(1)
    theta, phi = rng.uniform(0, 0.9, 3000), rng.uniform(0, 2 * np.pi, 3000)
    away = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], axis=1)
    points = np.array([20.0, -10, 600]) + (40 + rng.normal(0, 0.02, 3000))[:, None] * away
    points[:300] += rng.normal(0, 8, (300, 3))
    centre, radius = fit_sphere(points)
    # A cap of 52° ties radius and centre: their errors are some ten times σ/√n.
    np.testing.assert_allclose(centre, [20, -10, 600], atol=0.03)
    assert radius == pytest.approx(40, abs=0.03)
    assert residuals(points, "sphere")[300:].std() == pytest.approx(0.02, rel=0.1)
    with pytest.raises(ValueError, match="3 points"):
        fit_sphere(points[:3])
    assert np.isnan(residuals(points[:2], "plane")).all()


def test_distances_from_a_plane_are_positive_towards_the_camera():
    x, y = (g.astype(float).ravel() for g in np.mgrid[:20, :20])
    points = np.stack([x, y, 500 + 0.2 * x], axis=1)
    points[7, 2] -= 3
    off = residuals(points, "plane")
    assert off[7] == pytest.approx(3 / math.hypot(1, 0.2), rel=1e-3)
    assert np.abs(np.delete(off, 7)).max() < 1e-6


def truth(alpha):
    columns = np.broadcast_to(np.arange(SHAPE[1], dtype=np.float32), SHAPE)
    points = np.stack([*np.meshgrid(*map(np.arange, SHAPE[::-1])), np.full(SHAPE, 500)], axis=-1).astype(np.float32)
    nan = np.full(SHAPE, np.nan, np.float32)
    edge = np.zeros(SHAPE, bool)
    return SimpleNamespace(
        x_p=columns, y_p=columns, points=points, alpha=alpha, edge=edge, bounce_x=nan, bounce_y=nan, places={}
    )


def test_figures_of_a_window_are_those_of_the_errors_that_were_made():
    real = truth(np.zeros(SHAPE))
    points, x_p = real.points.copy(), real.x_p.copy()
    mask = np.zeros(SHAPE, bool)
    mask[10:30, 20:40] = True
    rng = np.random.default_rng(2)
    points[..., 2] += rng.normal(0, 0.05, SHAPE)
    points[10:12, 20:40, 2] += 5  # a tenth of the window
    x_p[10:12, 20:40] += 16
    points[29, 20:40] = np.nan
    x_p[29, 20:40] = np.nan
    (trial,) = judge("some", result(maps(points, x_p)), [Window("W", "plane", mask)], real, 0.02)
    v = trial.values
    assert v["coverage"] == pytest.approx(0.95)
    assert v["wrong_fringes"] == pytest.approx(2 / 19)
    assert v["outliers"] == pytest.approx(2 / 19)
    assert v["std_mm"] == pytest.approx(5 * math.sqrt(2 / 19 * 17 / 19), rel=0.05)
    assert v["rmse_mm"] == pytest.approx(5 * math.sqrt(2 / 19), rel=0.05)
    assert v["median_mm"] == pytest.approx(0.0371, rel=0.2)
    assert (v["frames"], v["seconds"]) == (12, 1.5)
    (untold,) = judge("some", result(maps(points, x_p)), [Window("W", "plane", mask)], None, 0.02)
    assert math.isnan(untold.values["rmse_mm"])
    assert untold.values["std_mm"] == v["std_mm"]


def test_detection_is_judged_by_pairs_of_pixels():
    rng = np.random.default_rng(3)
    alpha = np.where(np.arange(SHAPE[1]) >= 30, 0.3, 0.0) * np.ones(SHAPE)
    alpha[:, 28:30] = 0.01  # neither: not judged
    score = rng.normal(0, 1, SHAPE) + 1.5 * (alpha > 0.1)
    region = score > 1
    found = judge_detection(maps(region=region, score=score), truth(alpha), 0.02)
    bounce, clean = alpha > 0.1, alpha == 0
    assert found.recall == region[bounce].mean()
    assert found.precision == region[bounce].sum() / (region[bounce].sum() + region[clean].sum())
    pairs = (score[bounce][:, None] > score[clean][None]).mean()
    assert found.auc == pytest.approx(pairs, abs=1e-9)
    # Φ(1.5/√2), with the spread of 1200 pixels of each kind.
    assert found.auc == pytest.approx(0.8556, abs=0.03)
    assert math.isnan(judge_detection(maps(), truth(alpha), 0.02).auc)


def test_intervals_over_seeds_are_students():
    nothing = dict.fromkeys(("coverage", "median_mm", "outliers", "rmse_mm", "wrong_fringes", "precision"), math.nan)
    nothing |= dict.fromkeys(("recall", "auc", "frames", "seconds"), math.nan)
    trials = [Trial(m, w, nothing | {"std_mm": v}) for w in ("W1", "W2") for v in (1.0, 2.0, 3.0) for m in ("b", "a")]
    rows = rows_of(trials)
    assert [(r.window, r.method, r.seeds) for r in rows] == [
        ("W1", "b", 3), ("W1", "a", 3), ("W2", "b", 3), ("W2", "a", 3),
    ]  # fmt: skip
    assert rows[0].mean["std_mm"] == 2
    assert rows[0].half_width["std_mm"] == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)
    assert math.isnan(rows[0].mean["auc"])


def test_windows_are_rectangles_or_what_was_detected():
    region = np.zeros(SHAPE, bool)
    region[3:9, 5:20] = region[20, 50:53] = True
    (found,) = windows_of(CompareSection(), [maps(), maps(region=region)])
    assert found.mask.sum() == 6 * 15
    w1 = {"name": "W1", "x": 4, "y": 2, "width": 10, "height": 5, "fit": "sphere"}
    (found,) = windows_of(CompareSection.model_validate({"windows": [w1]}), [maps()])
    assert (found.fit, found.mask.sum(), found.mask[2:7, 4:14].all()) == ("sphere", 50, True)
    with pytest.raises(ConfigError, match="W1 reaches to"):
        windows_of(CompareSection.model_validate({"windows": [w1 | {"x": 55}]}), [maps()])


# --- the check of sequences that show no plain fringes

SIZE = (320, 200)


def photographed(sequence, rng, gamma=1.0):
    """A slanted surface before a projector whose light follows grey^γ, 120 × 160 pixels."""
    rows, columns = np.mgrid[:120, :160]
    x, y = (20 + 1.7 * columns).astype(int), (10 + 1.4 * rows).astype(int)
    pictures = [200 * (p[y, x] / 255.0) ** gamma + 4 for p in Plan(SIZE, (sequence,)).render(0)]
    return np.stack([np.clip(np.rint(p + rng.normal(0, 1.5, p.shape)), 0, 255).astype(np.uint8) for p in pictures])


CODE = ProfileSequence("x", "XOR code", tuple(tuple(map(float, s * p)) for p in xor_planes(320) for s in (1, -1)))
CARRIED = FringeSequence("x", tuple(Fringe(1 / 16, 2 * np.pi * n / 12) for n in range(12)), Fringe(1 / 16, 2.1))


@pytest.mark.parametrize("sequence", [CODE, CARRIED], ids=["code", "carrier"])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_faults_of_other_sequences_are_seen(sequence, gamma):
    rng = np.random.default_rng(4)
    good = photographed(sequence, rng, gamma)
    assert check_sequence(good, sequence, 255).findings == ()
    stale = good.copy()
    stale[5] = photographed(sequence, rng, gamma)[4]
    torn = good.copy()
    torn[5, 60:] = photographed(sequence, rng, gamma)[4, 60:]
    late = np.roll(photographed(sequence, rng, gamma), 1, axis=0)
    dark = good.copy()
    dark[7] = 4 + rng.normal(0, 1.5, dark[7].shape).clip(-4)
    for faulty in (stale, torn, dark):
        assert not check_sequence(faulty, sequence, 255).good
    # One step late, phase steps are as good as before; a code's pairs are not.
    if sequence is CODE:
        assert not check_sequence(late, sequence, 255).good
        assert "inverse" in check_sequence(good, sequence, 255).blind_to


def test_without_inverses_only_repeats_are_seen_and_that_is_said():
    rng = np.random.default_rng(5)
    lone = ProfileSequence("x", "code", CODE.profiles[::2])
    frames = photographed(lone, rng)
    assert "only repeated frames" in check_sequence(frames, lone, 255).blind_to
    frames[3] = frames[2]
    assert not check_sequence(frames, lone, 255).good


# --- the command

BENCH = """\
bench:
  kind: simulated
  seed: 5
  scene: {name: mirror}
  camera: {width_px: 160, height_px: 120, exposure_us: 14000}
  transport: {supersample: 1, photons: 100000}
scan: {steps: 8}
output: {report: false, ply: false, keep_take: false}
compare:
  windows:
    - {name: W1, x: 20, y: 30, width: 40, height: 50}
    - {name: W2, x: 85, y: 40, width: 20, height: 30}
"""


def example_of_the_readme():
    """The method that the README shows."""
    blocks = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (method,) = [b for b in blocks if "method = " in b]
    return method


def test_the_readmes_method_is_compared_over_seeds_in_one_report(tmp_path, transport_cache):
    (tmp_path / "bench.yaml").write_text(BENCH, encoding="utf-8")
    (tmp_path / "heterodyne.py").write_text(example_of_the_readme(), encoding="utf-8")
    command = [sys.executable, "-c", "from scanner.cli import main; main()", "compare", "--config", "bench.yaml"]
    command += ["--methods", "heterodyne.py,epipolar", "--seeds", "2", "--out", "c"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, env=dict(os.environ), check=False
    )
    assert done.returncode == 0, done.stderr + done.stdout
    assert "heterodyne" in done.stdout
    document = json.loads((tmp_path / "c" / "comparison.json").read_text(encoding="utf-8"))
    assert [(r["window"], r["method"]) for r in document["rows"]] == [
        (w, m) for w in ("W1", "W2") for m in ("heterodyne", "epipolar")
    ]
    mine, epipolar = document["rows"][:2]
    assert mine["seeds"] == 2
    assert mine["coverage"] > 0.9
    assert mine["wrong_fringes"] < 0.01
    assert 0 < mine["half_width_95"]["std_mm"] < mine["std_mm"]
    # Two scans, two seeds: their noise is not the same.
    stds = [t["std_mm"] for t in document["trials"] if (t["method"], t["window"]) == ("heterodyne", "W1")]
    assert len(set(stds)) == 2
    assert mine["std_mm"] == pytest.approx(np.mean(stds))
    assert (epipolar["auc"] is not None, mine["auc"]) == (True, None)
    page = (tmp_path / "c" / "report.html").read_text(encoding="utf-8")
    for part in ("SIMULATED DATA", "W1", "W2", "Truth: share", "epipolar: detected", "Two fringes and their beat"):
        assert part in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "--seeds 2" in page
    assert not list(tmp_path.glob("c/*-2/take"))

    refused = subprocess.run(
        [*command[:-6], "--methods", "mfs,mffs"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert refused.returncode == 2
    assert "mffs" in refused.stderr
    assert "did you mean `mfs`" in refused.stderr
