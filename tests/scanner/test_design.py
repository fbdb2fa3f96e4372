"""Plan design: the bounds against simulation, and half the frames against the paper's plan.

The design knows the bounds only; it is judged on random bounces (here) and on a mirror scene (below), none of which it
was chosen on.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import binomtest

from scanner.config import ScanSection
from scanner.config.loading import load_config
from scanner.design import (
    Demand,
    DesignError,
    contrast,
    coordinate_bound,
    design,
    detection_power,
    judge,
    noncentrality,
    trade,
    wrong_order_probability,
)
from scanner.kernels import unwrap
from scanner.methods import METHODS
from scanner.studies.detection import PAPER_FREQUENCIES, plan_study

HALF = Demand(frames=108, relative_noise=10 / 80)
PAPER = dict.fromkeys(("x", "y"), PAPER_FREQUENCIES)


@pytest.fixture(scope="module")
def half():
    return design(HALF)


def fits(frequencies, steps, relative_noise, u, delta, alpha, rng):
    """One-path fits of ideal phasors, B = 1: u, σ, χ²."""
    f = np.asarray(frequencies)
    sigma = np.sqrt(2 / steps) * relative_noise
    z = np.exp(2j * np.pi * np.outer(f, u)) + alpha * np.exp(2j * np.pi * np.outer(f, u + delta))
    z += sigma * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape))
    noise = np.full(u.size, sigma, np.float32)
    found, spread, _, chi2, _ = unwrap(z.astype(np.complex64), f, np.ones(f.size), noise, -0.5, 1279.5)
    return found, spread, chi2


@pytest.mark.parametrize("delta", [16.0, 45.0, 300.0, 600.0])
def test_predicted_power_is_what_the_fit_has(half, delta):
    rng = np.random.default_rng([1, int(delta)])
    frequencies, dof, count = half.frequencies["x"], 2 * len(half.frequencies["x"]) - 2, 20_000
    # Amplitudes at which the answer is open.
    one = noncentrality(np.array(frequencies), half.steps, 0.02, np.array([delta]), 1.0)[0]
    alpha = np.sqrt(18 / one)
    assert alpha < 0.2
    _, _, chi2 = fits(frequencies, half.steps, 0.02, rng.uniform(300, 600, count), delta, alpha, rng)
    predicted = detection_power(np.array([18.0]), dof, 0.01)[0]
    threshold = _threshold(dof)
    measured = binomtest(int((chi2 > threshold).sum()), count).proportion_ci(0.999)
    assert 0.2 < predicted < 0.95
    # First order in α: 2 % of power are allowed for the rest.
    assert measured.low - 0.02 < predicted < measured.high + 0.02


def _threshold(dof):
    from scipy.stats import chi2

    return float(chi2.isf(0.01, dof))


def test_coordinate_bound_is_reached(half):
    rng = np.random.default_rng(2)
    u = rng.uniform(10, 1270, 20_000)
    found, _, _ = fits(half.frequencies["x"], half.steps, 0.05, u, 0.0, 0.0, rng)
    # 20 000 values know their standard deviation to 0.5 %.
    assert (found - u).std() == pytest.approx(
        coordinate_bound(np.array(half.frequencies["x"]), half.steps, 0.05), rel=0.03
    )


def test_wrong_orders_are_foreseen():
    rng = np.random.default_rng(3)
    u, f = rng.uniform(0, 1279, 20_000), np.array(PAPER_FREQUENCIES)
    found, _, _ = fits(f, 12, 0.25, u, 0.0, 0.0, rng)
    wrong = int((np.abs(found - u) > 8).sum())
    predicted = wrong_order_probability(f, 12, 0.25, 1280)
    interval = binomtest(wrong, u.size).proportion_ci(0.999)
    # A union bound lies above, by overlaps of a few side lobes only.
    assert 0.002 < predicted < 0.05
    assert interval.low <= predicted <= 1.5 * interval.high


def test_blur_lowers_what_high_frequencies_say():
    f = np.array([1 / 16, 1 / 8])
    assert contrast(f, 1.0) == pytest.approx(np.exp([-2 * (np.pi / 16) ** 2, -2 * (np.pi / 8) ** 2]))
    assert coordinate_bound(f, 12, 0.1, 2.0) > coordinate_bound(f, 12, 0.1)


def test_a_design_keeps_to_its_demand(half):
    assert half.frame_count <= 108
    assert half.wrong_orders <= HALF.wrong_orders
    for axis, values in half.frequencies.items():
        extent = HALF.extent(axis)
        periods = 1 / np.array(values)
        assert periods.min() >= 12 - 1e-9
        assert periods.max() <= 20 + 1e-9
        # What two-path separation asks for.
        assert np.diff(values) == pytest.approx(1 / extent)
    assert half.plan().frame_count == half.frame_count


def test_more_frames_buy_more():
    plans = trade(HALF, (60, 108, 216))
    assert [p.frame_count for p in plans] == sorted(p.frame_count for p in plans)
    for less, more in itertools.pairwise(plans):
        assert sum(b.cost for b in more.bounds.values()) < sum(b.cost for b in less.bounds.values())


def test_free_frequencies_have_no_blind_distance():
    free = design(Demand(frames=54, axes=("x",), relative_noise=10 / 80, separable=False, steps=(9, 9)))
    comb = design(Demand(frames=54, axes=("x",), relative_noise=10 / 80, steps=(9, 9)))
    assert free.worst_bounce < 0.5 * comb.worst_bounce


def test_what_cannot_be_met_is_said():
    with pytest.raises(DesignError, match="no plan of 30 frames"):
        design(Demand(frames=30))
    with pytest.raises(DesignError, match="no plan"):
        design(Demand(relative_noise=2.0))
    with pytest.raises(DesignError, match="ascend"):
        design(Demand(from_px=700, to_px=600))


def test_the_lines_to_paste_are_the_plan(half, tmp_path):
    file = tmp_path / "bench.yaml"
    file.write_text("bench:\n  kind: simulated\n  scene: {name: plane}\nscan:\n" + half.yaml() + "\n", encoding="utf-8")
    scan = load_config(file).config.scan
    assert METHODS["mfs"].first_round(scan, (1280, 800)) == half.plan()


@pytest.mark.parametrize(
    ("alpha", "sigma"), [((0.05, 0.6), 10.0), ((0.05, 0.6), 2.0)], ids=["strong noise", "little noise"]
)
def test_half_the_frames_detect_as_well(half, alpha, sigma):
    plans = {"paper": (PAPER, 12), "half": (half.frequencies, half.steps)}
    paper, designed = plan_study(plans, (11, 12), ((alpha, sigma),), tiles=4)
    assert (paper["frames"], designed["frames"] <= 108) == (216, True)
    for detector in ("misfit", "pooled"):
        assert designed["auc"][detector]["mean"] >= paper["auc"][detector]["mean"] - 0.01
    assert designed["rms_px"]["mean"] <= 1.5 * paper["rms_px"]["mean"]


def test_half_the_frames_on_a_mirror_scene(scan_simulated):
    small = {"width_px": 320, "height_px": 240, "exposure_us": 14_000}
    quick = {"supersample": 2, "photons": 400_000}
    scene = {"name": "mirror", "mirror_angle_deg": 103.0, "mirror_tilt_deg": -4.0, "yaw_deg": 3.0}
    designed = design(Demand(frames=108, relative_noise=1.5 / 60))
    options = {
        "frequencies_per_px": {a: list(f) for a, f in designed.frequencies.items()},
        "steps": designed.steps,
    }
    found = {}
    for name, chosen in (("paper", {}), ("half", options)):
        maps, truth = scan_simulated(scene, seed=5, options=chosen, camera=small, transport=quick)
        direct = np.isfinite(truth.x_p) & ~truth.edge
        region = direct & (np.nan_to_num(truth.alpha) > 0.02)
        hits = maps.interreflection & region
        error = np.abs(maps.x_p - truth.x_p)
        clean = direct & (np.nan_to_num(truth.alpha, nan=1) < 1e-4) & np.isfinite(error)
        inside = error[region & np.isfinite(error)]
        found[name] = {
            "recall": hits.sum() / region.sum(),
            "precision": hits.sum() / (maps.interreflection & direct).sum(),
            "error": error[clean].mean(),
            "bound": np.nanmean(maps.sigma_x[clean]),
            "good": (inside < 0.25).mean() * inside.size / region.sum(),
        }
    print(found)
    assert found["half"]["recall"] >= found["paper"]["recall"] - 0.01
    assert found["half"]["precision"] >= found["paper"]["precision"] - 0.01
    assert found["half"]["error"] <= 1.5 * found["paper"]["error"]
    assert found["half"]["good"] >= found["paper"]["good"] - 0.02


def test_judging_the_papers_plan_gives_method_mds_bound():
    # method.md §1: σ = 1, B = 80, nine frequencies: 0.0041 px.
    usual = judge({"x": PAPER_FREQUENCIES}, 12, Demand(axes=("x",), relative_noise=1 / 80, blur_px=0.0))
    assert usual.sigma_px == pytest.approx(0.0041, abs=0.00005)
    assert ScanSection().steps * 2 * len(PAPER_FREQUENCIES) == 216
