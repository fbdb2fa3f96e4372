"""The sections of a configuration, every field with its unit, its limits and what it means."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    PrivateAttr,
    SerializeAsAny,
    Tag,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from scanner.config.benches import BENCH_GROUP, load_bench_kind
from scanner.config.methods import METHOD_GROUP, check_method_name, method_names
from scanner.config.problems import ConfigError, FieldPath, show
from scanner.config.sections import load_section
from scanner.patterns import Axis, unambiguous_range

if TYPE_CHECKING:
    from drivers.bench import BenchKind


class _Section(BaseModel):
    # Strict: `steps: "12"` or `attempts: true` is a slip. Deferred: --help does not pay for validators.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)


def _refusal(path: FieldPath, what: str, remedy: str) -> InitErrorDetails:
    """Make a mistake at ``path`` below the validated value; message and remedy travel apart, as context."""
    kind = PydanticCustomError("refused", "{what}: {remedy}", {"what": what, "remedy": remedy})
    return InitErrorDetails(type=kind, loc=path, input=None)


def _refuse(refusals: Sequence[InitErrorDetails]) -> None:
    if refusals:
        raise ValidationError.from_exception_data("configuration", list(refusals))


FRACTION = r"^\s*(\d+(?:\.\d*)?)\s*/\s*(\d*[1-9]\d*(?:\.\d*)?)\s*$"
"""Pattern of a fraction such as ``81/1280``."""


def _fraction(value: Any) -> Any:
    match = re.match(FRACTION, value) if isinstance(value, str) else None
    return float(match[1]) / float(match[2]) if match else value


_LIMITS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "periods_px": ("periods above 2 px", lambda value: value > 2),
    "frequencies_per_px": ("frequencies between 0 and 0.5 1/px", lambda value: 0 < value < 0.5),
}


def _check_fringes(values: tuple[float, ...], name: str, other: str) -> tuple[float, ...]:
    """Refuse fringes that the projector's pixels alias, and periods given as frequencies or the reverse."""
    expected, fits = _LIMITS[name]
    wrong = [i for i, value in enumerate(values) if not fits(value)]
    other_kind, fits_other = _LIMITS[other]
    if len(wrong) == len(values) and all(fits_other(value) for value in values):
        inverse = [float(f"{1 / value:.6g}") for value in values]
        what = f"found {show(values)}, expected {expected}; these look like {other_kind}"
        _refuse([_refusal((), what, f"write `{other}: {show(values)}` or `{name}: {show(inverse)}`")])
    remedy = (
        "write a period of 4 px or more, that is a frequency above 0 and up to 0.25 1/px: at 2 px the projector's "
        "pixels alias a fringe, and near it there is little contrast"
    )
    _refuse([_refusal((i,), f"found {show(values[i])}, expected {expected}", remedy) for i in wrong])
    return values


def _check_periods(values: tuple[float, ...]) -> tuple[float, ...]:
    return _check_fringes(values, "periods_px", "frequencies_per_px")


def _check_frequencies(values: tuple[float, ...]) -> tuple[float, ...]:
    return _check_fringes(values, "frequencies_per_px", "periods_px")


def _number_schema(**limits: float) -> WithJsonSchema:
    return WithJsonSchema({"anyOf": [{"type": "number", **limits}, {"type": "string", "pattern": FRACTION}]})


_Period = Annotated[float, BeforeValidator(_fraction), _number_schema(exclusiveMinimum=2)]
_Periods = Annotated[tuple[_Period, ...], Field(strict=False, min_length=1), AfterValidator(_check_periods)]
_Frequency = Annotated[float, BeforeValidator(_fraction), _number_schema(exclusiveMinimum=0, exclusiveMaximum=0.5)]
_Frequencies = Annotated[tuple[_Frequency, ...], Field(strict=False, min_length=1), AfterValidator(_check_frequencies)]


MOST_EXPOSURES = 8
"""Exposures of one scan."""


def _check_exposures(values: tuple[float, ...]) -> tuple[float, ...]:
    refusals = [
        _refusal((i,), f"found {show(value)}, expected a factor above 0", "write how many times the bench's exposure")
        for i, value in enumerate(values)
        if value <= 0
    ]
    if len(set(values)) < len(values):
        refusals.append(_refusal((), f"found {show(values)}, expected each exposure once", "remove the repeated ones"))
    if len(values) == 1 and values[0] > 0 and values[0] != 1:
        what = f"found {show(values)}, expected 1 where there is one exposure only"
        refusals.append(_refusal((), what, "change the camera's exposure_us in the section bench, or add an exposure"))
    _refuse(refusals)
    return values


_Factor = Annotated[float, BeforeValidator(_fraction), _number_schema(exclusiveMinimum=0)]
_Exposures = Annotated[
    tuple[_Factor, ...],
    Field(strict=False, min_length=1, max_length=MOST_EXPOSURES),
    AfterValidator(_check_exposures),
]


class PeriodsByAxis(_Section):
    """Fringe periods of each axis, px."""

    x: _Periods | None = Field(None, description="Periods of the fringes along the projector's columns, px.")
    y: _Periods | None = Field(None, description="Periods of the fringes along the projector's rows, px.")


class FrequenciesByAxis(_Section):
    """Fringe frequencies of each axis, 1/px."""

    x: _Frequencies | None = Field(None, description="Frequencies along the projector's columns, 1/px.")
    y: _Frequencies | None = Field(None, description="Frequencies along the projector's rows, 1/px.")


def _list_or_by_axis(value: Any) -> str:
    return "by_axis" if isinstance(value, Mapping | BaseModel) else "list"


class ScanSection(_Section):
    """What is projected, and how the frames are judged."""

    method: str = Field(
        "mfs",
        description="tps: temporal phase shifting; mps: micro phase shifting with all steps of every period; "
        "mps_gn: micro phase shifting in Gupta and Nayar's F + 2 patterns; modulated: phase shifting under a carrier; "
        "embedded: embedded phase shifting; xor: XOR code and phase; epipolar: TPS with Qi's check; mfs: "
        "micro-frequency shifting in two rounds; mfs1: in one; mfs_paper: as its paper has it. Installed packages add "
        f"more (entry points of the group {METHOD_GROUP}).",
        # Called when the schema is made, so that it names the methods that are installed then.
        json_schema_extra=lambda schema: schema.update(enum=list(method_names())),
    )
    axes: tuple[Axis, ...] = Field(
        ("x", "y"),
        strict=False,
        min_length=1,
        max_length=2,
        json_schema_extra={"uniqueItems": True},
        description="Projector axes to measure: x, the columns, and y, the rows. One axis takes half the frames; "
        "with both, bounces are told from direct light more surely.",
    )
    steps: int = Field(
        12,
        ge=3,
        description="Phase steps N of every fringe; from 4 on, a stale or saturated frame shows in the residuals. "
        "mps_gn has its own steps and does not use these.",
    )
    periods_px: (
        Annotated[
            Annotated[_Periods, Tag("list")] | Annotated[PeriodsByAxis, Tag("by_axis")],
            Discriminator(_list_or_by_axis),
        ]
        | None
    ) = Field(
        None,
        description="Fringe periods, px: a list, or a list per axis {x: […], y: […]}; fractions such as 1280/81 "
        "are exact. null: the method's own.",
    )
    frequencies_per_px: (
        Annotated[
            Annotated[_Frequencies, Tag("list")] | Annotated[FrequenciesByAxis, Tag("by_axis")],
            Discriminator(_list_or_by_axis),
        ]
        | None
    ) = Field(
        None,
        description="Fringe frequencies, 1/px, in place of periods_px: a list, or a list per axis; fractions such "
        "as 81/1280 are exact. null: the method's own.",
    )
    mean: float = Field(0.5, ge=0, le=1, description="Mean A of a pattern as a fraction of the projector's full scale.")
    amplitude: float = Field(
        0.5, gt=0, le=0.5, description="Amplitude B of a pattern as a fraction of full scale; A ± B within 0..1."
    )
    correct_response: bool = Field(
        True,
        description="Correct the patterns for the projector's response where the rig holds a measured one, so that its "
        "light follows the fringes; false: send the fringes' own grey levels.",
    )
    minimum_modulation_dn: float | None = Field(
        None,
        gt=0,
        description="Pixels with less fringe modulation, in grey values (DN), are invalid. null: from the "
        "camera's noise.",
    )
    false_alarm_rate: float = Field(
        0.001, gt=0, lt=0.5, description="Share of clean pixels that may be taken for a bounce (0..0.5)."
    )
    detector: Literal["misfit", "variation", "pooled"] = Field(
        "misfit",
        description="How bounces are detected. misfit: χ² of the one-path fit; pooled: the same, pooled over "
        "neighbours, which sees bounces below the noise of a pixel; variation: the paper's standard deviation of the "
        "modulation over the frequencies, which sees less.",
    )
    remove_ripples: bool = Field(
        True,
        description="Take bounces that are too weak for a pixel off the coordinates of mfs and mfs1, where they draw "
        "ripples on a smooth surface; what the surface itself does stays. false: leave them in.",
    )
    regional_rule: Literal["sound", "literal"] = Field(
        "sound",
        description="What round two lights. sound: only where direct light of the detected pixels can come from; "
        "literal: the paper's Eq. 21, which leaves unseen emitters lit.",
    )
    rounds: Literal["auto", 1, 2] = Field(
        2,
        description="Rounds of mfs. 2: a second round follows wherever a bounce was detected; auto: only where the "
        "separation of both light paths from round one alone does not suffice; 1: never. For mfs_paper auto is 2; "
        "the other methods have one.",
    )
    max_regional_sequences: int = Field(
        1,
        ge=1,
        le=8,
        description="How many regional sequences mfs may take after round one. 1: one, for the largest part; more: "
        "faces that light each other take turns, and what still sees a bounce is lit once more by itself. A mirror "
        "in the picture counts as a face.",
    )
    lit_margin_px: float = Field(
        6, ge=0, le=200, description="By how much the region that round two lights is grown, projector px."
    )
    exposures: _Exposures = Field(
        (1.0,),
        description="Exposures of every round, each times that of the bench: [1, 1/4] for shiny parts, [4, 1, 1/4] "
        "with dark ones. Each takes all frames again; a pixel is measured by those in which it does not saturate.",
    )
    attempts: int = Field(
        3, ge=1, le=100, description="How often a sequence is captured, at most, until its frames pass the check."
    )
    max_saturated_share: float = Field(
        0.02,
        ge=0,
        le=1,
        description="Share of camera pixels (0..1) that may be saturated in the preview; with more the scan does "
        "not start and asks for a shorter exposure.",
    )

    @field_validator("method")
    @classmethod
    def _method_is_known(cls, method: str) -> str:
        try:
            return check_method_name(method)
        except ConfigError as error:
            _refuse([_refusal((), error.message, error.remedy)])
            raise

    @model_validator(mode="after")
    def _fields_agree(self) -> Self:
        refusals = []
        if len(set(self.axes)) < len(self.axes):
            what = f"found {show(self.axes)}, expected each axis once"
            refusals.append(_refusal(("axes",), what, "write [x, y], [x] or [y]"))
        low, high = self.mean - self.amplitude, self.mean + self.amplitude
        if low < -1e-9 or high > 1 + 1e-9:
            name = "amplitude" if "amplitude" in self.model_fields_set else "mean"
            what = f"found mean ± amplitude from {low:g} to {high:g}, expected within 0 and 1 of full scale"
            most = min(self.mean, 1 - self.mean)
            remedy = f"with `mean: {self.mean:g}` write an amplitude of {most:g} at most, or mean and amplitude 0.5"
            refusals.append(_refusal((name,), what, remedy))
        if self.periods_px is not None and self.frequencies_per_px is not None:
            what = "found both periods_px and frequencies_per_px, expected one of them"
            refusals.append(_refusal(("frequencies_per_px",), what, "remove one of the two, or set it to null"))
        for name, given in (("periods_px", self.periods_px), ("frequencies_per_px", self.frequencies_per_px)):
            for axis in get_args(Axis) if isinstance(given, BaseModel) else ():
                present, wanted = getattr(given, axis) is not None, axis in self.axes
                if present and not wanted:
                    what = f"found fringes along {axis}, expected none: axes is {show(self.axes)}"
                    refusals.append(_refusal((name, axis), what, f"remove them, or add {axis} to axes"))
                elif wanted and not present:
                    what = f"found no fringes along {axis}, expected some: axes is {show(self.axes)}"
                    refusals.append(_refusal((name,), what, f"add `{axis}: […]`, or remove {axis} from axes"))
        _refuse(refusals)
        return self

    def rounds_at_most(self, of_method: int) -> int:
        """Rounds that a scan can take by a method that has ``of_method``."""
        return 1 if self.rounds == 1 else of_method

    def rounds_to_record(self, of_method: int) -> int:
        """Rounds that the disk must have room for: every regional sequence is a round of its own."""
        regional = self.max_regional_sequences if self.method == "mfs" and self.regional_rule == "sound" else 1
        return self.rounds_at_most(of_method) - 1 + regional if self.rounds_at_most(of_method) > 1 else 1

    def fringe_field(self, axis: Axis) -> FieldPath | None:
        """Path, below this section, of the list of the fringes along ``axis``; None for the method's own."""
        for name, given in (("periods_px", self.periods_px), ("frequencies_per_px", self.frequencies_per_px)):
            if given is not None:
                return (name, axis) if isinstance(given, BaseModel) else (name,)
        return None

    def frequencies(self, axis: Axis) -> tuple[float, ...] | None:
        """Frequencies (1/px) that the operator asks for along ``axis``; None for the method's own."""
        given = self.frequencies_per_px if self.periods_px is None else self.periods_px
        values = getattr(given, axis) if isinstance(given, BaseModel) else given
        return tuple(1 / v for v in values) if values is not None and self.periods_px is not None else values


class WindowSection(_Section):
    """A part of the camera's picture with one surface in it: a rectangle, or a place that the bench knows by name."""

    name: str = Field(min_length=1, description="Name in tables and figures, such as W1.")
    x: int | None = Field(None, ge=0, description="Leftmost column, camera px.")
    y: int | None = Field(None, ge=0, description="Topmost row, camera px.")
    width: int | None = Field(None, ge=2, description="Columns.")
    height: int | None = Field(None, ge=2, description="Rows.")
    place: str | None = Field(
        None,
        description="In place of the rectangle, where the bench knows the truth: a part of the scene, or a window of "
        "its own, such as board or W1.",
    )
    bounced: bool = Field(
        False, description="Of the place, the pixels alone that see a bounce of least_alpha beside their direct light."
    )
    fit: Literal["plane", "sphere"] = Field("plane", description="What is fitted to the points in it.")

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        sides = {"x": self.x, "y": self.y, "width": self.width, "height": self.height}
        given = [name for name, side in sides.items() if side is not None]
        if self.place is not None and given:
            what = f"found place and {', '.join(given)}, expected a place or a rectangle"
            _refuse([_refusal((), what, "remove one of the two")])
        if self.place is None and (len(given) < len(sides) or self.bounced):
            missing = ", ".join(name for name in sides if name not in given) or "place"
            remedy = "write x, y, width and height of a rectangle, or a place, which may be bounced"
            _refuse([_refusal((), f"{missing} is missing", remedy)])
        return self


class CompareSection(_Section):
    """What `scan compare` compares, and where it judges."""

    methods: tuple[str, ...] = Field(
        ("mfs", "tps", "mps", "mps_gn"), strict=False, min_length=1, description="Names of the methods."
    )
    seeds: int = Field(
        1, ge=1, le=1000, description="How often each method scans; a simulated bench with another seed each time."
    )
    windows: tuple[WindowSection, ...] = Field(
        (),
        strict=False,
        description="Where the points are judged after a fit; none: the largest region that a method detected.",
    )
    fit: Literal["plane", "sphere"] = Field("plane", description="What is fitted where no window is given.")
    reference: dict[str, JsonValue] = Field(
        {},
        description="Values that take the bounces away, such as {bench.scene.blackened: [mirror]}: with them the first "
        "method scans once more, and the errors of all are compared with those of that row. {}: no such row.",
    )
    least_alpha: float = Field(
        0.02,
        gt=0,
        le=1,
        description="Where the bench knows the truth: a pixel sees a bounce when that has at least this share of the "
        "direct light's modulation.",
    )

    @field_validator("methods")
    @classmethod
    def _methods_are_known(cls, methods: tuple[str, ...]) -> tuple[str, ...]:
        refusals = []
        for place, method in enumerate(methods):
            try:
                check_method_name(method)
            except ConfigError as error:
                refusals.append(_refusal((place,), error.message, error.remedy))
        _refuse(refusals)
        return methods


class GatesSection(_Section):
    """What a result must reach; a scan that fails a gate keeps its result and ends with exit code 4."""

    min_valid_share: float = Field(
        0.05, ge=0, le=1, description="Share of all camera pixels (0..1) that must have a valid coordinate."
    )
    max_misfit_share: float = Field(
        0.2,
        ge=0,
        le=1,
        description="Share of the pixels with enough modulation (0..1) that may be refused because their fringes "
        "do not fit.",
    )
    max_excess_misfit: float = Field(
        4.0,
        gt=1,
        description="How many times worse than noise alone the better quarter of the pixels may fit their fringes. "
        "Frames in a wrong order fit nowhere.",
    )


class OutputSection(_Section):
    """What a result folder holds beside result.json, maps.npz, rig.json and config.yaml."""

    ply: bool = Field(True, description="Write the point cloud, cloud.ply.")
    report: bool = Field(True, description="Write the report, report.html.")
    keep_take: bool = Field(
        True, description="Keep the recorded frames, take/; without them nothing can be processed again."
    )


class BenchSection(BaseModel):
    """Which bench, and the settings of its kind."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)

    kind: str = Field(description=f"Name of an installed bench, an entry point of the group {BENCH_GROUP}.")
    _bench_kind: BenchKind = PrivateAttr()
    _settings: BaseModel = PrivateAttr()

    @model_validator(mode="after")
    def _load_kind_and_settings(self, info: ValidationInfo) -> Self:
        try:
            self._bench_kind = load_bench_kind(self.kind)
        except ConfigError as error:
            _refuse([_refusal(("kind",), error.message, error.remedy)])
        raw = self.model_extra or {}
        self._settings = self._bench_kind.settings.model_validate(dict(raw), context=info.context)
        raw.clear()  # the validated settings stand in their place
        return self

    @model_serializer(mode="plain")
    def _flat(self) -> dict[str, Any]:
        # round_trip leaves out computed fields, which the model would refuse when it is read again.
        return {"kind": self.kind, **self._settings.model_dump(mode="json", round_trip=True, by_alias=True)}

    @property
    def bench_kind(self) -> BenchKind:
        """What the entry point ``kind`` has loaded."""
        return self._bench_kind

    @property
    def settings(self) -> BaseModel:
        """The settings, an instance of ``bench_kind.settings``."""
        return self._settings

    def projector_extent(self, axis: Axis) -> int | None:
        """Projector pixels along ``axis`` where the settings have ``projector.width_px`` and ``height_px``."""
        projector = getattr(self._settings, "projector", None)
        extent = getattr(projector, "width_px" if axis == "x" else "height_px", None)
        return extent if isinstance(extent, int) else None


class Config(_Section):
    """Configuration of a structured-light scan: a bench, and what to do with it."""

    bench: BenchSection
    rig: str | None = Field(
        None,
        min_length=1,
        description="Calibrated rig, a path relative to this file: own JSON or an OpenCV FileStorage. null: the "
        "bench's own rig.",
    )
    scan: ScanSection = Field(default_factory=ScanSection)
    gates: GatesSection = Field(default_factory=GatesSection)
    output: OutputSection = Field(default_factory=OutputSection)
    compare: CompareSection = Field(default_factory=CompareSection)
    calibration: SerializeAsAny[BaseModel] | None = Field(
        None,
        description="How `calibrate` makes this bench measurable; null: it is not to be calibrated with this file.",
    )

    @field_validator("calibration", mode="before")
    @classmethod
    def _calibration_has_its_own_model(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None or isinstance(value, BaseModel):
            return value
        try:
            model = load_section("calibration")
        except ConfigError as error:
            _refuse([_refusal((), error.message, error.remedy)])
            raise
        return model.model_validate(value, context=info.context)

    @field_validator("scan", "gates", "output", "compare", mode="before")
    @classmethod
    def _empty_section_is_all_defaults(cls, value: Any) -> Any:
        # A section whose every line is commented out reads as null.
        return {} if value is None else value

    @field_validator("rig")
    @classmethod
    def _rig_is_there(cls, rig: str | None, info: ValidationInfo) -> str | None:
        folder = (info.context or {}).get("folder")
        if rig is not None and folder is not None and not (folder / rig).is_file():
            what = f"found {show(rig)}, expected a rig file; there is none at {folder / rig}"
            _refuse([_refusal((), what, "correct the path, or write `rig: null` for the bench's own rig")])
        return rig

    @field_validator("scan")
    @classmethod
    def _plan_covers_projector(cls, scan: ScanSection, info: ValidationInfo) -> ScanSection:
        bench: BenchSection | None = info.data.get("bench")
        refusals = []
        for axis in scan.axes:
            path, frequencies = scan.fringe_field(axis), scan.frequencies(axis)
            extent = None if bench is None else bench.projector_extent(axis)
            if path is not None and frequencies is not None and extent is not None:
                try:
                    check_plan_covers(frequencies, extent, f"along {axis}")
                except ConfigError as error:
                    remedy = f"{error.remedy}; null takes the method's own fringes"
                    refusals.append(_refusal(path, error.message, remedy))
        _refuse(refusals)
        return scan


def check_plan_covers(frequencies: Sequence[float], extent: int, field: str) -> None:
    """Refuse fringes that repeat within the projector's picture, where a position would have several answers.

    Parameters
    ----------
    frequencies
        All frequencies along one axis, 1/px.
    extent
        Projector pixels along that axis.
    field
        What the message begins with, such as ``along x``.

    Raises
    ------
    ConfigError
        The unambiguous range is shorter than ``extent``.
    """
    reach = unambiguous_range(frequencies)
    if reach < extent * (1 - 1e-6):
        raise ConfigError(
            f"{field}: these fringes are unambiguous over {reach:.5g} px only, expected the projector's {extent} px",
            f"add a fringe with a period of {extent} px or more, or one that does not come round with the others",
        )
