"""Which parameters a calibration estimates, given what was measured and asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

from calibration.solver.parameters import (
    INDEX,
    Freedom,
    State,
    freedom,
    weak_priors,
)
from calibration.solver.selection import Terms

_ACROSS_MM = 100.0  # σ of the part of a baseline that one axis cannot see


@dataclass(frozen=True, eq=False)
class Model:
    """The choices that stay while distortion terms come and go.

    Parameters
    ----------
    start
        First estimate; priors are put about it.
    axes
        Which projector coordinates were measured.
    camera_size, projector_size
        (width, height), px.
    bend, square_pixels
        As in `calibration.bundle.calibrate_rig`.
    """

    start: State
    axes: tuple[bool, bool]
    camera_size: tuple[int, int]
    projector_size: tuple[int, int]
    bend: bool = False
    square_pixels: bool = False

    def candidates(self, rational: bool = False) -> Terms:
        """Distortion terms that information may choose; one axis cannot tell decentring from a shifted centre."""
        groups = ("k1", "k2", "p1p2", "k3", *(("rational",) if rational else ()))
        return Terms(groups, groups if all(self.axes) else tuple(g for g in groups if g != "p1p2"))

    def freedom(self, terms: Terms, *extra: str, board_sigma_mm: float | None = None) -> Freedom:
        """Free parameters with the given distortion terms, ``extra`` names, and the board's points if they err."""
        prior, mean = weak_priors(self.start, self.camera_size, self.projector_size)
        tied = {}
        free = []
        for lens in ("camera", "projector"):
            names = [f"{lens}.{name}" for name in ("fx", "fy", "cx", "cy")]
            across = None if lens == "camera" or all(self.axes) else (1 if self.axes[0] else 0)
            if across is not None:
                tied[names[across]] = names[1 - across]
                names = [name for i, name in enumerate(names) if i not in (across, 2 + across)]
                prior[INDEX[f"translation.{'xy'[across]}"]] = _ACROSS_MM**-2.0
            elif self.square_pixels:
                tied[names[1]] = names[0]
                names.pop(1)
            free += names
        free += [f"{part}.{axis}" for part in ("rotation", "translation") for axis in "xyz"]
        free += terms.names()
        free += [f"board.bend_{name}" for name in ("xx", "yy", "xy")] if self.bend else []
        free_globals = freedom([*free, *extra], tied, prior, mean)
        return replace(free_globals, board_prior=None if board_sigma_mm is None else board_sigma_mm**-2.0)

    def camera_only(self, terms: Terms) -> Freedom:
        """Free parameters of the camera alone."""
        prior, mean = weak_priors(self.start, self.camera_size, self.projector_size)
        free = [f"camera.{name}" for name in ("fx", "fy", "cx", "cy")] + Terms(terms.camera).names()
        return freedom(free, {}, prior, mean)
