"""The figures that the project promises, on simulated scenes, against the scenes' own truth.

No parameter of the product was chosen on the scenes of this file: angles, tilts, roughness, poses and seeds are drawn
here. The figures are those of a camera of 1024 × 768 (plane and steps: 512 × 384), a projector of 1280 × 800 and
σ = 1.5 DN.
"""

from __future__ import annotations

import numpy as np
import pytest

from scanner.comparison import fit_plane

FREQUENCIES = np.array([(80 + t) / 1280 for t in range(9)])
SIGMA_I = 1.5

_rng = np.random.default_rng(20191)
MIRRORS = [
    {
        "name": "mirror",
        "mirror_angle_deg": float(_rng.uniform(96, 108)),
        "mirror_tilt_deg": float(_rng.uniform(-8, 8)),
        "mirror_roughness": roughness,
        "yaw_deg": float(_rng.uniform(-8, 8)),
        "pitch_deg": float(_rng.uniform(-5, 5)),
        "mirror_reflectance": float(_rng.uniform(0.6, 0.85)),
    }
    for roughness in (0.0, 0.03)
]


class Judged:
    """A mirror scan beside its truth, and the pixels that count."""

    def __init__(self, maps, truth):
        self.maps, self.truth = maps, truth
        direct = np.isfinite(truth.x_p) & ~truth.edge
        with np.errstate(invalid="ignore"):
            bounced = truth.alpha > 0.02
        self.direct = direct
        self.region = bounced & direct
        self.clean = direct & (np.nan_to_num(truth.alpha, nan=1) < 1e-4)
        # Into a mirror the camera sees nothing direct; what is detected there is no false alarm on the board.
        self.counted = maps.interreflection & direct

    def error(self, axis):
        return getattr(self.maps, f"{axis}_p") - getattr(self.truth, f"{axis}_p")


@pytest.fixture(scope="module", params=range(len(MIRRORS)), ids=["smooth", "rough"])
def judged(request, scan_simulated):
    maps, truth = scan_simulated(MIRRORS[request.param], seed=31 + request.param, camera={"exposure_us": 14_000})
    return Judged(maps, truth)


def test_the_scene_is_a_trial(judged):
    assert judged.region.mean() > 0.05
    distance = np.abs(judged.truth.bounce_x - judged.truth.x_p)[judged.region]
    assert np.nanmedian(distance) > 40


def test_detection(judged):
    hits = (judged.counted & judged.region).sum()
    assert hits / judged.region.sum() >= 0.98
    assert hits / judged.counted.sum() >= 0.98


@pytest.mark.parametrize("axis", ["x", "y"])
def test_coordinates_in_the_region(judged, axis):
    error = np.abs(judged.error(axis))
    known = np.isfinite(error)
    inside, clean = error[judged.region & known], error[judged.clean & known]
    assert inside.size / judged.region.sum() >= 0.97
    assert (inside <= 0.25).mean() >= 0.98
    assert (inside > 8).mean() <= 0.005
    # Median errors follow the modulation: where the region is darker, the bound itself is higher.
    bound = np.median(1 / judged.truth.direct_amplitude[judged.region]) * np.median(
        judged.truth.direct_amplitude[judged.clean]
    )
    assert np.median(inside) <= 1.2 * max(1.0, bound) * np.median(clean)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_clean_pixels_reach_the_bound_and_sigma_is_honest(judged, axis):
    error, sigma = judged.error(axis), getattr(judged.maps, f"sigma_{axis}")
    ok = judged.clean & np.isfinite(error)
    assert ok.sum() / judged.clean.sum() > 0.995
    information = 2 * np.pi * judged.truth.direct_amplitude[ok] * np.sqrt(np.square(FREQUENCIES).sum())
    against_bound = error[ok] * information / (np.sqrt(2 / 12) * SIGMA_I)
    assert against_bound.std() == pytest.approx(1, abs=0.15)
    assert (error[ok] / sigma[ok]).std() == pytest.approx(1, abs=0.20)
    region = judged.region & np.isfinite(error)
    assert (error[region] / sigma[region]).std() == pytest.approx(1, abs=0.20)


def test_round_one_alone_is_wrong_there(judged):
    # Otherwise nothing was shown: some one-path coordinates of the first round are wrong, or in doubt and left out.
    error = np.abs(judged.maps.x_p_round1 - judged.truth.x_p)[judged.region]
    assert (~(error <= 0.25)).mean() > 0.05


def test_emitters_stay_dark(judged):
    height, width = judged.maps.lit.shape
    x, y = (np.rint(u[judged.region]) for u in (judged.truth.bounce_x, judged.truth.bounce_y))
    ok = np.isfinite(x) & np.isfinite(y) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    assert judged.maps.lit[y[ok].astype(int), x[ok].astype(int)].mean() < 0.01


def test_plane_fit_beside_the_other_methods_and_the_scene_without_mirror(scan_simulated, capsys):
    scene = MIRRORS[0]
    without = {**scene, "name": "mirror_removed"}
    camera = {"exposure_us": 14_000}
    maps, truth = scan_simulated(scene, seed=31, camera=camera)
    region = Judged(maps, truth).region
    rows = {}
    for name, chosen, method in (
        ("MFS", scene, None),
        ("TPS", scene, "tps"),
        ("MPS", scene, "mps"),
        ("MPS, F + 2", scene, "mps_gn"),
        ("MFS without mirror", without, "mfs"),
    ):
        # The other methods need one axis to be wrong by whole fringes; what is compared with needs both, as MFS.
        options = {"axes": ["x", "y"] if method == "mfs" else ["x"]}
        result = maps if method is None else scan_simulated(chosen, method, options, seed=32, camera=camera)[0]
        known = region & np.isfinite(result.points[..., 2])
        normal, d = fit_plane(result.points[known])
        rows[name] = ((result.points[known] @ normal - d).std(), known.sum() / region.sum())
    with capsys.disabled():
        print("\nbounce region after a plane fit:")
        for name, (std, share) in rows.items():
            print(f"  {name:20s} std {std:9.4f} mm   {100 * share:5.1f} % of the region")
    assert rows["MFS"][0] <= 1.15 * rows["MFS without mirror"][0]
    assert rows["MFS"][1] >= 0.97
    assert min(rows[name][0] for name in ("TPS", "MPS", "MPS, F + 2")) > 3 * rows["MFS"][0]


@pytest.mark.parametrize(
    ("scene", "width_px"),
    [
        ({"name": "plane", "yaw_deg": 17.0, "pitch_deg": -9.0}, 512),
        ({"name": "sphere"}, 1024),  # curved within wider pixels, whose mean is not the surface at their centres
        ({"name": "steps", "yaw_deg": 4.0}, 512),
    ],
    ids=["plane", "sphere", "steps"],
)
def test_shapes_within_their_predicted_error(scan_simulated, scene, width_px):
    camera = {"width_px": width_px, "height_px": width_px * 3 // 4}
    maps, truth = scan_simulated(scene, seed=7, options={"steps": 4}, camera=camera)
    known = np.isfinite(maps.points[..., 2]) & np.isfinite(truth.depth)
    error = np.linalg.norm(maps.points - truth.points, axis=-1)[known]
    sigma = maps.sigma_point[known]
    away = ~truth.edge[known]
    z = error[away] / sigma[away]
    # |error| ≤ 3 σ for 99.7 % of a Gaussian; a pixel beyond 6 σ (2e-9) is an outlier that should carry a flag.
    assert (z <= 3).mean() > 0.99
    assert (z > 6).mean() < 1e-4
    assert np.median(sigma) < 0.05
