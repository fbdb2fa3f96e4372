"""What an operator can set of a calibration: the section ``calibration:`` of a bench file.

Importing this file is cheap; `scan` does it for every configuration that has the section.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from calibration.acceptance.artefacts import Artefact
from calibration.acceptance.figures import Limits
from calibration.observations import BoardPose

_Length = Annotated[float, Field(gt=0, le=10_000)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _refused(what: str, remedy: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{what}: {remedy}", {"what": what, "remedy": remedy})


class ExposureSettings(_Section):
    """How the exposure is searched."""

    shortest_us: float = Field(500.0, gt=0, description="Shortest exposure that may be taken, µs.")
    longest_us: float = Field(200_000.0, gt=0, description="Longest exposure that may be taken, µs.")
    whole_refreshes: bool = Field(
        True,
        description="Take whole numbers of projector refreshes only; false for projectors whose light is steady "
        "within a refresh.",
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.shortest_us > self.longest_us:
            raise _refused(
                f"shortest_us {self.shortest_us:g} exceeds longest_us {self.longest_us:g}", "exchange the two"
            )
        return self


class ResponseSettings(_Section):
    """How the projector's response is measured."""

    levels: int = Field(26, ge=9, le=256, description="Grey levels of the ramp, evenly from black to white.")
    correct: bool = Field(True, description="Let the patterns of the geometry step be corrected by it at once.")


class GeometrySettings(_Section):
    """How the board is held and photographed."""

    poses: int = Field(10, ge=3, le=60, description="Poses of the board to take.")
    nearest_mm: _Length = Field(500.0, description="Nearest distance of the board from the camera, mm.")
    farthest_mm: _Length = Field(700.0, description="Farthest distance of the board from the camera, mm.")
    tilt_deg: float = Field(30.0, ge=10, le=50, description="How far the board may be tilted, °.")
    steps: int = Field(12, ge=5, le=64, description="Phase steps of each fringe; 5 or more show harmonics.")
    board_sigma_mm: float | None = Field(
        None,
        gt=0,
        le=1,
        description="How far the print's points lie from where they should, mm (standard deviation); they are then "
        "estimated with the rig. null: the board is exact.",
    )
    bend: bool = Field(False, description="Estimate a bending of the board as well; needs twelve poses or more.")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.nearest_mm >= self.farthest_mm:
            raise _refused(
                f"nearest_mm {self.nearest_mm:g} is not below farthest_mm {self.farthest_mm:g}",
                "give the range of distances in which the scanner is to measure",
            )
        return self


class ExpectationSettings(_Section):
    """What a tape measure says, so that a wrong scale is noticed; a single board cannot show it."""

    baseline_mm: float | None = Field(None, gt=0, description="Distance from the camera's to the projector's lens, mm.")
    tolerance: float = Field(0.1, gt=0, le=0.5, description="How far it may be off, as a share.")


class HandSettings(_Section):
    """The scripted operator of ``--headless``: nobody holds a board exactly where it is asked for."""

    error_mm: float = Field(8.0, ge=0, le=100, description="Standard deviation of the place along each axis, mm.")
    error_deg: float = Field(2.0, ge=0, le=20, description="Standard deviation of each turn, °.")
    seed: int = Field(0, ge=0, description="Seed of these errors.")


class PlacedArtefact(_Section):
    """An artefact of the acceptance and where it stands."""

    artefact: Artefact = Field(description="What it is, with its calibrated figures.")
    distance_mm: _Length = Field(600.0, description="Of its origin along the camera's axis, mm.")
    offset_x_mm: float = Field(0.0, description="To the right of the camera's axis, mm.")
    offset_y_mm: float = Field(0.0, description="Below the camera's axis, mm.")
    yaw_deg: float = Field(0.0, ge=-80, le=80, description="Turn about the vertical, °.")
    pitch_deg: float = Field(0.0, ge=-80, le=80, description="Turn about the horizontal, °.")
    repeats: int = Field(1, ge=1, le=50, description="How often it is scanned without being moved.")
    temperature_celsius: float | None = Field(None, ge=-50, le=100, description="Its temperature, °C; null: not noted.")

    @property
    def pose(self) -> BoardPose:
        """Where it stands."""
        return BoardPose(self.distance_mm, self.offset_x_mm, self.offset_y_mm, self.yaw_deg, self.pitch_deg)


class AcceptanceSettings(_Section):
    """What the acceptance measures, and what it must reach."""

    artefacts: tuple[PlacedArtefact, ...] = Field((), description="Artefacts in the order in which they are scanned.")
    limits: Limits = Field(default_factory=Limits, description="Limits of the figures; null reports without a verdict.")


class CalibrationSettings(_Section):
    """How `calibrate` makes this bench measurable."""

    board: str = Field(min_length=1, description="Definition of the board, a path relative to this file.")
    exposure: ExposureSettings = Field(default_factory=ExposureSettings, description="The exposure step.")
    response: ResponseSettings = Field(default_factory=ResponseSettings, description="The response step.")
    geometry: GeometrySettings = Field(default_factory=GeometrySettings, description="The geometry step.")
    expected: ExpectationSettings = Field(default_factory=ExpectationSettings, description="What a tape measure says.")
    acceptance: AcceptanceSettings = Field(default_factory=AcceptanceSettings, description="The acceptance step.")
    hand: HandSettings = Field(default_factory=HandSettings, description="The scripted operator of --headless.")
    temperature_celsius: float | None = Field(
        None, ge=-50, le=100, description="Temperature of the bench, °C, kept with the rig; null: not noted."
    )
    notes: str = Field("", max_length=2000, description="Aperture, focus, who and why: kept with the rig.")
