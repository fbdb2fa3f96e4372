"""Detection at the limit, in small: the nine pairs of the paper's Figs. 22 and 23, false alarms, and the labelling.

Windows, prices and thresholds come from the noise model; the scenes are drawn here by seed. The large version is
`scan study detection`.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import kstest

from scanner.interreflection import MOST_EVIDENCE
from scanner.labelling import label
from scanner.phasors import AxisPhasors
from scanner.pooling import WINDOW, Residuals, Spectra, one_path_residuals, pool, single_pixel_evidence
from scanner.studies.detection import (
    ALPHAS,
    SIGMAS_DN,
    area_under_roc,
    clean_study,
    distance_study,
    pairs_study,
    score,
)
from scanner.studies.ideal import IdealScene, Judgement, curved_scene, observe
from scanner.unwrapping import unwrap

FREQUENCIES = [(80 + t) / 1280 for t in range(9)]


@pytest.fixture(scope="module")
def pairs():
    # Seeds that nothing was looked at with.
    rows, _ = pairs_study(seeds=(8101,), shape=(300, 400))
    return {(r["alpha"], r["sigma_dn"], r["detector"]): r for r in rows}


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("sigma", SIGMAS_DN)
def test_nine_pairs(pairs, alpha, sigma):
    row = pairs[alpha, sigma, "pooled"]
    assert row["iou"]["mean"] >= 0.95
    assert row["border_mean_px"]["mean"] <= 3
    # At α = 0.05 under σ = 20 DN some pictures lose a corner of the region, and with it the last 5 % of the border.
    if (alpha, sigma) != (0.05, 20.0):
        assert row["border_95_px"]["mean"] <= 3
    assert row["false_alarms"]["mean"] <= 0.01


def test_there_was_something_to_gain(pairs):
    # The paper's rule fails where it says, even with the threshold that suits the picture best.
    assert pairs[0.05, 20.0, "variation"]["best_iou"]["mean"] < 0.5
    assert pairs[0.05, 20.0, "misfit"]["best_iou"]["mean"] < 0.5
    assert pairs[0.6, 0.0, "variation"]["iou"]["mean"] > 0.9


def test_blind_distances():
    rows = distance_study((636.0, 644.0, 300.0), seeds=(1, 2), alpha=0.4, sigma_dn=20.0)
    auc = {(r["delta_px"], r["detector"]): r["auc"]["mean"] for r in rows}
    # A quarter fringe beside 640 px the modulation of equidistant frequencies does not vary; the phase does.
    assert auc[636.0, "variation"] < 0.8
    assert auc[644.0, "variation"] < 0.8
    assert auc[300.0, "variation"] > 0.95
    assert min(auc[d, "pooled"] for d in (636.0, 644.0, 300.0)) > 0.99


@pytest.mark.parametrize("axes", [("x",), ("x", "y")])
def test_false_alarms_are_what_was_asked_for(axes):
    rows = clean_study((0.01,), seeds=range(1, 6), axes=axes, shape=(160, 208))
    for row in rows:
        beyond, region = row["beyond"], row["region"]
        assert beyond["low"] <= 0.01, row
        # Pooled, half of the rate is the pixels' own; the windows' half is a bound: some waves are the patterns' own.
        assert beyond["high"] >= (0.005 if row["detector"] == "pooled" else 0.009), row
        assert region["low"] <= 0.01, row
        assert region["mean"] <= 0.01, row


def _residuals(shape, seed, alpha=0.0):
    rng = np.random.default_rng(seed)
    scene = curved_scene(shape, alpha, rng, ("x",))
    seen = observe(scene, {"x": FREQUENCIES}, 12, 10.0, rng)
    usable = np.ones(shape, bool)
    one = np.ones(9)
    return seen, one_path_residuals(seen.phasors[0], seen.coordinates[0], seen.sigma_z[0], one, usable), usable


def test_residuals_are_the_misfit():
    seen, residuals, _ = _residuals((64, 64), 3)
    total = (np.abs(residuals.e) ** 2).sum(axis=0)
    ordinary = total < 45
    assert total[ordinary] == pytest.approx(seen.coordinates[0].chi2[ordinary], rel=2e-3, abs=2e-3)
    assert kstest(total.ravel(), chi2_distribution(16).cdf).pvalue > 1e-3


def test_window_spectra_are_those_of_numpy():
    _, residuals, usable = _residuals((40, 56), 4, alpha=0.4)
    usable[:9, :9] = False
    residuals.e[:, ~usable] = 0
    spectra = Spectra.of([residuals], usable)
    rows, columns = spectra.windows.rows, spectra.windows.columns
    assert (rows[-1], columns[-1]) == (40 - WINDOW, 56 - WINDOW)
    for i, j in ((0, 0), (1, 2), (len(rows) - 1, len(columns) - 1)):
        part = np.s_[rows[i] : rows[i] + WINDOW, columns[j] : columns[j] + WINDOW]
        expected = (np.abs(np.fft.fft2(residuals.e[(slice(None), *part)])) ** 2).sum(axis=0) / usable[part].sum()
        assert spectra.power[0][i, j] == pytest.approx(expected.ravel(), rel=1e-3, abs=1e-3)


def test_a_windows_p_value_is_one():
    # Uniform under noise: windows that do not overlap are independent.
    values = []
    for seed in range(6):
        _, residuals, usable = _residuals((128, 160), 20 + seed)
        pure = Residuals(residuals.e, np.zeros(usable.shape, np.float32), residuals.frequency)
        found, _ = Spectra.of([pure], usable).p_values(np.float32(1))
        values.append(found[::2, ::2].ravel())
    assert kstest(np.concatenate(values), "uniform").pvalue > 1e-3


def test_evidence_of_a_plane_wave_is_its_likelihood_ratio():
    """A known wave under noise: the evidence must be that of the true wave, up to what its estimate costs."""
    rng = np.random.default_rng(5)
    shape, usable = (48, 48), np.ones((48, 48), bool)
    row, column = np.mgrid[0:48, 0:48]
    wave = np.exp(2j * np.pi * (0.11 * row + 0.21 * column))
    vector = 0.5 * np.exp(2j * np.pi * rng.uniform(size=9))[:, None, None] * wave
    noise = rng.standard_normal((9, *shape)) + 1j * rng.standard_normal((9, *shape))
    e = (vector + noise).astype(np.complex64)
    statistic = (np.abs(e) ** 2).sum(axis=0).astype(np.float32)
    found = pool([Residuals(e, np.zeros(shape, np.float32), np.ones(9))], statistic, 18, usable, 0.01)
    true = (vector.conj() * e).real.sum(axis=0) - 0.5 * (np.abs(vector) ** 2).sum(axis=0)
    alone = single_pixel_evidence(statistic, 18, 0.01)
    pooled = found.evidence > alone
    assert pooled.mean() > 0.8
    assert found.detected.all()
    difference = found.evidence[pooled] - true[pooled]
    assert np.corrcoef(found.evidence[pooled], true[pooled])[0, 1] > 0.85
    assert abs(difference.mean()) < 0.35


def test_a_pixel_does_not_vouch_for_itself():
    """Windows that noise put beyond the threshold: labelled, their pixels cannot pay for the boundary they need."""
    regions, asked = [], 0
    for seed in range(4):
        _, residuals, usable = _residuals((96, 96), 40 + seed)
        statistic = (np.abs(residuals.e) ** 2).sum(axis=0).astype(np.float32)
        found = pool([residuals], statistic, 16, usable, 0.3)
        pooled = found.evidence != single_pixel_evidence(statistic, 16, 0.3)
        asked += int(pooled.sum())
        evidence = np.where(pooled, found.evidence, np.float32(-1))
        regions.append((label(np.clip(evidence, -MOST_EVIDENCE, MOST_EVIDENCE)) > 0.5).mean())
    assert asked > 1000
    assert np.mean(regions) < 0.02


def test_unusable_pixels_and_pictures_smaller_than_a_window():
    _, residuals, usable = _residuals((12, 40), 6)
    usable[3] = False
    statistic = (np.abs(residuals.e) ** 2).sum(axis=0).astype(np.float32)
    found = pool([residuals], statistic, 16, usable, 0.01)
    assert (found.evidence[3] == 0).all()
    assert not found.detected[3].any()
    assert found.p_value[~usable] == pytest.approx(1)


def test_depth_edges_do_not_speak_for_a_window():
    """One column of pixels that mix two surfaces leaves the clean pixels beside it clean."""
    rng = np.random.default_rng(7)
    _, column = np.mgrid[0:96, 0:96].astype(float)
    u = np.where(column < 48, 200 + 1.3 * column, 420 + 1.3 * column)
    alpha = np.where(column == 48, 0.7, 0.0)
    seen = observe(IdealScene({"x": u}, {"x": np.full_like(u, -220.0)}, alpha), {"x": FREQUENCIES}, 12, 2.0, rng)
    judged = seen.judge("pooled", 0.01)
    assert judged.region[:, np.abs(np.arange(96) - 48) > 2].mean() < 0.01


def _cut(evidence, price):
    """Minimum cut of the grid graph with horizontal and vertical edges: an independent exact solution."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    height, width = evidence.shape
    number = np.arange(evidence.size).reshape(height, width)
    source, sink = evidence.size, evidence.size + 1
    whole = np.rint(1000 * evidence).astype(int).ravel()
    rows, columns, capacity = [], [], []
    for p, value in enumerate(whole):
        rows.append(source if value > 0 else p)
        columns.append(p if value > 0 else sink)
        capacity.append(abs(value))
    for a, b in ((number[:, 1:], number[:, :-1]), (number[1:], number[:-1])):
        for p, q in ((a, b), (b, a)):
            rows += p.ravel().tolist()
            columns += q.ravel().tolist()
            capacity += [round(1000 * price)] * p.size
    graph = coo_matrix((np.array(capacity, np.int32), (rows, columns)), shape=(sink + 1, sink + 1)).tocsr()
    flow = maximum_flow(graph, source, sink).flow
    left = graph - flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = breadth_first_order(left, source, return_predecessors=False)
    labels = np.zeros(evidence.size + 2, bool)
    labels[reached] = True
    return labels[: evidence.size].reshape(height, width)


def test_labelling_beside_a_minimum_cut():
    rng = np.random.default_rng(9)
    row, column = np.mgrid[0:40, 0:50]
    truth = (row - 19) ** 2 + (column - 24) ** 2 < 13**2
    evidence = (np.where(truth, 0.6, -0.6) + 1.1 * rng.standard_normal(truth.shape)).astype(np.float32)
    ours, exact = label(evidence, 1.0, iterations=600) > 0.5, _cut(evidence, 0.8)
    # The cut measures boundaries along the grid, so its price is that of the mean direction (π/4); few pixels differ.
    assert (ours != exact).mean() < 0.02
    assert (ours != truth).mean() < 0.03
    assert ((evidence > 0) != truth).mean() > 0.2


def test_area_under_roc():
    assert area_under_roc(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1.0
    assert area_under_roc(np.array([1.0, 1.0]), np.array([1.0])) == 0.5
    rng = np.random.default_rng(1)
    a, b = rng.normal(1, 1, 4000), rng.normal(0, 1, 4000)
    assert area_under_roc(a, b) == pytest.approx(0.7602, abs=0.02)  # Φ(1/√2)


def test_scores_of_a_known_mistake():
    alpha = np.zeros((60, 60))
    alpha[20:40, 20:40] = 0.5
    scene = IdealScene({"x": np.zeros((60, 60))}, {"x": np.full((60, 60), 100.0)}, alpha)
    found = np.zeros((60, 60), bool)
    found[20:40, 22:42] = True
    judged = score(scene, Judgement(found.astype(np.float32), found, found))
    assert judged.iou == pytest.approx(18 / 22)
    assert judged.false_alarms == pytest.approx(40 / 3200)
    assert judged.border_95_px == pytest.approx(2)


def test_phasors_of_unequal_gain_leave_no_residual():
    gain = np.linspace(1.05, 0.95, 9)
    u = np.linspace(100, 900, 400, dtype=np.float32).reshape(20, 20)
    z = (70 * gain[:, None, None] * np.exp(2j * np.pi * np.array(FREQUENCIES)[:, None, None] * u)).astype(np.complex64)
    phasors = AxisPhasors("x", np.array(FREQUENCIES), z, 1 / 6)
    sigma = np.full((20, 20), 0.5, np.float32)
    c = unwrap(phasors, sigma, 1280, gain)
    e = one_path_residuals(phasors, c, sigma, gain, np.ones((20, 20), bool))
    assert np.abs(e.e).max() < 0.05
