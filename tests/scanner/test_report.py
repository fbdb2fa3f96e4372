"""The report: one self-contained page whose figures are the scan's."""

from __future__ import annotations

import base64
import io
import json
import re
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

from scanner.report import render
from scanner.report.figures import MISSING, Scale, outline, shrink
from scanner.report.surface import MAX_POINTS, LocalPlanes, local_planes, pack_points
from scanner.report.wording import length, number, per_cent
from scanner.result import Flag, Maps, ScanResult
from scanner.rig import Lens, Rig

READ_DN, STEPS, FREQUENCIES = 1.5, 12, 9
DOF = 2 * (2 * FREQUENCIES - 2)


def scene(width: int = 256, height: int = 192, seed: int = 1) -> ScanResult:
    """A tilted board, a ball before it, a bounce on the board, a highlight, nothing around: all in closed form."""
    rng = np.random.default_rng(seed)
    focal, baseline = 1.4 * width, 200.0
    v, u = np.mgrid[:height, :width].astype(np.float64)
    ray = np.dstack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)])
    normal = np.array([0.25, -0.1, -1.0]) / np.linalg.norm([0.25, -0.1, -1.0])
    z = -600 / (ray @ normal)
    centre, radius = np.array([35.0, 30.0, 500.0]), 62.0
    b, square = ray @ centre, (ray**2).sum(axis=2)
    hit = b**2 - square * (centre @ centre - radius**2)
    ball = hit > 0
    z = np.where(ball, (b - np.sqrt(np.maximum(hit, 0))) / square, z)
    board = (np.abs(u / width - 0.5) < 0.44) & (np.abs(v / height - 0.5) < 0.42)
    seen = ball | board
    face = np.where(ball[..., None], (ray * z[..., None] - centre) / radius, normal)
    light = np.clip(-(face * (ray / np.linalg.norm(ray, axis=2, keepdims=True))).sum(axis=2), 0, 1)
    albedo = np.where((u // (width / 16) + v // (width / 16)) % 2 == 0, 1.0, 0.85)
    modulation = np.where(seen, 95 * light**1.5 * albedo, 0.4) + rng.normal(0, 0.3, u.shape)
    saturated = np.hypot(u / width - 0.57, v / height - 0.52) < 0.018
    region = (((u / width - 0.26) / 0.09) ** 2 + ((v / height - 0.42) / 0.2) ** 2 < 1) & board & ~ball
    inner = ball.copy()
    inner[1:-1, 1:-1] = ball[:-2, 1:-1] & ball[2:, 1:-1] & ball[1:-1, :-2] & ball[1:-1, 2:]
    edge = ball & ~inner

    phase_noise = np.sqrt(2 / STEPS) * READ_DN / np.maximum(modulation, 0.1)
    sigma_x = phase_noise / (2 * np.pi / 15.2 * np.sqrt(FREQUENCIES))
    sigma_point = sigma_x * z**2 / (baseline * 1500) * np.linalg.norm(ray, axis=2)
    z = z + rng.normal(size=z.shape) * sigma_point / np.linalg.norm(ray, axis=2)
    points = ray * z[..., None]
    x_p = 640 + 1500 * (points[..., 0] + baseline) / z - 1500 * baseline / 600
    y_p = 400 + 1500 * points[..., 1] / z
    misfit = rng.chisquare(DOF, u.shape) / DOF
    bounce = 40 * (1.2 + np.sin(u / width * 90)) * region
    misfit += bounce + 6 * edge
    variation = np.abs(rng.normal(0.6, 0.1, u.shape)) + 0.12 * bounce
    first = x_p + np.where(region, 16 * rng.integers(-2, 3, u.shape) * (np.sin(u / width * 200) > 0.2), 0)

    flags = np.zeros(u.shape, np.uint16)
    for mask, flag in (
        (~seen, Flag.LOW_MODULATION),
        (saturated, Flag.SATURATED),
        (region, Flag.INTERREFLECTION),
        (region & (u / width > 0.24), Flag.SECOND_ROUND),
        (region & (u / width <= 0.24), Flag.SEPARATED),
        (region & (rng.random(u.shape) < 0.02), Flag.MISFIT),
        (edge, Flag.DEPTH_EDGE),
        (edge & (rng.random(u.shape) < 0.5), Flag.OFF_EPIPOLAR),
    ):
        flags[mask] |= np.uint16(flag)
    invalid = ~seen | saturated | ((flags & (Flag.MISFIT | Flag.OFF_EPIPOLAR)) != 0)

    def measured(values: np.ndarray) -> np.ndarray:
        return np.where(invalid if values.ndim == 2 else invalid[..., None], np.nan, values).astype(np.float32)

    lit = np.zeros((800, 1280), bool)
    columns, rows = (np.clip(c[region].astype(int), 0, top) for c, top in ((x_p, 1279), (y_p, 799)))
    for row, column in zip(rows[::7], columns[::7], strict=True):
        lit[max(row - 8, 0) : row + 9, max(column - 8, 0) : column + 9] = True
    maps = Maps(
        x_p=measured(x_p),
        y_p=measured(y_p),
        sigma_x=measured(sigma_x),
        sigma_y=measured(sigma_x),
        modulation=modulation.astype(np.float32),
        brightness=(modulation + 12).astype(np.float32),
        variation=variation.astype(np.float32),
        misfit=misfit.astype(np.float32),
        misfit_dof=DOF,
        interreflection=region,
        flags=flags,
        depth=measured(z),
        points=measured(points),
        sigma_point=measured(sigma_point),
        epipolar_px=measured(rng.normal(size=u.shape) * sigma_x),
        x_p_round1=measured(first),
        y_p_round1=measured(y_p),
        misfit_round2=measured(rng.chisquare(DOF, u.shape) / DOF),
        lit=lit,
        regional_pattern=np.clip((region * (100 + 90 * np.cos(x_p * 2 * np.pi / 16)) + 8) * seen, 0, 255).astype(
            np.uint8
        ),
    )
    summary = {
        "bench": "simulated <mirror>",
        "created": "2025-03-01T10:20:30+00:00",
        "frames": {"round 1": 216, "round 2": 216, "repeated": 12},
        "counts": {"valid": int(maps.valid.sum()), "interreflection": int(region.sum())},
        "timings_s": {"capture": 41.25, "decode": 3.5, "triangulate": 0.75},
        "quality": {"valid share": 0.7361, "median misfit chi2/dof": 1.0123},
        "gates": [
            {
                "name": "coverage",
                "value": 0.981,
                "limit": 0.95,
                "passed": True,
                "meaning": "pixels with fringes that have a point",
            },
            {
                "name": "stale frames",
                "value": 2,
                "limit": 0,
                "passed": False,
                "meaning": "frames that repeat their predecessor",
            },
        ],
        "noise": {"read_dn": READ_DN, "dn_per_electron": 0.02},
        "versions": {"mfs-scanner": "0.1.0", "numpy": np.__version__},
    }
    return ScanResult("mfs", True, maps, summary, ["The projector's rim is dim: 3 % of its columns are below 10 DN."])


class Page(HTMLParser):
    """Checks that every tag is closed in order, and collects ids, references, tables, texts and scripts."""

    VOID = ("meta", "img", "br", "link", "input")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.unlabelled: list[str] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.scripts: dict[str, str] = {}
        self.tiles: dict[str, str] = {}
        self.text = ""
        self._ids: list[str | None] = []
        self._table: list[list[str]] | None = None
        self._heading = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._attributes(tag, attrs)
        if tag in self.VOID:
            return
        self.open.append(tag)
        self._ids.append(dict(attrs).get("id"))
        if tag == "table":
            self._table = self.tables.setdefault(self._ids[-1] or "", [])
        elif self._table is not None and tag == "tr":
            self._table.append([])
        elif self._table and tag in ("td", "th"):
            self._table[-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._attributes(tag, attrs)

    def _attributes(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.ids += [v for k, v in attrs if k == "id" and v]
        self.references += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href", "action", "data")]
        if (tag == "img" and "alt" not in given) or (given.get("role") == "img" and not given.get("aria-label")):
            self.unlabelled.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag
        self._ids.pop()
        if tag == "table":
            self._table = None

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[self._ids[-1] or "code"] = data
            return
        if "style" in self.open:
            return
        self.text += data
        if self._table and self._table[-1] and ("td" in self.open or "th" in self.open):
            self._table[-1][-1] += data
        if self.open and self.open[-1] == "h3":
            self._heading = data
        elif self.open[-1:] == ["p"] and "key-figures" in self._ids:
            self.tiles[self._heading] = data


def plain(text: str) -> str:
    return text.replace("\u202f", "").replace("−", "-").strip()


@pytest.fixture(scope="module")
def scan() -> ScanResult:
    return scene()


@pytest.fixture(scope="module")
def html(scan: ScanResult) -> str:
    return render(scan, title="Ball & board")


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_page_is_well_formed(page: Page) -> None:
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert page.unlabelled == []
    assert "Ball & board" in page.text
    assert "simulated <mirror>" in page.text  # names from outside are escaped, not markup


def test_page_loads_nothing(html: str, page: Page) -> None:
    assert page.references
    assert all(r.startswith(("data:image/png;base64,", "#")) for r in page.references)
    style = "".join(re.findall(r"<style.*?</style>", html, re.S))
    assert re.findall(r"url\((?!#)|@import", style) == []
    assert re.findall(r"fetch\(|XMLHttpRequest|import\(|WebSocket", page.scripts["code"]) == []
    assert re.findall(r"https?://", re.sub(r'xmlns(:\w+)?="[^"]*"', "", html)) == []


def test_numbers_are_those_of_the_scan(scan: ScanResult, page: Page) -> None:
    maps = scan.maps
    shown = {row[0]: int(plain(row[1])) for row in page.tables["flags"][1:]}
    for flag in Flag:
        expected = sum(bool(v & flag.value) for v in maps.flags.ravel().tolist())
        assert shown[flag.name.lower().replace("_", " ")] == expected
    assert shown["no remark"] == np.count_nonzero(maps.flags == 0)

    fringes = [not v & 1 for v in maps.flags.ravel().tolist()]
    valid = np.isfinite(maps.x_p) & np.isfinite(maps.y_p)
    assert int(plain(page.tiles["points"])) == np.isfinite(maps.depth).sum()
    assert float(page.tiles["coverage"][:-2]) == pytest.approx(100 * valid.ravel()[fringes].mean(), rel=1e-3)
    assert float(page.tiles["median σ"][:-3]) == pytest.approx(1000 * np.nanmedian(maps.sigma_point), rel=6e-3)
    assert page.tiles["median σ"].endswith("µm")
    region = maps.interreflection.ravel()[fringes].mean()
    assert float(page.tiles["bounce region"][:-2]) == pytest.approx(100 * region, rel=6e-3)
    assert page.tiles["frames"] == "432"
    assert page.tiles["time"] == "45.5 s"

    assert [[plain(c) for c in row[1:4]] for row in page.tables["gates"][1:]] == [
        ["coverage", "0.981", "0.95"],
        ["stale frames", "2", "0"],
    ]
    assert "1 of 2 quality gates failed" in page.text
    assert {r[0]: r[1] for r in page.tables["timings"]} == {
        "capture": "41.25 s",
        "decode": "3.5 s",
        "triangulate": "0.75 s",
    }
    assert dict(page.tables["versions"])["numpy"] == np.__version__
    assert plain(dict(page.tables["counts"])["valid"]) == f"{valid.sum()} px"
    assert scan.warnings[0] in page.text


def test_figures_that_the_scan_calls_for(page: Page) -> None:
    assert set(page.ids) >= {
        *("modulation", "variation", "misfit", "regional", "lit", "change-x", "x_p", "y_p", "epipolar", "flag-map"),
        *("depth", "sigma", "residual", "sigma-chart", "misfit-chart", "pull-chart", "viewer"),
    }
    assert "expected, ν = 32" in page.text


def test_simulated_is_stamped_and_real_is_not(scan: ScanResult, page: Page) -> None:
    assert page.text.count("SIMULATED DATA") == 2
    quick = replace(scan, simulated=False, maps=replace(scan.maps, points=None))
    assert "SIMULATED" not in render(quick)


def test_one_axis_without_rig_and_second_round(scan: ScanResult) -> None:
    absent = ("y_p", "sigma_y", "variation", "depth", "points", "sigma_point", "epipolar_px", "x_p_round1")
    absent += ("y_p_round1", "misfit_round2", "lit", "regional_pattern")
    maps = replace(scan.maps, misfit_dof=0, **dict.fromkeys(absent))
    page = Page(render(ScanResult("tps", False, maps, {})))
    assert "x_p" in page.ids
    assert "sigma_x" in page.ids
    assert not {"y_p", "viewer", "lit", "regional", "depth", "residual", "gates", "timings"} & set(page.ids)
    assert "no quality gates were set" in page.text
    assert "expected, ν" not in page.text


def test_nothing_measured(scan: ScanResult) -> None:
    maps = scan.maps
    nan = {n: np.full_like(v, np.nan) for n, v in vars(maps).items() if isinstance(v, np.ndarray) and v.dtype == "f4"}
    dark = replace(
        maps,
        **nan,
        flags=np.full_like(maps.flags, Flag.LOW_MODULATION),
        interreflection=np.zeros_like(maps.interreflection),
    )
    page = Page(render(replace(scan, maps=dark)))
    assert page.tiles["points"] == "0"
    assert page.tiles["coverage"] == "–"
    assert page.tiles["median σ"] == "–"
    assert "No pixel has a point." in page.text


def test_size_is_bounded_even_where_nothing_compresses(scan: ScanResult) -> None:
    """White noise in every map and every pixel measured: the worst that a large camera can bring."""
    rng = np.random.default_rng(3)
    shape = (640, 860)
    noise = {
        name: (10 + rng.standard_normal((*shape, *v.shape[2:]), np.float32))
        for name, v in vars(scan.maps).items()
        if isinstance(v, np.ndarray) and v.dtype == "f4"
    }
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    noise["points"] = np.dstack([u, v, 1000 + noise["depth"]])
    blobs = rng.random((64, 86)) < 0.5
    maps = replace(
        scan.maps,
        **noise,
        flags=rng.integers(0, 2048, shape).astype(np.uint16) & ~np.uint16(1),
        interreflection=blobs.repeat(10, 0).repeat(10, 1),
        regional_pattern=rng.integers(0, 256, shape).astype(np.uint8),
        lit=rng.random((800, 1280)) < 0.5,
    )
    html = render(replace(scan, maps=maps))
    assert len(html.encode()) < 6.5e6


def test_picture_paints_values_and_nan() -> None:
    values = np.linspace(3, 7, 600, dtype=np.float32).reshape(20, 30)
    values[4, 5] = np.nan
    scale = Scale("viridis", 3, 7, "mm")
    picture = decoded(scale.png(values))
    colours = 255 * mpl.colormaps["viridis"](np.nan_to_num((values - 3) / 4))[..., :3]
    known = np.isfinite(values)
    # Two roundings of half a step each: the picture's 255 levels and the map's own 256.
    step = 255 * np.abs(np.diff(mpl.colormaps["viridis"](np.arange(256))[:, :3], axis=0)).max()
    assert np.abs(picture[known] - colours[known]).max() <= step + 0.5
    assert picture[4, 5].tolist() == list(MISSING)


def decoded(url: str) -> np.ndarray:
    data = base64.b64decode(url.removeprefix("data:image/png;base64,"))
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(float)


@pytest.mark.parametrize(("low", "high"), [(0.8, 40.0), (0.011, 0.017), (1e-4, 1e3)])
def test_logarithmic_scale_has_round_ticks_within(low: float, high: float) -> None:
    ticks = Scale("magma", low, high, logarithmic=True).ticks()
    assert 2 <= len(ticks) <= 7
    assert all(low <= v <= high for v, _ in ticks)
    assert all(float(plain(label)) == pytest.approx(v) for v, label in ticks)


def test_shrink_averages_by_area_and_leaves_absent_out() -> None:
    rng = np.random.default_rng(5)
    values = rng.normal(100, 5, (2 * 400, 2 * 600)).astype(np.float32)
    values[:2, :2] = [[np.nan, 1], [3, np.nan]]
    values[2:4, 2:4] = [[np.nan, np.nan], [3, np.nan]]
    small = shrink(values)
    assert small.shape == (400, 600)
    with warnings.catch_warnings(action="ignore"):
        expected = np.nanmean(values.reshape(400, 2, 600, 2), axis=(1, 3))
    expected[1, 1] = np.nan
    np.testing.assert_allclose(small, expected, rtol=1e-5)


def test_outline_encloses_the_region() -> None:
    v, u = np.mgrid[:900, :1200]
    region = (np.hypot(u - 500, v - 400) < 200) & ~(np.hypot(u - 500, v - 400) < 80)
    region[700, 700] = True  # a speck
    path = outline(region, (600, 450))
    area = 0.0
    loops = path.strip("MZ").split("ZM")
    assert len(loops) == 2
    for loop in loops:
        x, y = np.array([[float(n) for n in vertex.split()] for vertex in loop.split("L")]).T
        area += 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
    # A contour is true to 1 px of the picture: 2π (100 + 40) px².
    assert abs(abs(area) - np.pi * (100**2 - 40**2)) < 2 * np.pi * 140


def plane_points(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A tilted plane: points, rays and its normal towards the camera."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    ray = np.dstack([(u - width / 2) / 400, (v - height / 2) / 400, np.ones_like(u)])
    normal = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    return ray * (-500 / (ray @ normal))[..., None], ray, normal


def test_local_planes_give_back_the_noise() -> None:
    """The residual is the noise along the normal; plane and mean take 8 / n of its variance (n = 225), 1.8 % of σ."""
    rng = np.random.default_rng(7)
    points, ray, normal = plane_points(200, 150)
    sigma = 0.02
    off = sigma * rng.standard_normal(ray.shape[:2])
    across = off * -(ray @ normal) / np.linalg.norm(ray, axis=2)
    noisy = points + ray / np.linalg.norm(ray, axis=2, keepdims=True) * off[..., None]
    planes = local_planes(noisy.astype(np.float32), 15)
    inner = planes.residual[10:-10, 10:-10]
    assert np.isfinite(inner).all()
    # Away from the camera is negative. 23 400 pixels know a standard deviation to 0.5 %.
    np.testing.assert_allclose(inner.std(), across[10:-10, 10:-10].std(), rtol=0.018 + 4 * 0.005)
    assert np.corrcoef(inner.ravel(), -across[10:-10, 10:-10].ravel())[0, 1] > 0.97
    # A window of side w px ≈ 19 mm holds the normal to σ √12 / (w √n) = 2.4e-4 rad.
    angle = np.arccos(np.clip(planes.normals[10:-10, 10:-10] @ normal, -1, 1))
    assert np.median(angle) < 2 * 2.4e-4


def test_local_planes_forget_curvature_and_outliers() -> None:
    points, ray, _ = plane_points(160, 120)
    spoilt = points.copy()
    spoilt[::9, ::9] *= 1.01  # five millimetres off
    planes = local_planes(spoilt, 15)
    clean = np.ones(points.shape[:2], bool)
    clean[::9, ::9] = False
    assert np.nanmax(np.abs(planes.residual[10:-10, 10:-10][clean[10:-10, 10:-10]])) < 1e-4
    assert np.abs(planes.residual[9:-9:9, 9:-9:9] + 5).max() < 1

    radius, centre = 80.0, np.array([0.0, 0.0, 500.0])
    b, square = ray @ centre, (ray**2).sum(axis=2)
    hit = b**2 - square * (centre @ centre - radius**2)
    ball = np.where((hit > 0)[..., None], ray * ((b - np.sqrt(np.maximum(hit, 0))) / square)[..., None], np.nan)
    planes = local_planes(ball, 15)
    front = np.linalg.norm(ball[..., :2], axis=2) < 0.5 * radius
    # The window's sagitta is (7 px · 1.05 mm)² / 2R = 0.34 mm; what stays is of fourth order.
    assert np.abs(planes.residual[front]).max() < 0.02
    assert np.abs(np.cross(planes.normals[front], (ball[front] - centre) / radius)).max() < 0.01


def test_local_planes_are_silent_where_there_is_no_plane() -> None:
    points, _, _ = plane_points(60, 40)
    points[:, 20:] = np.nan
    points[5, 40] = [1, 2, 500]  # alone
    planes = local_planes(points, 9)
    assert np.isnan(planes.residual[:, 20:]).all()
    assert np.isfinite(planes.residual[:, :20]).mean() > 0.9


def records(page: Page) -> tuple[dict, np.ndarray]:
    """The 3-D view's records, read by the layout that the viewer's script has."""
    described = json.loads(page.scripts["cloud"])
    raw = np.frombuffer(base64.b64decode(page.scripts["records"]), np.uint8).reshape(-1, 12)
    layout = re.search(
        r'\["position", gl.SHORT, false, (\d+)\].*?"level".*?(\d+)\].*?"normal".*?(\d+)\]', page.scripts["code"]
    )
    assert layout is not None
    assert [int(n) for n in layout.groups()] == [0, 6, 9]
    return described, raw


def test_view_holds_the_points(scan: ScanResult, page: Page) -> None:
    maps = scan.maps
    described, raw = records(page)
    points = raw[:, :6].copy().view("<i2") * described["step_mm"] + described["centre"]
    truth = maps.points[np.isfinite(maps.depth)]
    assert described["count"] == len(raw) == len(truth) == described["shown_of"]  # few enough to show all
    np.testing.assert_allclose(points, truth, atol=described["step_mm"] * 0.51)
    assert described["step_mm"] < 0.02
    assert (raw[:, 8] > 0).sum() == (maps.interreflection & np.isfinite(maps.depth)).sum()
    normals = raw[:, 9:].copy().view(np.int8) / 127
    # Unit vectors to the camera, as far as 8 bits go.
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=0.02)
    assert ((normals * truth).sum(axis=1) < 0).mean() > 0.99
    grey = maps.brightness[np.isfinite(maps.depth)] + maps.modulation[np.isfinite(maps.depth)]
    assert np.corrcoef(raw[:, 6], grey)[0, 1] > 0.99


def test_view_is_thinned_and_stray_points_left_out() -> None:
    points, _, _ = plane_points(700, 500)
    points[250, 350] = [0, 0, 1e6]
    shape = points.shape[:2]
    ones = np.ones(shape, np.float32)
    maps = Maps(
        None, ones, None, ones, ones, ones, None, ones, np.zeros(shape, bool), np.zeros(shape, np.uint16),
        points=points.astype(np.float32),
    )  # fmt: skip
    planes = LocalPlanes(np.zeros(shape, np.float32), np.full((*shape, 3), np.nan, np.float32), 9)
    described, packed = pack_points(maps, planes)
    assert 0.6 * MAX_POINTS < described["count"] <= MAX_POINTS
    assert len(base64.b64decode(packed)) == 12 * described["count"]
    assert described["shown_of"] == 350_000
    assert described["depth_mm"][1] < 1000
    # Every other column or row: neighbours are 2 px of 1.2 to 1.6 mm apart.
    assert 2 < described["spacing_mm"] < 4


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (True, "yes"),
        (1234567, "1 234 567"),
        (np.uint16(12), "12"),
        (-0.012345, "−0.01235"),
        (123456.7, "123 457"),
        ("≤ 3", "≤ 3"),
    ],
)
def test_number(value: object, written: str) -> None:
    assert number(value).replace("\u202f", " ") == written


@pytest.mark.parametrize(("mm", "written"), [(0.00123, "1.23 µm"), (0.25, "0.25 mm"), (float("nan"), "–")])
def test_length(mm: float, written: str) -> None:
    assert length(mm) == written


@pytest.mark.parametrize(("share", "written"), [(0.5, "50 %"), (0.99987, "99.99 %"), (1.0, "100 %"), (np.nan, "–")])
def test_per_cent(share: float, written: str) -> None:
    assert per_cent(share) == written


def test_rig_is_shown(scan: ScanResult) -> None:
    """At the board's distance a baseline of 200 mm square to the view is seen under atan(200 / z)."""
    camera = Lens(np.diag([358.4, 358.4, 1.0]), np.zeros(5), (256, 192))
    rig = Rig(camera, camera, np.eye(3), np.array([-200.0, 0, 0]))
    maps = scan.maps
    flat = np.where(np.isfinite(maps.points), np.array([0, 0, 600], np.float32), np.nan).astype(np.float32)
    page = Page(render(replace(scan, maps=replace(maps, points=flat)), rig=rig))
    shown = dict(page.tables["rig"])
    assert shown["baseline"] == "200 mm"
    assert shown["median depth"] == "600 mm"
    assert shown["triangulation angle there"] == "18.4°"
