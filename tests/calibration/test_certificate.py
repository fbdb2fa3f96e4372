"""The certificate: what it says, that nothing is missing silently, and that it stands by itself."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict

from calibration.acceptance import Figure, Limits, Quantity, Verdict
from calibration.acceptance.evaluation import Evaluation, Picture
from calibration.certificate import Certificate, CertificateError
from calibration.certificate.wording import amount, expanded

CALIBRATION = {
    "parameters": ["camera.fx", "camera.k1", "translation.x"],
    "values": [1000.1234, -0.0812, -172.41],
    "standard_uncertainty": [0.12, 0.0011, 0.021],
    "terms": {"camera": ["k1"], "projector": []},
    "rms_camera_px": 0.061,
    "expected_rms_camera_px": 0.058,
    "poses": ["pose 1", "pose 2", "pose 3"],
    "poses_dropped": ["pose 4 <tilted>"],
    "findings": [{"code": "few_tilts", "refuses": False, "what": "only 3 tilts", "remedy": "Tilt it further."}],
    "temperature_C": 21.5,
}


def sphere(rng, value=0.05):
    """An evaluation with a picture of Gaussian noise on a disc."""
    rows, columns = np.mgrid[:120, :160]
    region = np.hypot(rows - 60, columns - 80) < 45
    noise = rng.normal(0, 0.01, region.shape)
    residuals = noise[region]
    return Evaluation(
        "Sphere K-1",
        [
            Figure(
                Quantity.PROBING_FORM,
                "Sphere K-1",
                value,
                {"noise of the points": 0.0009, "form of the artefact": 0.0012},
                residuals.size,
                19,
                0.0592,
                0.0009,
                "99 % of the cap has points",
            ),
            Figure(Quantity.PROBING_SIZE, "Sphere K-1", -0.0123, {"noise of the points": 0.002}, residuals.size),
            Figure(Quantity.REPEATABILITY, "Sphere K-1", None, note="one scan only & no more"),
        ],
        [
            Picture(
                "Sphere K-1: deviation",
                np.where(region, noise, np.nan).astype(np.float32),
                region,
                residuals,
                np.full(residuals.size, 0.01),
            )
        ],
        {"kind": "sphere", "diameter_mm": 50.0},
    )


@pytest.fixture
def certificate():
    limits = Limits(probing_form_mm=0.1, probing_size_mm=0.01, flatness_mm=0.2)
    return Certificate(
        "bench <7>",
        True,
        [sphere(np.random.default_rng(1))],
        limits,
        None,
        CALIBRATION,
        {"Method": "mfs"},
        {"mfs-scanner": "0.1"},
    )


class Figures(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    quantity: str
    artefact: str
    value_mm: float | None
    standard_uncertainty_mm: float | None
    expanded_uncertainty_mm: float | None
    coverage_factor: float
    uncertainty_budget_mm: dict[str, float]
    limit_mm: float | None
    verdict: str
    points: int
    rejected: int
    expected_from_noise_mm: float | None
    expected_from_noise_std_mm: float | None
    note: str


class Document(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: str
    version: int
    created: str
    bench: str
    simulated: bool
    verdict: str
    guideline: str
    decision_rule: str
    figures: list[Figures]
    artefacts: list[dict]
    conditions: dict
    calibration: dict
    rig: dict | None
    versions: dict[str, str]


def test_files(certificate, tmp_path):
    data, page = tmp_path / "certificate.json", tmp_path / "certificate.html"
    certificate.write(data, page)
    assert sorted(p.name for p in tmp_path.iterdir()) == [page.name, data.name]
    document = Document.model_validate(json.loads(data.read_text("utf-8")))
    assert document.simulated
    by_name = {f.quantity: f for f in document.figures}
    form = by_name["probing_form"]
    assert form.standard_uncertainty_mm == pytest.approx(0.0015)
    assert form.expanded_uncertainty_mm == pytest.approx(0.003)
    assert (form.verdict, form.limit_mm) == ("pass", 0.1)
    assert by_name["probing_size"].verdict == "within the uncertainty zone"
    # A limit that nothing answers to is there, with the reason.
    assert by_name["flatness"].verdict == "not measured"
    assert "no artefact" in by_name["flatness"].note
    assert document.verdict == "not measured"
    assert document.calibration["standard_uncertainty"] == CALIBRATION["standard_uncertainty"]


def test_numbers_that_are_none_become_null(tmp_path):
    evaluation = Evaluation("x", [Figure(Quantity.FLATNESS, "x", 0.1, noise_mm=float("nan"))])
    found = Certificate("b", False, [evaluation], calibration={"values": np.array([1.0, np.inf])})
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert document["figures"][0]["expected_from_noise_mm"] is None
    assert document["calibration"]["values"] == [1.0, None]


class Page(HTMLParser):
    """Rows of tables, texts, and every reference out of the page."""

    def __init__(self, text):
        super().__init__()
        self.references, self.rows, self.open, self.text = [], [], [], []
        self._cell = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br", "image", "path", "use", "input"):
            self.open.append(tag)
        self.references += [v for k, v in attrs if k in ("src", "href", "xlink:href", "action", "data") and v]
        if tag == "tr":
            self.rows.append([])
        self._cell = tag in ("td", "th") or (self._cell and tag not in ("tr", "table"))
        if tag in ("td", "th") and self.rows:
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        if tag in self.open:
            while self.open.pop() != tag:
                pass
        if tag in ("td", "th"):
            self._cell = False

    def handle_data(self, data):
        if self.open and self.open[-1] in ("style", "script"):
            return
        self.text.append(data)
        if self._cell and self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


def test_page_says_everything_and_needs_nothing(certificate):
    html = certificate.to_html()
    page = Page(html)
    assert page.open == []
    assert all(r.startswith(("data:", "#")) for r in page.references)
    assert not re.search(r"url\((?!#|data:)", html)
    assert not re.search(r"@import|<link|<iframe", html)
    rows = {row[1]: row for row in page.rows if len(row) == 8}
    assert rows["Probing error, form PF"][0] == "✓ pass"
    assert rows["Probing error, form PF"][3] == "0.0500 ± 0.0030"
    assert rows["Probing error, form PF"][5] == "0.05920 ± 0.00090"
    assert rows["Probing error, size PS"][0] == "≈ within the uncertainty zone"
    assert rows["Probing error, size PS"][3] == "−0.0123 ± 0.0040"
    assert rows["Repeatability of a point"][7] == "one scan only & no more"
    assert rows["Flatness error F"][0] == "∅ not measured"
    text = " ".join(page.text)
    for said in (
        "SIMULATED DATA",
        "bench <7>",
        "VDI/VDE 2634 part 2",
        "pose 4 <tilted>",
        "only 3 tilts",
        "0.061 px (expected 0.058 px)",
        "21.5",
    ):
        assert said in text
    assert ["camera.fx", "1000.12", "0.12", "px"] in page.rows
    assert ["camera.k1", "−0.0812", "0.0011", ""] in page.rows
    assert html.count('class="map"') == 1
    assert html.count('class="chart"') == 1
    assert "1 of 3 limits are kept" in text


def test_verdicts_of_the_whole(certificate):
    rng = np.random.default_rng(2)

    def verdict(**limits):
        return Certificate("b", False, [sphere(rng)], Limits(**limits))

    assert verdict().verdict is Verdict.REPORTED
    assert verdict(probing_form_mm=0.06).verdict is Verdict.PASS
    assert "all 1 limits are kept" in verdict(probing_form_mm=0.06).to_html()
    failed = verdict(probing_form_mm=0.04, probing_size_mm=0.01)
    assert failed.verdict is Verdict.FAIL
    assert "1 of 2 limits are exceeded" in failed.to_html()
    assert "SIMULATED" not in failed.to_html()
    assert verdict(repeatability_mm=0.1).verdict is Verdict.MISSING


def test_a_certificate_of_nothing_and_of_scraps_of_a_calibration():
    for calibration in (
        {},
        {"parameters": ["a"]},
        {"values": [1.0], "parameters": ["a"]},
        {"findings": ["x"], "poses": 3},
    ):
        html = Certificate("b", False, [], calibration=calibration).to_html()
        assert "Nothing was measured" in html
    assert "no notes of a calibration" in Certificate("b", False, []).to_html()
    lost = Evaluation("Plane", [Figure(Quantity.FLATNESS, "Plane", None, note="the scan shows no flat region")])
    assert "Not measured: the scan shows no flat region" in Certificate("b", False, [lost]).to_html()


def test_a_place_that_cannot_be_written(certificate, tmp_path):
    with pytest.raises(CertificateError, match="cannot write"):
        certificate.write(tmp_path / "none" / "c.json", tmp_path / "none" / "c.html")


@pytest.mark.parametrize(
    ("value", "u", "written"),
    [
        (0.118712, 0.00063, ("0.11871", "0.00063")),
        (-12.3456, 0.42, ("−12.35", "0.42")),
        (1234.5, 37.0, ("1234", "37")),
        (0.25, 0.0, ("0.25", "–")),
        (None, 0.1, ("–", "0.10")),
    ],
)
def test_digits_follow_the_uncertainty(value, u, written):
    assert (amount(value, u), expanded(u)) == written
