"""Focus in numbers, against edges and fringes of known blur."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from calibration.focus import CAMERA_SPOT_PX, camera_focus, edge_blur, projector_focus
from calibration.photometry import MTF_PERIODS_PX, mtf_of_modulation

FREQUENCIES = 1 / np.array(MTF_PERIODS_PX)


def stripes(sigma, angle_deg, noise=1.5, contrast=60.0):
    """Straight edges 30 px apart, each a step that was blurred with ``sigma`` px."""
    rows, columns = np.mgrid[0:240, 0:320]
    along = (columns - 160) * np.cos(np.radians(angle_deg)) + (rows - 120) * np.sin(np.radians(angle_deg))
    sign = np.where((along + 15) // 30 % 2 == 0, 1, -1)
    edge = erf(((along + 15) % 30 - 15) / (np.sqrt(2) * sigma))
    grey = 100 + contrast * sign * edge + np.random.default_rng(1).normal(0, noise, along.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("angle", [4, 31, 45, 83])
@pytest.mark.parametrize("sigma", [0.8, 1.2, 2.0, 3.0])
def test_width_of_edges_is_their_blur(sigma, angle):
    blur = edge_blur(stripes(sigma, angle), 255)
    assert blur.spot_px == pytest.approx(sigma, abs=0.1)
    assert blur.low_px <= blur.spot_px <= blur.high_px
    assert blur.width_px == pytest.approx(2 * 1.2816 * blur.spot_px, rel=1e-3)


def test_contrast_and_noise_do_not_pass_for_focus():
    usual = edge_blur(stripes(1.5, 20), 255).spot_px
    assert edge_blur(stripes(1.5, 20, contrast=25), 255).spot_px == pytest.approx(usual, rel=0.05)
    assert edge_blur(stripes(1.5, 20, noise=4), 255, noise_dn=4).spot_px == pytest.approx(usual, rel=0.05)


def test_nothing_is_said_where_there_are_no_edges_or_they_are_clipped():
    plain = np.random.default_rng(0).normal(100, 1.5, (240, 320)).astype(np.uint8)
    assert edge_blur(plain, 255) is None
    assert edge_blur(stripes(1.5, 20, contrast=200), 255) is None


def test_camera_is_judged_by_its_edges():
    sharp, soft, lost = (camera_focus(edge_blur(stripes(s, 10), 255)) for s in (0.8, 1.8, 3.2))
    assert sharp.in_focus
    assert sharp.finding is None
    assert not soft.in_focus
    assert (soft.finding.code, soft.finding.refuses) == ("camera_out_of_focus", False)
    assert lost.finding.refuses
    assert soft.limit == CAMERA_SPOT_PX


@pytest.mark.parametrize(("spot", "in_focus", "refuses"), [(0.8, True, None), (2.5, False, False), (5.0, False, True)])
def test_projector_is_judged_by_the_contrast_of_its_fringes(spot, in_focus, refuses):
    fall = np.sinc(FREQUENCIES) * np.exp(-2 * np.pi**2 * spot**2 * FREQUENCIES**2)
    rng = np.random.default_rng(4)
    usable = fall > 0.02
    mtf = mtf_of_modulation(FREQUENCIES[usable], rng.uniform(40, 90, 4000) * fall[usable, None])
    focus = projector_focus(mtf)
    expected = np.sinc(1 / 16) * np.exp(-2 * np.pi**2 * spot**2 / 256)
    assert focus.value == pytest.approx(expected, abs=1e-3)
    assert focus.in_focus is in_focus
    assert (focus.finding and focus.finding.refuses) is refuses
