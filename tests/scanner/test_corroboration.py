"""What one round may keep where a third path hides, and how wide σ is where a bounce is close.

Scenes and signals are drawn here; the limits of `scanner.paths.corroboration` and `scanner.paths.joint_spread` were set
on other poses, seeds and sizes.
"""

import numpy as np
import pytest
from path_signals import signals
from scipy.stats import chi2 as chi2_distribution

from scanner.paths import Coupling, separate_jointly

_rng = np.random.default_rng(66260)
COUPLING = Coupling(line_px=0.05, log_ratio=float(np.log(0.97)), ratio=0.02)
SCENES = {
    "polished": {"name": "polished", "mirror_angle_deg": float(_rng.uniform(97, 106)), "mirror_roughness": 0.0},
    "dull": {"name": "polished", "mirror_angle_deg": float(_rng.uniform(97, 106)), "mirror_reflectance": 0.4},
}


@pytest.mark.parametrize("name", SCENES)
def test_a_hidden_third_path_leaves_no_wrong_fringe(scan_simulated, name):
    maps, truth = scan_simulated(
        SCENES[name],
        method="mfs1",
        seed=7 + len(name),
        camera={"width_px": 224, "height_px": 168},
        transport={"photons": 300_000},
    )
    region = maps.interreflection & np.isfinite(truth.x_p) & ~truth.edge
    error = np.maximum(np.abs(maps.x_p - truth.x_p), np.abs(maps.y_p - truth.y_p))[region]
    kept = np.isfinite(error)
    assert region.sum() > 5000
    assert kept.mean() > 0.5
    assert (error[kept] > 4).mean() <= 0.005


@pytest.mark.parametrize(
    ("sigma_dn", "apart"), [(2, (6, 20)), (5, (6, 20)), (2, (20, 60)), (5, (20, 60)), (10, (20, 60))]
)
def test_sigma_covers_every_bounce_that_explains_the_data(sigma_dn, apart):
    s = signals(np.random.default_rng([66260, sigma_dn, apart[0]]), 4000, (0.03, 0.9), sigma_dn, apart)
    found = separate_jointly(s.rig, s.pixels, s.axes, COUPLING)
    clear = (found.best.chi2 < chi2_distribution.isf(1e-4, found.dof)) & (found.confidence > np.log(100))
    off = np.abs(found.best.direct - s.u[0])[:, clear]
    assert clear.mean() > 0.2
    assert (off < 3 * found.best.sigma[:, clear]).mean() >= 0.99
