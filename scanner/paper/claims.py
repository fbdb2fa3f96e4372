"""What the paper says about its experiments, what is found here, and where it was wrong.

Its tables lost their numbers on the way to the web (Tables 1 and 2 show nothing but their headings), so what can be
compared is what its text and captions say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanner.comparison.page import Comparison
from scanner.comparison.running import REFERENCE
from scanner.report.wording import number, per_cent

MOST_RATIO = 1.15
"""The std after two rounds may be this many times that without bounces."""

LEAST_CLOSE = 0.95
"""Share of the coordinates with Δu ≥ 60 px that one round alone must bring within 0.1 px."""


@dataclass(frozen=True)
class Statement:
    """One statement of the paper.

    Parameters
    ----------
    source
        Where it stands.
    says
        What it says, in our words.
    check
        Whether it holds here, and the figures that tell, from an experiment's rows.
    remark
        What the paper got wrong or left out; empty where it is right.
    """

    source: str
    says: str
    check: Callable[[Experiment], tuple[bool | None, str]]
    remark: str = ""


@dataclass(frozen=True)
class Limit:
    """A figure that the project promises, beside what is found."""

    window: str
    what: str
    found: float
    limit: float
    met: bool


@dataclass(frozen=True)
class Experiment:
    """One experiment: what was found, and what the paper says about it."""

    name: str
    comparison: Comparison
    statements: Sequence[Statement]

    def value(self, window: str, method: str, figure: str) -> float:
        """Mean of a figure over the seeds; NaN where there is none."""
        for row in self.comparison.rows:
            if (row.window, row.method) == (window, method):
                return row.mean[figure]
        return math.nan

    @property
    def windows(self) -> list[str]:
        """Names of the windows."""
        return [w.name for w in self.comparison.windows]

    def limits(self) -> list[Limit]:
        """What the project promises for the paper's experiments, where it was measured."""
        found = []
        for window in self.windows:
            ratio = self.value(window, "mfs", "std_ratio")
            close = self.value(window, "mfs1", "close")
            if math.isfinite(ratio):
                what = "std after two rounds ÷ without bounces, at most"
                found.append(Limit(window, what, ratio, MOST_RATIO, ratio <= MOST_RATIO))
            if math.isfinite(close):
                what = "one round alone: coordinates with Δu ≥ 60 px within 0.1 px, at least"
                found.append(Limit(window, what, close, LEAST_CLOSE, close >= LEAST_CLOSE))
        return found

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        judged = [(s, *s.check(self)) for s in self.statements]
        return {
            "rows": [row.to_json() for row in self.comparison.rows],
            "limits": [vars(limit) for limit in self.limits()],
            "paper": [
                {"source": s.source, "says": s.says, "holds": holds, "found": found, "remark": s.remark}
                for s, holds, found in judged
            ],
        }


def _order(e: Experiment) -> tuple[bool | None, str]:
    """Whether the std of MFS lies below those of TPS and MPS in every window."""
    said, holds = [], True
    for window in e.windows:
        std = {m: e.value(window, m, "std_mm") for m in ("tps", "mps", "mps_gn", "mfs_paper", "mfs")}
        holds &= std["mfs_paper"] < min(std["tps"], std["mps"])
        listed = ", ".join(f"{m} {number(s)}" for m, s in std.items())
        said.append(f"{window}: std, mm: {listed}")
    return holds, "; ".join(said)


def _covered(e: Experiment) -> tuple[bool | None, str]:
    window = e.windows[0]
    recall = {m: e.value(window, m, "recall") for m in ("mfs_paper", "mfs")}
    precision = {m: e.value(window, m, "precision") for m in ("mfs_paper", "mfs")}
    listed = "; ".join(
        f"{m}: {per_cent(recall[m])} of the bounces found, {per_cent(precision[m])} of what was found is one"
        for m in recall
    )
    return recall["mfs_paper"] >= 0.95 and precision["mfs_paper"] >= 0.95, listed


def _emitters_dark(e: Experiment) -> tuple[bool | None, str]:
    """Whether, in the regional pattern by Eq. 21, what is outside the region stays dark."""
    lit = {
        m: r.maps.lit for m, r in e.comparison.results.items() if m in ("mfs_paper", "mfs") and r.maps.lit is not None
    }
    said, holds = [], None
    for method, mask in lit.items():
        said.append(f"{method} lights {per_cent(float(mask.mean()))} of the projector's picture")
    truth = e.comparison.truth
    if truth is not None and "mfs_paper" in lit:
        shares = {m: _lit_emitters(mask, truth) for m, mask in lit.items()}
        holds = shares["mfs_paper"] < 0.05
        said += [f"{m}: {per_cent(s)} of the bounced light's sources stay lit" for m, s in shares.items()]
    return holds, "; ".join(said)


def _lit_emitters(lit: np.ndarray[Any, Any], truth: Any) -> float:
    """Share of the bounces whose source on the projector is lit."""
    bounced = np.nan_to_num(truth.alpha, nan=0.0) >= 0.02
    x, y = (np.rint(np.where(bounced, u, np.nan)) for u in (truth.bounce_x, truth.bounce_y))
    with np.errstate(invalid="ignore"):
        known = (x >= 0) & (y >= 0) & (x < lit.shape[1]) & (y < lit.shape[0])
    return float(lit[y[known].astype(int), x[known].astype(int)].mean()) if known.any() else math.nan


def _mps_fails(e: Experiment) -> tuple[bool | None, str]:
    window = e.windows[0]
    rmse = {m: e.value(window, m, "rmse_mm") for m in ("tps", "mps", "mps_gn", "mfs")}
    listed = ", ".join(f"{m} {number(v)}" for m, v in rmse.items())
    return min(rmse["mps"], rmse["mps_gn"]) > 3 * rmse["mfs"], f"{window}: RMSE from the truth, mm: {listed}"


def _on_the_ball(e: Experiment) -> tuple[bool | None, str]:
    truth = e.comparison.truth
    if truth is None or "ball" not in truth.places:
        return None, "the truth is not known"
    seen = truth.places["ball"] & np.isfinite(truth.x_p)
    results = e.comparison.results
    shares = {m: results[m].maps.interreflection[seen].mean() for m in ("mfs_paper", "mfs") if m in results}
    listed = ", ".join(f"{m} {per_cent(float(v))}" for m, v in shares.items())
    bounced = float((np.nan_to_num(truth.alpha, nan=0.0)[seen] >= e.comparison.least_alpha).mean())
    said = f"detected on the ball: {listed}; {per_cent(bounced)} of it mirrors the faces into the camera"
    return (shares["mfs_paper"] > 0.02 if "mfs_paper" in shares else None), said


_REFERENCE = f"mfs, {REFERENCE}"


def _weak(e: Experiment) -> tuple[bool | None, str]:
    said, holds = [], True
    for window in e.windows:
        rmse = {m: e.value(window, m, "rmse_mm") for m in ("tps", "mps", "mfs", _REFERENCE)}
        holds &= min(rmse["tps"], rmse["mps"]) > 1.5 * rmse[_REFERENCE]
        said.append(f"{window}: RMSE, mm: " + ", ".join(f"{m} {number(v)}" for m, v in rmse.items()))
    return holds, "; ".join(said)


def _as_truth(e: Experiment) -> tuple[bool | None, str]:
    said, holds = [], True
    for window in e.windows:
        literal, two = (e.value(window, m, "rmse_mm") for m in ("mfs_paper", "mfs"))
        tps = e.value(window, "tps", "rmse_mm")
        holds &= literal < 0.5 * tps
        said.append(f"{window}: RMSE, mm: mfs_paper {number(literal)}, tps {number(tps)}, mfs {number(two)}")
    return holds, "; ".join(said)


_EQ_21 = (
    "Eq. 21 darkens what undetected camera pixels map to and lights all else: projector pixels that no camera pixel "
    "maps to, such as those that fall on a mirror or a face turned away, stay lit, and those are often the emitters. "
    "Here only what the detected pixels' own direct light comes from is lit. (Eq. 20 should read u = φ/2πf.)"
)
_MPS = (
    "Twelve steps of each of five frequencies, 120 frames, are not Gupta and Nayar's method, which takes F + 2 frames "
    "an axis and is shown as mps_gn; and 16.67 px is probably a misprint of 16.47 px."
)
_ONE_PATH = (
    "Its one-path unwrapping is wrong by whole fringes where two paths meet, so its second round needs all nine "
    "frequencies again."
)
_THRESHOLD = "The threshold T_b is never given; here it follows the camera's noise."
_SMALL_DISTANCE = (
    "Bounces of 2 % of the direct light and more count here. std|z| is blind to those of small Δu, which move a "
    "coordinate all the same: by asin α of phase, 0.13 px for 5 %."
)
_MIRRORED = (
    "Where the ball mirrors the faces into the camera that is right: two paths meet there. Saturated pixels are "
    "flagged apart and never decoded."
)
_OWN_TRUTH = "The paper's errors are differences from its own result. The truth of the scene is known here."

STATEMENTS: Mapping[str, Sequence[Statement]] = {
    "1_board_and_mirror": (
        Statement("Table 1, Figs. 11, 12", "The error after MFS is below those of TPS and MPS.", _order, _ONE_PATH),
        Statement(
            "Fig. 9a",
            "Thresholding std|z| finds the whole region on the board, and nothing else.",
            _covered,
            _THRESHOLD,
        ),
        Statement("Fig. 9b, Eq. 21", "In round two all outside the region is dark.", _emitters_dark, _EQ_21),
        Statement("Figs. 10, 11b", "MPS cannot remove a specular bounce.", _mps_fails, _MPS),
    ),
    "2_v_board_and_ball": (
        Statement(
            "Table 2, Figs. 16, 17", "In W1 and W2 the error after MFS is below those of TPS and MPS.", _order, _EQ_21
        ),
        Statement("Fig. 14a", "The faces' bounces are detected, but for weak ones.", _covered, _SMALL_DISTANCE),
        Statement(
            "Fig. 14a",
            "Parts of the ball are detected, because they mirror the board or are too bright.",
            _on_the_ball,
            _MIRRORED,
        ),
    ),
    "3_matt_objects": (
        Statement("Figs. 20, 21", "TPS and MPS have errors where bounces are, though none that the eye sees.", _weak),
        Statement("Fig. 21", "MFS is good enough to be taken for the truth.", _as_truth, _OWN_TRUTH),
    ),
}
"""By the name of the experiment's file."""
