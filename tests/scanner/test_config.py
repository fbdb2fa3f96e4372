"""What an operator meets in the configuration: every mistake with its place and remedy, benches found by name."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Annotated, Any, Literal

import pytest
from hypothesis import event, example, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field, ValidationError, computed_field, model_validator
from typing_extensions import TypeAliasType

from drivers import OperatorError
from scanner import config as cfg
from scanner.config import ConfigError, load_config

REPOSITORY = Path(__file__).parents[2]


# --- a bench kind that this file brings along


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Camera(Section):
    exposure_us: float = Field(16_667, gt=0, le=1e7, description="Exposure time, µs.")
    bits: Literal[8, 10, 12] = 8
    serial: str = "0"


class Projector(Section):
    width_px: int = 1280
    height_px: int = 800

    @computed_field
    def aspect(self) -> float:
        return self.width_px / self.height_px


class Ball(Section):
    name: Literal["ball"]
    radius_mm: float = Field(gt=0, description="Radius, mm.")
    camera: int = Field(0, description="A field that is called like another section.")


class Board(Section):
    name: Literal["board"]
    tilt_deg: float = 0
    corner: tuple[float, float] = (0, 0)

    @model_validator(mode="after")
    def _stands(self) -> Board:
        if abs(self.tilt_deg) > 80:
            raise ValueError("a board tilted by more than 80° is not seen")
        return self


class BenchSettings(Section):
    camera: Camera = Camera()
    projector: Projector = Projector()
    scene: Annotated[Ball | Board, Field(discriminator="name")] = Board(name="board")
    stops: list[Board] = []
    gain: float | str | None = Field(None, description="A plain union.")
    file: Path | None = None
    options: dict[str, int] = {}


class Kind:
    settings = BenchSettings

    def __init__(self) -> None:
        self.events: list[Any] = []

    @contextmanager
    def open(self, settings: BenchSettings) -> Iterator[str]:
        self.events.append(settings)
        yield "an open bench"
        self.events.append("closed")


@pytest.fixture(autouse=True)
def kind(monkeypatch: pytest.MonkeyPatch) -> Kind:
    """The only installed bench kind is `own`."""
    module: Any = ModuleType("own_bench")
    module.kind = Kind()
    monkeypatch.setitem(sys.modules, "own_bench", module)
    install(monkeypatch, own="own_bench:kind")
    return module.kind


def install(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    entries = [EntryPoint(name, value, cfg.BENCH_GROUP) for name, value in values.items()]
    monkeypatch.setattr("scanner.config.benches.entry_points", lambda group: entries)


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def write(text: str | bytes) -> Path:
        path = tmp_path / "bench.yaml"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


def refusal(path: Path, overrides: dict[str, Any] | None = None) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    error = caught.value
    assert isinstance(error, OperatorError)
    assert error.exit_code == 2
    # The operator sees all that the problems hold.
    for problem in error.problems:
        assert problem.sentence in str(error)
        assert problem.remedy in str(error)
    return error


BENCH = "bench:\n  kind: own\n"

# Each case: the file with the mistake marked by ▸ (taken out before it is written), the field, what the message must
# say of it, what the remedy must say.
MISTAKES = {
    # values
    "too few steps": (BENCH + "scan:\n  steps: ▸2\n", "scan.steps", "found 2, expected an integer ≥ 3", "12"),
    "not a number": (BENCH + "scan:\n  steps: ▸many\n", "scan.steps", "found many, expected an integer", "≥ 3"),
    "a switch for a number": (BENCH + "scan:\n  attempts: ▸true\n", "scan.attempts", "found true", "an integer"),
    "a fraction for a count": (BENCH + "scan:\n  steps: ▸12.5\n", "scan.steps", "found 12.5", "an integer"),
    "number in quotes": (BENCH + "scan:\n  steps: ▸'12'\n", "scan.steps", 'found "12"', "write 12 without quotes"),
    "decimal comma": (BENCH + "scan:\n  mean: ▸0,4\n", "scan.mean", 'found "0,4"', "0.4, with a decimal point"),
    "null for a number": (BENCH + "scan:\n  mean: ▸null\n", "scan.mean", "found null, expected a number ≥ 0", "0.5"),
    "not a number at all": (BENCH + "scan:\n  mean: ▸.nan\n", "scan.mean", "expected a finite number", "a number"),
    "mistyped choice": (BENCH + "scan:\n  method: ▸mffs\n", "scan.method", "tps or mps or mps_gn or", "`mfs`"),
    "a choice in capitals": (BENCH + "scan:\n  method: ▸MPS\n", "scan.method", "expected tps or mps", "`mps`"),
    "an unlike choice": (BENCH + "scan:\n  detector: ▸magic\n", "scan.detector", "misfit or variation or pooled", "χ²"),
    "one axis without brackets": (BENCH + "scan:\n  axes: ▸x\n", "scan.axes", "expected a list", "write `axes: [x]`"),
    "an axis that is none": (BENCH + "scan:\n  axes: [x, ▸z]\n", "scan.axes[1]", "found z, expected x or y", "x or y"),
    "an axis twice": (BENCH + "scan:\n  axes: ▸[y, y]\n", "scan.axes", "expected each axis once", "[x, y]"),
    "no axis": (BENCH + "scan:\n  axes: ▸[]\n", "scan.axes", "a list of at least 1", "[x, y] when in doubt"),
    "a share in percent": (
        BENCH + "gates: {min_valid_share: ▸30}\n",
        "gates.min_valid_share",
        "≥ 0 and ≤ 1",
        "Share of",
    ),
    "a list for a section": (BENCH + "output: ▸[ply]\n", "output", "found [ply], expected a section", "ply, report"),
    "empty rig": (BENCH + "rig: ▸''\n", "rig", "a text that is not empty", "rig"),
    "missing rig": (BENCH + "rig: ▸rigs/no.json\n", "rig", "found rigs/no.json, expected a rig file", "`rig: null`"),
    # the patterns
    "over full scale": (
        BENCH + "scan:\n  mean: 0.7\n  amplitude: ▸0.4\n",
        "scan.amplitude",
        "from 0.3 to 1.1",
        "an amplitude of 0.3 at most",
    ),
    "below black": (BENCH + "scan:\n  mean: ▸0.2\n", "scan.mean", "from -0.3 to 0.7", "an amplitude of 0.2 at most"),
    "no amplitude": (BENCH + "scan: {amplitude: ▸0}\n", "scan.amplitude", "a number > 0 and ≤ 0.5", "0.5 when"),
    "frequencies as periods": (
        BENCH + "scan:\n  periods_px: ▸[0.0625, 0.0125]\n",
        "scan.periods_px",
        "expected periods above 2 px; these look like frequencies",
        "`frequencies_per_px: [0.0625, 0.0125]` or `periods_px: [16, 80]`",
    ),
    "periods as frequencies": (
        BENCH + "scan:\n  frequencies_per_px: ▸[16, 80]\n",
        "scan.frequencies_per_px",
        "expected frequencies between 0 and 0.5 1/px; these look like periods",
        "`periods_px: [16, 80]` or `frequencies_per_px: [0.0625, 0.0125]`",
    ),
    "aliasing frequency": (
        BENCH + "scan:\n  frequencies_per_px: [1/16, ▸1/2, 1/1280]\n",
        "scan.frequencies_per_px[1]",
        "found 0.5, expected frequencies between 0 and 0.5 1/px",
        "pixels alias",
    ),
    "aliasing period": (
        BENCH + "scan:\n  periods_px: {x: [16, ▸2, 1280], y: [800]}\n",
        "scan.periods_px.x[1]",
        "found 2, expected periods above 2 px",
        "4 px or more",
    ),
    "a period that is a word": (
        BENCH + "scan:\n  periods_px: [16, ▸wide]\n",
        "scan.periods_px[1]",
        "found wide, expected a number > 2 or a fraction such as 81/1280",
        "a number",
    ),
    "one period without brackets": (BENCH + "scan: {periods_px: ▸1280}\n", "scan.periods_px", "a list", "[1280]`"),
    "no periods": (BENCH + "scan: {periods_px: ▸[]}\n", "scan.periods_px", "a list of at least 1", "periods"),
    "division by zero": (BENCH + "scan: {periods_px: [▸16/0]}\n", "scan.periods_px[0]", 'found "16/0"', "a number"),
    "periods and frequencies": (
        BENCH + "scan:\n  periods_px: [1280]\n  frequencies_per_px: ▸[1/1280]\n",
        "scan.frequencies_per_px",
        "found both periods_px and frequencies_per_px",
        "remove one",
    ),
    "fringes of an axis that is not measured": (
        BENCH + "scan:\n  axes: [x]\n  periods_px: {x: [1280], y: ▸[800]}\n",
        "scan.periods_px.y",
        "found fringes along y, expected none",
        "add y to axes",
    ),
    "an axis without fringes": (
        BENCH + "scan:\n  periods_px: ▸{x: [1280]}\n",
        "scan.periods_px",
        "found no fringes along y",
        "add `y: […]`",
    ),
    # gcd(80, 82) = 2, so both fringes come round after 1280/2 px.
    "range below the projector": (
        BENCH + "scan:\n  axes: [x]\n  frequencies_per_px: ▸[80/1280, 82/1280]\n",
        "scan.frequencies_per_px",
        "unambiguous over 640 px only, expected the projector's 1280 px",
        "period of 1280 px or more",
    ),
    # The paper's triple for the 800-px axis does not cover the 1280-px axis.
    "the other axis's triple": (
        BENCH + "scan:\n  periods_px: {x: ▸[16, 80, 800], y: [16, 80, 800]}\n",
        "scan.periods_px.x",
        "unambiguous over 800 px only, expected the projector's 1280 px",
        "null takes the method's own",
    ),
    # the bench's own settings
    "setting out of range": (
        BENCH + "  camera:\n    exposure_us: ▸-1\n",
        "bench.camera.exposure_us",
        "found -1, expected a number > 0",
        "Exposure time, µs",
    ),
    "value with a unit": (
        BENCH + "  camera:\n    exposure_us: ▸16.7 ms\n",
        "bench.camera.exposure_us",
        'found "16.7 ms"',
        "write `exposure_us: 16700`",
    ),
    "wrong unit": (
        BENCH + "  camera:\n    ▸exposure_ms: 16.7\n",
        "bench.camera.exposure_ms",
        "unknown key",
        "did you mean `exposure_us: 16700`? The unit is µs, not ms",
    ),
    "wrong unit, seconds": (
        BENCH + "  camera:\n    ▸exposure_s: 0.0167\n",
        "bench.camera.exposure_s",
        "unknown key",
        "did you mean `exposure_us: 16700`? The unit is µs, not s",
    ),
    "no unit": (
        BENCH + "  camera:\n    ▸exposure: 16.7\n",
        "bench.camera.exposure",
        "unknown key",
        "`exposure_us: 16.7`? The unit is µs; write 0.0167 if you mean ns, 16700 if you mean ms",
    ),
    "wrong unit, other word": (
        BENCH + "  camera:\n    ▸exposure_time_ms: 20\n",
        "bench.camera.exposure_time_ms",
        "unknown key",
        "did you mean `exposure_us: 20000`",
    ),
    "wrong unit, angle": (
        BENCH + "  scene: {name: board, ▸tilt_rad: 0.5235987755982988}\n",  # π/6
        "bench.scene.tilt_rad",
        "unknown key",
        "did you mean `tilt_deg: 30`? The unit is °, not rad",
    ),
    "another quantity": (
        BENCH + "  camera:\n    ▸exposure_mm: 3\n",
        "bench.camera.exposure_mm",
        "unknown key",
        "did you mean `exposure_us`? Its unit is µs",
    ),
    "unlike choice of the bench": (BENCH + "  camera: {bits: ▸9}\n", "bench.camera.bits", "8 or 10 or 12", "bits"),
    "a scene that does not exist": (
        BENCH + "  scene: {name: ▸bord}\n",
        "bench.scene.name",
        "found bord, expected one of: ball, board",
        "did you mean `board`?",
    ),
    "a scene without a name": (
        BENCH + "  ▸scene: {tilt_deg: 3}\n",
        "bench.scene.name",
        "one of: ball, board",
        "`name: ball`",
    ),
    "a setting of another scene": (
        BENCH + "  scene: {name: board, ▸radius_mm: 3}\n",
        "bench.scene.radius_mm",
        "expected one of: corner, name, tilt_deg",
        "remove it",
    ),
    "missing setting": (
        BENCH + "  ▸scene: {name: ball}\n",
        "bench.scene.radius_mm",
        "found nothing, expected a number > 0",
        "add `radius_mm: …` below `scene:` (Radius, mm)",
    ),
    "the model's own check": (
        BENCH + "  scene: ▸{name: board, tilt_deg: 85}\n",
        "bench.scene",
        "a board tilted by more than 80° is not seen",
        "correct",
    ),
    "in a list": (
        BENCH + "  stops:\n  - {name: board}\n  - {name: board, tilt_deg: ▸steep}\n",
        "bench.stops[1].tilt_deg",
        "found steep, expected a number",
        "a number",
    ),
    "in a tuple": (BENCH + "  scene: {name: board, corner: [1, ▸b]}\n", "bench.scene.corner[1]", "found b", "a number"),
    "in a plain union": (BENCH + "  gain: ▸[1]\n", "bench.gain", "a number or a text or null", "A plain union"),
    "in a free mapping": (BENCH + "  options: {a: 1, b: ▸x}\n", "bench.options.b", "found x, expected an integer", "b"),
    "a name like another section's": (
        BENCH + "  scene: {name: ball, radius_mm: 1, camera: ▸x}\n",
        "bench.scene.camera",
        "found x, expected an integer",
        "camera",
    ),
    # keys
    "mistyped key": (
        BENCH + "scan:\n  ▸metod: tps\n",
        "scan.metod",
        "expected one of: amplitude, attempts",
        "`method: tps`?",
    ),
    "key with hyphens": (
        BENCH + "scan:\n  ▸False-alarm rate: 0.01\n",
        'scan.False-alarm rate',
        "unknown key",
        "`false_alarm_rate: 0.01`",
    ),
    "key without px": (
        BENCH + "scan: {▸periods: [16, 1280]}\n",
        "scan.periods",
        "unknown key",
        "`periods_px: [16, 1280]`",
    ),
    "key of another section": (
        BENCH + "▸steps: 12\n",
        "steps",
        "expected one of: bench, calibration, compare, gates",
        "move it below `scan:`",
    ),
    "key of a deeper section": (
        BENCH + "▸exposure_us: 12\n",
        "exposure_us",
        "unknown key",
        "move it below `bench.camera:`",
    ),
    "an unlike key": (BENCH + "scan: {▸flux: 12}\n", "scan.flux", "unknown key", "remove it"),
    "key twice": (
        BENCH + "scan:\n  steps: 12\n  ▸steps: 8\n",
        "scan.steps",
        "a second time, expected it once; the first is on line 4",
        "remove one",
    ),
    "number as key": (BENCH + "scan:\n  ▸3: 12\n", "scan", "found 3 as a key, expected a name", "`name: value`"),
    "list as key": (BENCH + "scan:\n  ? ▸[a]\n  : 12\n", "scan", "a list or section as a key", "`name: value`"),
    "alias": (BENCH + "scan: &s\n  steps: 12\n▸gates: *s\n", "gates", "an alias", "write the value out"),
    "alias of itself": (BENCH + "scan: &s\n  ▸steps: *s\n", "scan.steps", "an alias", "write the value out"),
    # the bench kind
    "unknown bench": (
        "bench:\n  kind: ▸own1\n",
        "bench.kind",
        "found own1, expected an installed bench: own",
        "`own`?",
    ),
    "no bench kind": (
        "▸bench:\n  camera: {}\n",
        "bench.kind",
        "found nothing, expected a text",
        "add `kind: …` below `bench:`",
    ),
    "bench kind is a number": (
        "bench:\n  kind: ▸7\n",
        "bench.kind",
        "found 7, expected a text",
        "Name of an installed",
    ),
    "no bench": ("▸scan: {}\n", "bench", "found nothing, expected a section", "add `bench: …` to the file"),
    "empty bench": ("▸bench:\nscan: {}\n", "bench", "found null, expected a section", "section with kind"),
    # the YAML itself
    "tab": (BENCH + "scan:\n▸\tsteps: 12\n", "", "found a tab", "replace the tab"),
    "no blank after the colon": (
        BENCH + "scan:\n  steps:12\n  mean▸: 0.5\n",
        "",
        'found "mean: 0.5"',
        "blank after the colon",
    ),
    "bracket left open": (BENCH + "scan: {axes: [x, y}▸\n", "", "expected valid YAML", "close every bracket"),
    "two documents": (BENCH + "▸---\nscan: {}\n", "", "another document", "remove the line `---`"),
    "tag": (BENCH + "rig: ▸!!python/name:os.system x\n", "", "expected valid YAML", "begins with `!`"),
    "merge key": ("bench: {kind: own}\n▸<<: {scan: {}}\n", "", "expected valid YAML", "`<<`"),
    "undefined alias": (BENCH + "rig: ▸*.json\n", "", "undefined alias", "put the text in quotes"),
    "empty file": ("▸", "", "found an empty file", "`kind: simulated`"),
    "comments only": ("▸# bench:\n", "", "found an empty file", "configs/demo.yaml"),
    "a list": ("▸- bench\n", "", "found [bench]", "`bench:`"),
    "a word": ("▸bench\n", "", "found bench", "`bench:`"),
    "control character": (BENCH + "rig: a▸\x07b\n", "", "control character 0x07", "delete"),
    "an endless number": (BENCH + f"scan: {{steps: ▸{'9' * 5000}}}\n", "scan.steps", "cannot be read", "quotes"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_told_with_place_field_and_remedy(case: str, write: Any) -> None:
    marked, field, found, remedy = MISTAKES[case]
    before = marked[: marked.index("▸")]
    path = write(marked.replace("▸", ""))
    error = refusal(path)
    assert len(error.problems) == 1, str(error)
    problem = error.problems[0]
    # "bracket left open" and its like are noticed by the parser where it fails, within the line.
    assert (problem.file, problem.line) == (str(path), before.count("\n") + 1)
    if case not in ("bracket left open",):
        assert problem.column == len(before.rpartition("\n")[2]) + 1
    assert problem.field == field
    assert found in problem.what
    assert remedy in problem.remedy
    assert str(error).startswith(f"{path}, line {problem.line}, column {problem.column}: {field}")


def test_all_mistakes_of_a_file_are_told_at_once_in_its_order(write: Any) -> None:
    path = write(
        "output: {ply: 3}\nbench:\n  kind: own\n  camera:\n    exposure_ms: 3\n  scene: {name: ball}\nrig: no.xml\n"
        "scan:\n  stps: 12\n  axes: [q]\n  periods_px: [1, 16]\n"
    )
    error = refusal(path)
    assert [(p.line, p.field) for p in error.problems] == [
        (1, "output.ply"),
        (5, "bench.camera.exposure_ms"),
        (6, "bench.scene.radius_mm"),
        (7, "rig"),
        (9, "scan.stps"),
        (10, "scan.axes[0]"),
        (11, "scan.periods_px[0]"),
    ]
    assert str(error).count("→") == 8  # one remedy for each and one for the whole
    assert "correct these 7 places" in error.remedy


def test_a_renamed_key_is_not_reported_as_missing_too(write: Any) -> None:
    problems = refusal(write(BENCH + "  scene: {name: ball, radius_cm: 3}\n")).problems
    assert [p.field for p in problems] == ["bench.scene.radius_cm"]
    assert "`radius_mm: 30`" in problems[0].remedy


@pytest.mark.parametrize(
    ("make", "found", "remedy"),
    [
        (lambda folder: folder / "quark", "found no such file", "correct the path"),
        (lambda folder: folder / "bemch.yaml", "found no such file", "did you mean"),
        (lambda folder: folder / "nowhere" / "no.yaml", "found no such file", "correct the path"),
        (lambda folder: folder, "found a folder, expected a YAML file", "bench.yaml"),
        (lambda folder: folder / "bench.yaml" / "x.yaml", "cannot be read", "check the path"),
        (lambda folder: folder / "nul\0.yaml", "cannot be read", "check the path"),
        (lambda folder: Path(os.devnull), "an empty file", "`bench:`"),
        (lambda folder: Path("/dev/zero"), "more than 1 MiB", "name a YAML file"),
    ],
)
def test_a_file_that_cannot_be_read(tmp_path: Path, write: Any, make: Any, found: str, remedy: str) -> None:
    write(BENCH)
    path = make(tmp_path)
    problem = refusal(path).problems[0]
    assert problem.file == str(path)
    assert found in problem.what
    assert remedy in problem.remedy


def test_a_file_that_may_not_be_read(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(BENCH)
    path.chmod(0)
    if os.access(path, os.R_OK):  # the superuser reads everything
        monkeypatch.setattr(Path, "open", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    problem = refusal(path).problems[0]
    assert "may not read" in problem.what
    assert "permission" in problem.remedy


@pytest.mark.parametrize(
    ("raw", "place"),
    [(b"bench:\n  kind: \xe9\n", (2, 9)), (BENCH.encode("utf-16"), (1, 1)), (b"a: \xc3\xa9\xff", (1, 5))],
)
def test_a_file_that_is_not_utf8(write: Any, raw: bytes, place: tuple[int, int]) -> None:
    problem = refusal(write(raw)).problems[0]
    assert (problem.line, problem.column) == place
    assert "not UTF-8" in problem.what
    assert "UTF-8" in problem.remedy


def test_depth_that_would_exhaust_the_parser(write: Any) -> None:
    assert "levels" in refusal(write("a: " + "[" * 500)).message


@settings(database=None, deadline=None, derandomize=True, max_examples=100)
@given(
    st.lists(
        st.tuples(st.integers(0, 400), st.sampled_from([*"\t:{}[]&*!'\"#-x3\n\0é", "scan:\n", "null"])), max_size=4
    )
)
def test_no_mutilation_of_a_file_gets_past_the_errors(edits: list[tuple[int, str]]) -> None:
    text = BENCH + "  camera: {exposure_us: 5}\nscan:\n  axes: [x]\n  periods_px:\n    x: [16, 1280]\ngates: {}\n"
    for place, piece in edits:
        text = text[: place % len(text)] + piece + text[place % len(text) + 1 :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.yaml"
        path.write_bytes(text.encode())
        problems: tuple[cfg.Problem, ...] = ()
        try:
            load_config(path)
        except ConfigError as error:
            problems = error.problems
            event("refused")
        assert all(p.line and p.what and p.remedy for p in problems)


# --- what a valid file gives


def test_the_least_file_has_all_defaults(write: Any) -> None:
    loaded = load_config(write(BENCH + "scan:\ngates:\noutput:\n"))  # sections whose lines are all commented out
    scan = loaded.config.scan
    assert (scan.method, scan.axes, scan.steps, scan.mean, scan.amplitude) == ("mfs", ("x", "y"), 12, 0.5, 0.5)
    assert (scan.detector, scan.regional_rule, scan.attempts) == ("misfit", "sound", 3)
    assert scan.frequencies("x") is None
    assert loaded.bench_settings == BenchSettings()
    assert loaded.rig_path is None
    assert loaded.warnings == ()
    assert cfg.METHOD_NAMES[:3] == ("tps", "mps", "mps_gn")
    assert cfg.METHOD_NAMES[-1] == "mfs"


def test_fringes_are_given_as_periods_or_frequencies_by_list_or_by_axis(write: Any) -> None:
    mfs = tuple((80 + t) / 1280 for t in range(9))
    fractions = ", ".join(f"{80 + t}/1280" for t in range(9))
    for text in (f"frequencies_per_px: [{fractions}]", f"frequencies_per_px: {{x: [{fractions}], y: [{fractions}]}}"):
        scan = load_config(write(BENCH + f"scan:\n  {text}\n")).config.scan
        assert scan.frequencies("x") == scan.frequencies("y") == mfs
    # TPS as the paper ran it.
    scan = load_config(write(BENCH + "scan: {periods_px: {x: [16, 128, 1280], y: [16, 80, 800]}}\n")).config.scan
    assert scan.frequencies("x") == pytest.approx((1 / 16, 1 / 128, 1 / 1280), rel=1e-15)
    assert scan.frequencies("y") == pytest.approx((1 / 16, 1 / 80, 1 / 800), rel=1e-15)
    # On one axis of 1280 px, 1280/80 … 1280/88 px are the same plan.
    inverse = ", ".join(f"1280/{80 + t}" for t in range(9))
    scan = load_config(write(BENCH + f"scan: {{axes: [x], periods_px: [{inverse}]}}\n")).config.scan
    assert scan.frequencies("x") == pytest.approx(mfs, rel=1e-15)


@pytest.mark.parametrize(
    ("frequencies", "extent", "covers"),
    [
        ([(80 + t) / 1280 for t in range(9)], 1280, True),
        ([(80 + t) / 1280 for t in range(9)], 1281, False),
        ([80 / 1280, 82 / 1280], 640, True),
        ([1 / 16, 1 / 80, 1 / 800], 800, True),
        ([1 / 16, 1 / 80, 1 / 800], 1280, False),
        (
            [1 / 14.57, 1 / 16.09, 1 / 16.24, 1 / 16.47, 1 / 16.60],
            1280,
            True,
        ),  # hundredths of a px share no small period
        ([1 / 912], 912, True),
    ],
)
def test_a_plan_must_cover_the_projector(frequencies: list[float], extent: int, covers: bool) -> None:
    if covers:
        cfg.check_plan_covers(frequencies, extent, "along x")
    else:
        with pytest.raises(ConfigError, match=rf"along x: .* expected the projector's {extent} px"):
            cfg.check_plan_covers(frequencies, extent, "along x")


def test_a_bench_that_does_not_tell_its_projector_is_not_judged_by_it(
    write: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Bare(BaseModel):
        pass

    monkeypatch.setattr(Kind, "settings", Bare)
    assert load_config(write(BENCH + "scan: {periods_px: [16]}\n")).config.scan.frequencies("x") == (1 / 16,)


def test_fine_fringes_are_warned_of(write: Any) -> None:
    path = write(BENCH + "scan:\n  periods_px:\n  - 3.2\n  - 4\n  - 1280\n")
    (warning,) = load_config(path).warnings  # said once, though both axes use the list
    assert warning.startswith(f"{path}, line 5, column 5: scan.periods_px[0]: a period of 3.2 px")


def test_overrides_replace_values_and_are_named_in_errors(write: Any) -> None:
    path = write(BENCH + "scan:\n  method: mfs\n  steps: 7\n")
    loaded = load_config(path, {"scan.method": "tps", "gates.min_valid_share": 0.5, "bench.camera.bits": 12})
    assert (loaded.config.scan.method, loaded.config.scan.steps, loaded.config.gates.min_valid_share) == ("tps", 7, 0.5)
    assert loaded.bench_settings.camera.bits == 12  # type: ignore[attr-defined]
    for overrides in ({"scan.method": "tsp"}, {"scan.method.x": 3}, {"gates.min_valid_share": 2}, {"nothing": 1}):
        (problem,) = refusal(path, overrides).problems
        assert (problem.line, problem.file) in ((None, f"{path} with an override"), (4, str(path)))
        assert problem.field == next(iter(overrides)).removesuffix(".x")
        assert problem.remedy


def test_a_byte_order_mark_and_dates_are_no_stumbling_blocks(write: Any) -> None:
    loaded = load_config(write(b"\xef\xbb\xbf" + BENCH.encode() + b"  camera: {serial: 2026-02-31}\n"))
    assert loaded.bench_settings.camera.serial == "2026-02-31"  # type: ignore[attr-defined]


def test_rig_is_relative_to_the_file(write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rigs").mkdir()
    (tmp_path / "rigs" / "a.json").write_text("{}")
    path = write(BENCH + "rig: rigs/a.json\n")
    monkeypatch.chdir("/")
    assert load_config(path).rig_path == tmp_path / "rigs" / "a.json"


def test_bench_settings_can_resolve_paths_by_the_folder_of_the_file(
    write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class WithFile(BaseModel):
        file: Path

        @model_validator(mode="before")
        @classmethod
        def _from_the_folder(cls, values: Any, info: Any) -> Any:
            return {"file": info.context["folder"] / values["file"]}

    monkeypatch.setattr(Kind, "settings", WithFile)
    assert load_config(write(BENCH + "  file: a.bin\n")).bench_settings.file == tmp_path / "a.bin"  # type: ignore[attr-defined]


def test_open_bench_gives_the_kind_its_settings(write: Any, kind: Kind) -> None:
    loaded = load_config(write(BENCH + "  camera: {bits: 12}\n"))
    with cfg.open_bench(loaded) as bench:
        assert bench == "an open bench"
        assert kind.events == [loaded.bench_settings]
    assert kind.events[-1] == "closed"


def test_models_are_checked_without_a_file_too() -> None:
    with pytest.raises(ValidationError, match="mean ± amplitude"):
        cfg.ScanSection(mean=0.9)
    with pytest.raises(ValidationError, match="unambiguous over 16 px"):
        cfg.Config.model_validate({"bench": {"kind": "own"}, "scan": {"periods_px": [16]}})


# --- the file that a result keeps


def test_effective_yaml_reads_to_the_same_configuration(write: Any, tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_text("{}")
    path = write(
        BENCH
        + "  camera: {exposure_us: 1e4, serial: '0012'}\n  scene: {name: ball, radius_mm: 1e-7}\n"
        + "  stops: [{name: board, corner: [1, 2]}]\n  gain: 'null'\n  file: 'ä: # \"b\".bin'\n  options: {k: 3}\n"
        + "rig: rig.json\n"
        + "scan:\n  axes: [y]\n  frequencies_per_px: {y: [80/1280, 81/1280]}\n  minimum_modulation_dn: 3.5\n"
    )
    loaded = load_config(path, {"scan.attempts": 5})
    folder = tmp_path / "result"
    folder.mkdir()
    again = folder / "config.yaml"
    again.write_text(loaded.effective_yaml(), encoding="utf-8")
    reloaded = load_config(again)
    assert reloaded.rig_path == tmp_path / "rig.json"
    assert reloaded.config.model_copy(update={"rig": "rig.json"}) == loaded.config
    assert reloaded.bench_settings == loaded.bench_settings
    # Beside a copy of the rig, as in a result folder.
    (folder / "rig.json").write_text("{}")
    again.write_text(loaded.effective_yaml(rig="rig.json"), encoding="utf-8")
    assert load_config(again).rig_path == folder / "rig.json"
    assert load_config(again).config == loaded.config


@settings(database=None, deadline=None, derandomize=True, max_examples=40)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "method": st.sampled_from(cfg.METHOD_NAMES),
            "steps": st.integers(3, 10**6),
            "false_alarm_rate": st.floats(1e-300, 0.49),
            "lit_margin_px": st.floats(0, 200),
            "minimum_modulation_dn": st.none() | st.floats(1e-9, 1e22),
            "frequencies_per_px": st.lists(st.floats(1e-9, 1 / 1280), min_size=1, max_size=3),
        },
    ),
    st.text(max_size=8),
)
@example({}, "\x85")  # a line break that YAML folds
def test_effective_yaml_keeps_every_number_and_text(scan: dict[str, Any], serial: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.yaml"
        path.write_text(json.dumps({"bench": {"kind": "own"}}))  # JSON is YAML
        loaded = load_config(path, {"bench.camera.serial": serial, **{f"scan.{k}": v for k, v in scan.items()}})
        path.write_text(loaded.effective_yaml(), encoding="utf-8")
        assert load_config(path).config == loaded.config


def test_effective_yaml_says_where_each_value_is_from(write: Any) -> None:
    path = write(BENCH + "scan:\n  steps: 7\n  axes: [x]\n")
    text = load_config(path, {"scan.method": "tps"}).effective_yaml()
    assert str(path) in text.splitlines()[0]
    for line in ("kind: own # line 2", "steps: 7 # line 4", "axes: [x] # line 5", "method: tps # override",
                 "mean: 0.5 # default", "rig: null # default", "exposure_us: 16667.0 # default"):  # fmt: skip
        assert line in re.sub(r" +#", " #", text)
    assert "aspect" not in text  # computed, not a setting


def test_a_file_name_cannot_smuggle_a_setting_into_the_effective_yaml(tmp_path: Path) -> None:
    path = tmp_path / "a\nrig: evil.json\n#.yaml"
    path.write_text(BENCH)
    again = tmp_path / "again.yaml"
    again.write_text(load_config(path).effective_yaml(), encoding="utf-8")
    assert load_config(again).config.rig is None


# --- bench kinds


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Install packages that nobody here has heard of: a module and its metadata on the path."""
    from importlib.metadata import entry_points

    monkeypatch.setattr("scanner.config.benches.entry_points", entry_points)
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))

    def add(package: str, code: str, entry: str) -> None:
        module = package.replace("-", "_")
        (site / f"{module}.py").write_text(code)
        info = site / f"{module}-2.5.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 2.5\n")
        (info / "entry_points.txt").write_text(f"[scanner.benches]\n{entry}\n")
        monkeypatch.delitem(sys.modules, module, raising=False)

    return add


TURNTABLE = """
from contextlib import contextmanager
from pydantic import BaseModel, ConfigDict, Field

class Camera(BaseModel):
    model_config = ConfigDict(extra="forbid")
    shutter_ms: float = Field(gt=0, description="Exposure, ms.")

class Settings(BaseModel):
    model_config = ConfigDict(extra="forbid")
    camera: Camera

class Kind:
    settings = Settings

    @contextmanager
    def open(self, settings):
        yield f"open with {settings.camera.shutter_ms:g} ms"

kind = Kind()
"""


def test_a_strangers_package_adds_a_bench(stranger: Any, write: Any) -> None:
    stranger("acme-turntable", TURNTABLE, "turntable = acme_turntable:kind")
    loaded = load_config(write("bench:\n  kind: turntable\n  camera: {shutter_ms: 5}\n"))
    with cfg.open_bench(loaded) as bench:
        assert bench == "open with 5 ms"
    problem = refusal(write("bench:\n  kind: turntable\n  camera: {shutter_us: 5000}\n")).problems[0]
    assert "`shutter_ms: 5`" in problem.remedy
    assert "turntable" in cfg.json_schema()["$defs"]["BenchSection"]["discriminator"]["mapping"]


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import no_such_driver", "cannot be loaded: ModuleNotFoundError: No module named 'no_such_driver'"),
        ("raise RuntimeError('no licence')", "cannot be loaded: RuntimeError: no licence"),
        ("", "cannot be loaded: AttributeError"),
        ("kind = 3", "lacks `settings`, a pydantic model class and `open(settings)`"),
        (TURNTABLE + "\ndel Kind.open", "lacks `open(settings)`, a context manager"),
        (TURNTABLE + "\nKind.settings = dict", "lacks `settings`, a pydantic model class"),
    ],
)
def test_a_broken_package_is_named_and_spoils_nothing_else(
    stranger: Any, write: Any, monkeypatch: pytest.MonkeyPatch, code: str, found: str
) -> None:
    stranger("acme-broken", code, "broken = acme_broken:kind")
    (problem,) = refusal(write("bench:\n  kind: broken\n  anything: 3\n")).problems
    assert (problem.line, problem.column, problem.field) == (2, 9, "bench.kind")
    assert "acme-broken 2.5 (acme_broken:kind)" in problem.what
    assert found in problem.what
    assert "update" in problem.remedy
    assert "acme-broken" in problem.remedy
    # Other benches are as good as before.
    install(monkeypatch, own="own_bench:kind", broken="acme_broken:kind")
    assert load_config(write(BENCH)).bench_settings == BenchSettings()
    schema = cfg.json_schema()
    assert list(schema["$defs"]["BenchSection"]["discriminator"]["mapping"]) == ["own"]
    assert "acme_broken:kind" in schema["$comment"]


def test_two_packages_with_one_name_are_both_named(stranger: Any, write: Any) -> None:
    stranger("acme-one", TURNTABLE, "turntable = acme_one:kind")
    stranger("acme-two", TURNTABLE, "turntable = acme_two:kind")
    (problem,) = refusal(write("bench:\n  kind: turntable\n  camera: {shutter_ms: 5}\n")).problems
    assert "acme-one 2.5" in problem.what
    assert "acme-two 2.5" in problem.what
    assert "uninstall one" in problem.remedy


def test_no_bench_installed_at_all(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    (problem,) = refusal(write(BENCH)).problems
    assert "none is installed" in problem.what
    assert "pip install" in problem.remedy


# --- the JSON schema


def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema", reason="the package jsonschema checks schemas; it is not installed")
    schema = cfg.json_schema()
    assert schema["$schema"] == jsonschema.Draft202012Validator.META_SCHEMA["$id"]
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def plain(path: Path) -> Any:
    from ruamel.yaml import YAML

    return YAML(typ="safe", pure=True).load(path)


NOT_FOR_A_SCHEMA = {
    # between fields, in files, in the numbers behind a fraction
    "missing rig", "over full scale", "below black", "periods and frequencies", "an axis without fringes",
    "fringes of an axis that is not measured", "range below the projector", "the other axis's triple",
    "the model's own check", "aliasing frequency",
    # of YAML, which a schema does not see
    "not a number at all", "key twice", "number as key", "list as key", "alias", "alias of itself", "tab", "merge key",
    "no blank after the colon", "bracket left open", "two documents", "tag", "undefined alias", "control character",
    "an endless number",
}  # fmt: skip


def test_the_schema_refuses_what_the_models_refuse(write: Any) -> None:
    check = validator()
    within = {case: text.replace("▸", "") for case, (text, *_) in MISTAKES.items() if case not in NOT_FOR_A_SCHEMA}
    assert [case for case, text in within.items() if check.is_valid(plain(write(text)))] == []
    assert len(within) > 40


def test_the_schema_accepts_what_the_models_accept(write: Any) -> None:
    path = write(
        BENCH + "  scene: {name: ball, radius_mm: 3}\nrig: null\n"
        "scan: {axes: [y], frequencies_per_px: {y: [80/1280, 0.001]}}\n"
    )
    load_config(path)
    validator().validate(plain(path))


def test_models_of_two_packages_that_share_a_name_keep_apart(
    stranger: Any, write: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    stranger("acme-turntable", TURNTABLE, "turntable = acme_turntable:kind")
    install(monkeypatch, own="own_bench:kind", turntable="acme_turntable:kind")
    check = validator()  # both have a model Camera
    assert check.is_valid({"bench": {"kind": "turntable", "camera": {"shutter_ms": 5}}})
    assert check.is_valid({"bench": {"kind": "own", "camera": {"exposure_us": 5}}})
    assert not check.is_valid({"bench": {"kind": "own", "camera": {"shutter_ms": 5}}})
    assert not check.is_valid({"bench": {"kind": "turntable"}})


def test_a_bench_without_a_schema_of_its_own_still_loads(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    class Opaque(BaseModel):
        model_config = ConfigDict(arbitrary_types_allowed=True)
        device: SimpleNamespace | None = None
        level: int = 0

    monkeypatch.setattr(Kind, "settings", Opaque)
    assert load_config(write(BENCH + "  level: 3\n")).bench_settings.level == 3  # type: ignore[attr-defined]
    assert validator().is_valid({"bench": {"kind": "own", "level": 3}})
    (problem,) = refusal(write(BENCH + "  level: high\n")).problems
    assert (problem.line, problem.field) == (3, "bench.level")
    assert "integer" in problem.what


def test_a_setting_that_holds_lists_of_itself(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    type_alias = TypeAliasType("type_alias", list["type_alias"] | int)  # type: ignore[misc]

    class Nested(BaseModel):
        tree: type_alias  # type: ignore[valid-type]

    monkeypatch.setattr(Kind, "settings", Nested)
    assert load_config(write(BENCH + "  tree: [1, [2, [3]]]\n")).bench_settings.tree == [1, [2, [3]]]  # type: ignore[attr-defined]
    (problem,) = refusal(write(BENCH + "  tree: oak\n")).problems
    assert (problem.field, problem.what) == (
        "bench.tree",
        "found oak, expected a list (each a list or an integer) or an integer",
    )


def test_every_field_is_described() -> None:
    definitions = cfg.json_schema()["$defs"]
    for name in ("ScanSection", "GatesSection", "OutputSection", "PeriodsByAxis", "FrequenciesByAxis"):
        assert definitions[name]["description"]
        for field, node in definitions[name]["properties"].items():
            assert node.get("description"), f"{name}.{field}"


# --- the demo


def test_the_demo_is_valid_and_documented_line_by_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from importlib.metadata import entry_points

    monkeypatch.setattr("scanner.config.benches.entry_points", entry_points)
    path = REPOSITORY / "configs" / "demo.yaml"
    loaded = load_config(path)
    bench: Any = loaded.bench_settings
    assert (bench.scene.name, bench.seed, bench.camera.read_noise_dn) == ("mirror", 1, 1.5)
    assert (bench.camera.width_px, bench.camera.height_px) == (1024, 768)
    assert (bench.projector.width_px, bench.projector.height_px) == (1280, 800)
    assert loaded.config.scan.method == "mfs"
    assert loaded.warnings == ()
    validator().validate(plain(path))
    (tmp_path / "config.yaml").write_text(loaded.effective_yaml(), encoding="utf-8")
    assert load_config(tmp_path / "config.yaml").config == loaded.config
    # It shows every field of the scanner's own sections.
    document = plain(path)
    for section, model in (
        ("scan", cfg.ScanSection),
        ("gates", cfg.GatesSection),
        ("output", cfg.OutputSection),
        ("compare", cfg.CompareSection),
    ):
        assert list(document[section]) == list(model.model_fields)
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.lstrip().startswith("#")]
    bare = [line.strip() for line in lines if "#" not in line]
    assert all(
        re.match(r"(\w+_)?height|camera:|projector:|mirror_height|farthest|pitch|yaw|offset", line) for line in bare
    ), bare


# --- being light


def test_importing_the_configuration_imports_nothing_heavy() -> None:
    heavy = ["scipy", "cv2", "open3d", "numba", "matplotlib", "ruamel.yaml", "typer", "sim_backend"]
    code = f"import sys, scanner.config; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert done.stdout.strip() == "[]"


def test_every_regional_sequence_needs_room_on_the_disk():
    assert cfg.ScanSection().rounds_to_record(2) == 2
    assert cfg.ScanSection(max_regional_sequences=4).rounds_to_record(2) == 5
    assert cfg.ScanSection(max_regional_sequences=4, rounds=1).rounds_to_record(2) == 1
    assert cfg.ScanSection(max_regional_sequences=4, regional_rule="literal").rounds_to_record(2) == 2
    assert cfg.ScanSection(max_regional_sequences=4, method="tps").rounds_to_record(1) == 1
