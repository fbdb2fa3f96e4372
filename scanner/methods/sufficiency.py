"""Is the first round enough? What its separation left open decides whether a second round is taken (`scan.rounds`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scanner.methods.separated import Separated
from scanner.patterns import Axis
from scanner.regions import inside, sound_mask

Rounds = Literal["auto", 1, 2]

UNDECIDED = 0.03
"""Share of the region's pixels that may stay without a coordinate: two rounds are held to 97 % as well."""
BLURRED = 0.02
"""Share of them whose σ may be more than `BLUR` times what a second round would reach."""
BLUR = 2.0
"""At twice the σ one round still measures better for its frames than two: averaging both rounds gains √2."""
THIRD = 0.01
"""Share that may see more than two paths."""
MUTUAL = 0.02
"""Share whose bounce may come from within the region: faces that light each other throw more than one bounce."""


@dataclass(frozen=True)
class Evidence:
    """What the separation of round one left open, as shares of the region's pixels.

    Parameters
    ----------
    undecided
        Without a coordinate: no fit, or more than one possible place.
    blurred
        Decided, with a σ above `BLUR` times that of direct light alone.
    third
        More than two paths.
    mutual
        Bounce from a place that the region itself sees directly.
    """

    undecided: float
    blurred: float
    third: float
    mutual: float

    @property
    def enough(self) -> bool:
        """Whether a second round would add nothing that is needed."""
        return not self._lacking()

    def one_round(self, rounds: Rounds) -> bool:
        """Whether the scan ends with round one."""
        return rounds == 1 or (rounds == "auto" and self.enough)

    def decision(self, rounds: Rounds, frames: int) -> str:
        """Say in words what was decided about a second round of at most ``frames`` frames; empty where nothing was."""
        if rounds == 2:
            return ""
        lacking = "; ".join(self._lacking())
        if rounds == 1:
            return f"one round, as asked: {lacking or 'it suffices'}"
        if lacking:
            return f"round two follows: {lacking}"
        return (
            f"round two is not needed, {frames} frames are saved: round one separates "
            f"{100 * (1 - self.undecided):.1f} % of the bounce region"
        )

    def _lacking(self) -> list[str]:
        said = (
            (self.undecided, UNDECIDED, "are undecided"),
            (self.blurred, BLURRED, f"have more than {BLUR:g} times the noise of direct light alone"),
            (self.third, THIRD, "see more than two light paths"),
            (self.mutual, MUTUAL, "are lit by another part of the region"),
        )
        return [
            f"{100 * share:.1f} % of the bounce region's pixels {what}, {100 * limit:g} % may"
            for share, limit, what in said
            if share > limit
        ]


def weigh(separated: Separated, size: tuple[int, int]) -> Evidence:
    """Weigh the separation of a region.

    Parameters
    ----------
    separated
        Of round one.
    size
        Projector (width, height), px.
    """
    count = separated.pixels.size
    if not count:
        return Evidence(0.0, 0.0, 0.0, 0.0)
    # Where a mirror shows the pixel something else there is no direct light that a second round could measure.
    possible = ~separated.off_line
    wanted = max(int(possible.sum()), 1)
    trusted = separated.trusted
    nothing = np.full(count, np.nan, np.float32)

    def both(values: dict[Axis, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        return values.get("x", nothing), values.get("y", nothing)

    x, y = both(separated.u)
    lit = sound_mask(x[trusted], y[trusted], size, 0.0)
    from_x, from_y = (np.zeros(count, np.float32) if np.isnan(b).all() else b for b in both(separated.bounce))
    mutual = trusted & inside(lit, from_x, from_y, 0) if trusted.any() else trusted
    return Evidence(
        undecided=float((possible & ~trusted).sum()) / wanted,
        blurred=float((trusted & (separated.blur > BLUR)).sum()) / wanted,
        third=float(separated.third.sum()) / wanted,
        mutual=float(mutual.sum()) / wanted,
    )
