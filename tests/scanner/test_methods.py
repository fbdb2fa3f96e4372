"""Every method against arrays of truth: coordinates with honest σ, and what each paper claims of bounces.

No parameter of a method was chosen on the surfaces and seeds of this file.
"""

from __future__ import annotations

import itertools
import json
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from drivers import OperatorError
from scanner.acquisition import Acquisition
from scanner.config import METHOD_NAMES, ConfigError, ScanSection, method_names, register_file
from scanner.decoding import Decoder
from scanner.methods import METHODS
from scanner.methods.embedded import embedded_frequencies
from scanner.methods.xor_code import CELL_PX, xor_planes
from scanner.patterns import Plan
from scanner.result import Flag
from scanner.take import TakeWriter

ONE_PATH = ["tps", "mps", "mps_gn", "modulated", "embedded", "xor", "mfs_paper"]


@pytest.fixture
def scan(tmp_path):
    numbers = itertools.count()

    def go(bench, method, **options):
        section, chosen = ScanSection(method=method, **options), METHODS[method]
        plan = chosen.first_round(section, bench.projector_size)
        manifest = {"method": method, "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": True}
        with TakeWriter.create(
            tmp_path / f"take{next(numbers)}",
            frame_format=bench.frame_format,
            slots=chosen.rounds * plan.frame_count,
            manifest=manifest,
        ) as take:
            acquisition = Acquisition(bench, chosen, section, Decoder(chosen, section, bench.noise, None), take)
            maps = acquisition.run()
        assert acquisition.notes == []
        return maps

    return go


@pytest.fixture
def surface(array_bench):
    """A slanted surface without bounces, 60 × 80 pixels."""

    def make(**changes):
        rows, columns = np.mgrid[0:120:2, 0:160:2].astype(float)
        x, y = 20.3 + 1.1 * columns + 0.05 * rows, 15.7 + 1.2 * rows
        none = np.zeros_like(x)
        return array_bench(**({"x": x, "y": y, "alpha": none, "x_bounce": x, "y_bounce": y} | changes))

    return make


@pytest.mark.parametrize("method", ONE_PATH)
def test_coordinates_of_a_clean_surface_have_the_sigma_they_claim(surface, scan, method):
    bench = surface(seed=11)
    maps = scan(bench, method)
    for u, sigma, truth in ((maps.x_p, maps.sigma_x, bench.x), (maps.y_p, maps.sigma_y, bench.y)):
        known = np.isfinite(u)
        # Of XOR code the finest plane's edges, where all planes are grey, cannot be told; fourteen frames leave noise.
        assert known.mean() > {"xor": 0.97, "mps_gn": 0.95}.get(method, 0.999)
        error = (u - truth)[known]
        assert (np.abs(error) > 1).mean() < 1e-3
        # 4800 pixels tell a standard deviation to 1 %; that fringes are shown in 8 bits adds some.
        assert 0.9 < error[np.abs(error) < 1].std() / np.median(sigma[known]) < 1.2
    # Of the light that follows the carrier half is left.
    expected = 0.6 * 127.5 / (2 if method == "modulated" else 1)
    assert np.median(maps.modulation) == pytest.approx(expected, rel=0.03)
    assert (maps.flags[np.isnan(maps.x_p)] != 0).all()


def glow(bench):
    """Let the right half of the picture also see the mean light of wide-spread places, as diffuse bounces make it."""
    plain, share = bench.light, np.where(np.arange(bench.x.shape[1]) >= bench.x.shape[1] // 2, 0.6, 0.0)

    def light(picture):
        wide = gaussian_filter(picture, 25, mode="nearest", truncate=3)
        there = map_coordinates(wide, [bench.y, 300 - 0.85 * bench.x], order=1, mode="nearest")
        return plain(picture) + share * bench.gain * there

    bench.light = light
    return bench


@pytest.mark.parametrize("method", ["tps", "mps", "mps_gn", "modulated", "embedded", "xor"])
def test_diffuse_bounces_leave_high_frequencies_alone_and_spoil_low_ones(surface, scan, method):
    bench = glow(surface(gain=0.4, seed=12))
    maps = scan(bench, method, steps=6)
    half = np.s_[:, bench.x.shape[1] // 2 :]
    error = np.nan_to_num(np.abs(maps.x_p - bench.x), nan=np.inf)[half]
    if method == "tps":
        # Its unwrapping starts from the spoilt fringes.
        assert (error > 1).mean() > 0.2
    else:
        assert (error > 1).mean() < {"xor": 0.05, "mps_gn": 0.3}.get(method, 0.01)
        assert np.median(error) < 1.2 * np.nanmedian(maps.sigma_x[half])


def test_embedded_frequencies_are_high_and_their_differences_span_the_picture():
    for extent in (320, 800, 1280, 1824):
        f = embedded_frequencies(extent)
        assert min(f) == 1 / 16
        assert max(f) < 1 / 11
        hidden = [a - f[0] for a in f[1:]]
        assert 1 / hidden[-1] == pytest.approx(extent)
        ratios = [a / b for a, b in itertools.pairwise([f[0], *hidden])]
        np.testing.assert_allclose(ratios, ratios[0])


def test_xor_code_tells_all_cells_apart_with_narrow_stripes_only():
    for extent in (320, 800, 1280):
        planes = xor_planes(extent)
        codes = {tuple(p) for p in planes.T}
        assert len(codes) == -(-extent // CELL_PX)
        for plane in planes:
            edges = np.flatnonzero(np.diff(plane)) + 1
            runs = np.diff([0, *edges, extent])
            assert runs.max() <= 2 * CELL_PX


FRAMES = {
    "tps": 72, "mps": 120, "mps_gn": 14, "modulated": 216, "embedded": 18, "xor": 2 * (16 + 12), "epipolar": 72,
    "mfs_paper": 216, "mfs1": 216, "mfs": 216,
}  # fmt: skip


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_plans_have_the_frames_of_their_papers_and_come_back_from_the_recording(method):
    size = (1280, 1280) if method == "xor" else (1280, 800)
    plan = METHODS[method].first_round(ScanSection(method=method), size)
    assert plan.frame_count == FRAMES[method]
    text = json.dumps(plan.to_json())
    assert len(text) < 60_000
    again = Plan.from_json(json.loads(text))
    assert again == plan
    for number in (0, len(plan.sequences) - 1):
        for a, b in zip(plan.render(number), again.render(number), strict=True):
            np.testing.assert_array_equal(a, b)
    assert METHODS[method].title


@pytest.fixture(scope="module")
def mirror(scan_simulated):
    def go(method):
        return scan_simulated(
            {"name": "mirror", "mirror_angle_deg": 103, "yaw_deg": 4},
            method,
            {"steps": 6},
            seed=41,
            camera={"width_px": 160, "height_px": 120, "exposure_us": 14_000},
            transport={"supersample": 1, "photons": 150_000},
        )

    return go


def test_the_epipolar_check_finds_what_pulls_off_the_line_and_misses_what_pulls_along_it(mirror):
    maps, truth = mirror("epipolar")
    plain, _ = mirror("tps")
    direct = np.isfinite(truth.x_p) & ~truth.edge
    bounce, clean = direct & (truth.alpha > 0.05), direct & (truth.alpha < 0.002)
    assert maps.interreflection[bounce].mean() > 0.7
    # Clean pixels: 0.1 % by the choice of the operator, and a binomial's spread.
    assert maps.interreflection[clean].mean() < 0.003
    assert np.isnan(maps.x_p[maps.interreflection]).all()
    # The baseline is level: what pulls y pulls off the line and is found, a wrong fringe of x stays on it.
    kept = bounce & np.isfinite(maps.x_p)
    assert kept.sum() > 100
    assert (np.abs(maps.y_p - truth.y_p)[kept] < 1).mean() > 0.99
    assert (np.abs(maps.x_p - truth.x_p)[kept] > 1).mean() > 0.1
    # It takes out more than the tolerance of 1 px, which every method has for the calibration's sake, does.
    off = (plain.flags & np.uint16(Flag.OFF_EPIPOLAR)) != 0
    assert maps.interreflection[off & bounce].all()
    assert maps.interreflection[bounce].sum() > 1.05 * (off & bounce).sum()


def test_the_papers_rule_leaves_emitters_lit_where_this_projects_does_not(mirror):
    literal, truth = mirror("mfs_paper")
    sound, _ = mirror("mfs")
    direct = np.isfinite(truth.x_p) & ~truth.edge
    bounce = direct & (truth.alpha > 0.05)
    assert literal.interreflection[bounce].mean() > 0.9
    assert literal.lit.mean() > 2 * sound.lit.mean()
    taken = (literal.flags & np.uint16(Flag.SECOND_ROUND)) != 0
    assert taken[literal.interreflection].mean() > 0.3
    error = [np.abs(m.x_p - truth.x_p)[bounce & np.isfinite(m.x_p)] for m in (literal, sound)]
    assert np.median(error[0]) > 3 * np.median(error[1])
    assert (error[0] > 8).mean() > 0.05 > (error[1] > 8).mean()


def test_one_round_keeps_what_two_paths_tell_and_nothing_else_in_the_region(mirror):
    once, truth = mirror("mfs1")
    twice, _ = mirror("mfs")
    np.testing.assert_array_equal(once.interreflection, twice.interreflection)
    assert once.lit is None
    inside = once.interreflection & np.isfinite(once.x_p)
    assert (((once.flags & Flag.SEPARATED) != 0)[inside]).all()
    outside = ~twice.interreflection & np.isfinite(once.x_p) & np.isfinite(truth.x_p) & ~truth.edge
    assert np.median(np.abs(once.x_p - truth.x_p)[outside]) < 0.05


# --- methods of others


STRANGER = """
from scanner.methods import OneRound


class Mine(OneRound):
    name, title = {name!r}, "Mine"

    def first_round(self, scan, size): ...

    def decode(self, frames, setup): ...


method = Mine()
"""


def test_a_method_of_an_installed_package_is_known_by_name(tmp_path, monkeypatch):
    (tmp_path / "strange_method.py").write_text(STRANGER.format(name="strange"))
    monkeypatch.syspath_prepend(tmp_path)
    entry = EntryPoint("strange", "strange_method:method", "scanner.methods")
    monkeypatch.setattr("scanner.config.methods.entry_points", lambda group: [entry])
    assert method_names() == (*METHOD_NAMES, "strange")
    assert METHODS["strange"].title == "Mine"
    assert ScanSection(method="strange").method == "strange"
    broken = EntryPoint("broken", "no_such_module:method", "scanner.methods")
    monkeypatch.setattr("scanner.config.methods.entry_points", lambda group: [broken])
    with pytest.raises(ConfigError, match="no_such_module"):
        METHODS["broken"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("method = 3\n", "lacks name, title"),
        ("nothing = 3\n", "is no method"),
        ("import nothing_of_this_name\n", "ModuleNotFoundError"),
        (STRANGER.format(name="tps"), "one of the scanner's own"),
    ],
)
def test_a_file_that_holds_no_method_is_refused(tmp_path, text, said):
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        register_file(path)


def test_an_unknown_method_is_answered_with_those_there_are():
    with pytest.raises(OperatorError, match="tps or mps or mps_gn") as told:
        METHODS["mps-gn"]
    assert "`mps_gn`" in told.value.remedy
    assert "nothing" not in METHODS
    assert METHODS.keys() >= set(METHOD_NAMES)
