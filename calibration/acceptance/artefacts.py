"""The artefacts of acceptance, as an operator describes them, and the same as scenes of a simulated bench."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from calibration.observations import BoardPose

_Length = Annotated[float, Field(gt=0, le=10_000)]
_Uncertainty = Annotated[float, Field(ge=0, le=100)]
_U_TEMPERATURE_K = 0.5
REFERENCE_TEMPERATURE_C = 20.0
"""At which calibrated lengths hold (ISO 1)."""


class _Artefact(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: str = Field("", max_length=80, description="Name or serial number for the certificate.")
    expansion_per_kelvin: float | None = Field(
        None,
        ge=0,
        le=1e-4,
        description="Thermal expansion of the artefact, 1/K (steel 11.5e-6, alumina 7e-6, carbon fibre about 0);"
        " left out, lengths are not corrected to 20 °C.",
    )
    expansion_u_per_kelvin: float = Field(1e-6, ge=0, le=1e-4, description="Its standard uncertainty, 1/K.")

    kind: str

    @property
    def title(self) -> str:
        """How the certificate calls it."""
        return f"{_TITLES[self.kind]} {self.name}".strip()

    def length_at(self, calibrated_mm: float, temperature_C: float | None) -> tuple[float, float, str]:
        """Calibrated length as it is at the artefact's temperature.

        Parameters
        ----------
        calibrated_mm
            At 20 °C.
        temperature_C
            Of the artefact while it was scanned; None where nobody measured it.

        Returns
        -------
        length_mm, u_mm, note
            The length, the standard uncertainty of the correction (a thermometer's 0.5 K and the expansion's own), and
            what was done.
        """
        if temperature_C is None:
            return calibrated_mm, 0.0, "temperature not noted: length as calibrated at 20 °C"
        if self.expansion_per_kelvin is None:
            return calibrated_mm, 0.0, f"{temperature_C:g} °C; expansion unknown: length as calibrated at 20 °C"
        off = temperature_C - REFERENCE_TEMPERATURE_C
        u = calibrated_mm * math.hypot(_U_TEMPERATURE_K * self.expansion_per_kelvin, off * self.expansion_u_per_kelvin)
        return calibrated_mm * (1 + self.expansion_per_kelvin * off), u, f"{temperature_C:g} °C, length corrected"


class _Balls(_Artefact):
    diameter_mm: _Length = Field(50.0, description="Calibrated diameter of the ball, or of each, at 20 °C, mm.")
    diameter_uncertainty_mm: _Uncertainty = Field(0.0, description="Its expanded uncertainty (k = 2), mm.")
    form_mm: _Uncertainty = Field(0.0, description="Calibrated form error of the ball, mm.")
    incidence_limit_deg: float = Field(
        60.0,
        gt=10,
        le=85,
        description="Points whose surface is turned further from camera or projector are not used, °.",
    )


class SphereArtefact(_Balls):
    """One calibrated matt ball."""

    kind: Literal["sphere"] = "sphere"

    def scene(self, pose: BoardPose) -> dict[str, Any]:
        """Document of the scene for a simulated bench; the pose's origin is the centre."""
        return {"name": "sphere", "radius_mm": self.diameter_mm / 2, **placed(pose)}


class BallBarArtefact(_Balls):
    """Two equal balls at a calibrated distance."""

    kind: Literal["ball_bar"] = "ball_bar"
    spacing_mm: _Length = Field(100.0, description="Calibrated distance of the centres at 20 °C, mm.")
    spacing_uncertainty_mm: _Uncertainty = Field(0.0, description="Its expanded uncertainty (k = 2), mm.")

    def scene(self, pose: BoardPose) -> dict[str, Any]:
        """Document of the scene for a simulated bench; the pose's origin is midway between the centres."""
        return {
            "name": "ball_bar",
            "radius_mm": self.diameter_mm / 2,
            "spacing_mm": self.spacing_mm,
            **placed(pose),
        }


class PlaneArtefact(_Artefact):
    """A flat matt board that is larger than anything else flat in the picture."""

    kind: Literal["plane"] = "plane"
    width_mm: _Length = Field(260.0, description="Width, mm.")
    height_mm: _Length = Field(200.0, description="Height, mm.")
    form_mm: _Uncertainty = Field(0.0, description="Calibrated flatness, mm.")

    def scene(self, pose: BoardPose) -> dict[str, Any]:
        """Document of the scene for a simulated bench; the pose's origin is the middle."""
        return {"name": "plane", "width_mm": self.width_mm, "height_mm": self.height_mm, **placed(pose)}


class PlaneBesideMirror(_Artefact):
    """A flat matt board beside a plane mirror that throws light on it, and the same without the mirror."""

    kind: Literal["plane_beside_mirror"] = "plane_beside_mirror"
    width_mm: _Length = Field(260.0, description="Width of the board, mm.")
    height_mm: _Length = Field(230.0, description="Height of the board, mm.")

    def scene(self, pose: BoardPose, *, with_mirror: bool = True) -> dict[str, Any]:
        """Document of the scene for a simulated bench; the pose's origin is the middle of the board."""
        return {
            "name": "mirror" if with_mirror else "mirror_removed",
            "board_width_mm": self.width_mm,
            "board_height_mm": self.height_mm,
            **placed(pose),
        }


class SphereBesideMirror(_Balls):
    """A matt ball beside a plane mirror, and the same without the mirror."""

    kind: Literal["sphere_beside_mirror"] = "sphere_beside_mirror"

    def scene(self, pose: BoardPose, *, with_mirror: bool = True) -> dict[str, Any]:
        """Document of the scene for a simulated bench; the pose's origin is the centre of the ball."""
        return {
            "name": "sphere_mirror",
            "radius_mm": self.diameter_mm / 2,
            "with_mirror": with_mirror,
            **placed(pose),
        }


Artefact = Annotated[
    SphereArtefact | BallBarArtefact | PlaneArtefact | PlaneBesideMirror | SphereBesideMirror,
    Field(discriminator="kind"),
]
"""Any of the artefacts, told apart by ``kind``."""

_TITLES = {
    "sphere": "Sphere",
    "ball_bar": "Ball bar",
    "plane": "Plane",
    "plane_beside_mirror": "Plane beside a mirror",
    "sphere_beside_mirror": "Sphere beside a mirror",
}


def placed(pose: BoardPose) -> dict[str, float]:
    """Pose as the scenes of a simulated bench take it; the turn in the picture's plane only where there is one."""
    fields = {
        "distance_mm": pose.distance_mm,
        "offset_x_mm": pose.offset_x_mm,
        "offset_y_mm": pose.offset_y_mm,
        "yaw_deg": pose.yaw_deg,
        "pitch_deg": pose.pitch_deg,
    }
    return {**fields, "roll_deg": pose.roll_deg} if pose.roll_deg else fields
