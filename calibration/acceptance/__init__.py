"""Acceptance in the manner of VDI/VDE 2634 part 2: artefacts, quality figures, limits and decisions.

What computes is imported from its own file (`evaluation`, `interreflection`, `fits`), because settings are read often
and in haste.
"""

from calibration.acceptance.artefacts import (
    Artefact,
    BallBarArtefact,
    PlaneArtefact,
    PlaneBesideMirror,
    SphereArtefact,
    SphereBesideMirror,
)
from calibration.acceptance.figures import Figure, Limits, Quantity, Verdict, decide, overall

__all__ = [
    "Artefact",
    "BallBarArtefact",
    "Figure",
    "Limits",
    "PlaneArtefact",
    "PlaneBesideMirror",
    "Quantity",
    "SphereArtefact",
    "SphereBesideMirror",
    "Verdict",
    "decide",
    "overall",
]
