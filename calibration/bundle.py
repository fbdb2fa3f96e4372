"""From observed poses to a rig with its uncertainties: the order of the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.diagnosis import diagnosed
from calibration.diagnosis.expectation import Expectation
from calibration.diagnosis.fringes import Fringes
from calibration.observations import Finding, PoseObservation
from calibration.solver.adjustment import Adjusted, adjusted
from calibration.solver.beginning import begun, reversed_axes
from calibration.solver.measurements import Measurements, gathered
from calibration.solver.model import Model
from calibration.solver.refusal import CalibrationError
from calibration.solver.reporting import Fit, annotated, reported
from calibration.solver.result import Calibration
from calibration.solver.screening import Screened, screened
from calibration.solver.selection import Terms, Trial, selected

Array = NDArray[np.float64]

LEAST_POSES = 3
_DISAGREES = 3.0  # times the residuals of the other poses
_MOST_DROPPED = 1 / 3


def calibrate_rig(
    observations: Sequence[PoseObservation],
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    *,
    bend: bool = False,
    board_sigma_mm: float | None = None,
    terms: Literal["auto"] | Terms = "auto",
    rational: bool = False,
    square_pixels: bool = False,
    expected: Expectation | None = None,
    fringes: Fringes | None = None,
    validity: Mapping[str, Any] | None = None,
) -> Calibration:
    """Camera, projector and their relative pose, estimated together from all poses of a board.

    Minimises the robust, weighted reprojection error of all points in camera and projector over both lenses, the
    relative pose X_proj = R X_cam + T, and the poses of the board (Zhang, IEEE TPAMI 22, 1330 (2000), for the camera;
    the projector is a camera that sees its own coordinates, Zhang & Huang, Opt. Eng. 45, 083601 (2006)).

    Parameters
    ----------
    observations
        One per pose; at least three. With one-axis data a whole column of every ``projector`` is NaN: then the
        projector's pixels are taken as square, its centre across the fringes as the picture's, and the baseline
        across them is known only through the lens distortion (finding ``single_axis``).
    camera_size, projector_size
        (width, height), px.
    bend
        Estimate how the board is bent: z = a x² + b y² + c xy.
    board_sigma_mm
        How far (standard deviation of each coordinate) the board's points lie from where its definition has them, as
        of a print that is neither exact nor flat: every point is then estimated with the rig (Strobl & Hirzinger, ICCV
        Workshops 2011, 1068). None takes the board as exact.
    terms
        Distortion terms; "auto" chooses among k1, k2, p1p2, k3 by information.
    rational
        Let "auto" consider k4–k6 as well.
    square_pixels
        Hold fx = fy in both lenses.
    expected
        What a ruler says, against a wrong scale.
    fringes
        What was projected, to recognise residuals that follow the fringes.
    validity
        JSON-ready notes on what the rig's truth depends on (date, board, temperature, focus), kept in its metadata.

    Raises
    ------
    CalibrationError
        No rig can be estimated; ``findings`` say why. Where a rig can be estimated but must not be used, `Calibration`
        is returned with findings that refuse it.
    """
    sieve = screened(observations)
    findings = _strangers(observations, sieve)
    kept = [int(i) for i in np.flatnonzero(sieve.usable)]
    if len(kept) < LEAST_POSES:
        raise CalibrationError([*findings, _too_few(len(kept), len(observations))])

    def data_of(poses: Sequence[int]) -> Measurements:
        return gathered([observations[i] for i in poses], [sieve.keep[i] for i in poses])

    def ids_of(poses: Sequence[int]) -> NDArray[np.int64]:
        return np.concatenate([observations[i].ids[sieve.keep[i]] for i in poses])

    data = data_of(kept)
    turned_over = reversed_axes(data)
    if turned_over is not None:
        raise CalibrationError([*findings, turned_over])
    fit = _fitted(data, ids_of(kept), camera_size, projector_size, bend, square_pixels, terms, rational)
    most = int(_MOST_DROPPED * len(kept))
    for _ in range(most):
        worst = _disagreeing(fit.adjusted, fit.data)
        if worst is None or len(kept) <= LEAST_POSES:
            break
        kept.pop(worst)
        fit = _fitted(data_of(kept), ids_of(kept), camera_size, projector_size, bend, square_pixels, terms, rational)
    if board_sigma_mm is not None:
        fit = _with_board(fit, board_sigma_mm, terms, rational)
    calibration = reported(observations, sieve.usable, kept, fit)
    findings += diagnosed(calibration, expected, fringes)
    return annotated(replace(calibration, findings=tuple(findings)), validity or {})


def _fitted(
    data: Measurements,
    ids: NDArray[np.int64],
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    bend: bool,
    square_pixels: bool,
    terms: Literal["auto"] | Terms,
    rational: bool,
) -> Fit:
    start = begun(data, camera_size, projector_size)
    model = Model(start.start, start.axes, camera_size, projector_size, bend, square_pixels)
    table: tuple[Trial, ...] = ()
    result: Adjusted
    if terms == "auto":
        terms, result, table = selected(model.start, data, model.freedom, model.candidates(rational))
    else:
        result = adjusted(model.start, data, model.freedom(terms))
    return Fit(model, data, terms, table, result, ids)


def _with_board(fit: Fit, sigma_mm: float, terms: Literal["auto"] | Terms, rational: bool) -> Fit:
    """Let the board's points move; what they hid of the lenses is then chosen anew, with the board as found held."""

    def moving(chosen: Terms, start: Adjusted) -> Adjusted:
        return adjusted(start.state, fit.data, fit.model.freedom(chosen, board_sigma_mm=sigma_mm))

    result = moving(fit.terms, fit.adjusted)
    if terms != "auto":
        return replace(fit, adjusted=result, board_sigma_mm=sigma_mm)
    held = replace(fit.model.start, board=result.state.board)
    chosen, plain, table = selected(held, fit.data, fit.model.freedom, fit.model.candidates(rational))
    result = moving(chosen, plain)
    return replace(fit, terms=chosen, table=table, adjusted=result, board_sigma_mm=sigma_mm)


def _disagreeing(fit: Adjusted, data: Measurements) -> int | None:
    """The pose whose residuals are larger than the others' by more than chance or lens models explain."""
    in_sigmas = fit.residuals**2 * data.weight
    worst: tuple[float, int] | None = None
    for lens in range(2):
        sums = np.array([in_sigmas[lens, rows].sum() for rows in data.slices()])
        counts = np.array([np.count_nonzero(data.known[lens, rows]) for rows in data.slices()])
        rms = np.sqrt(sums / np.maximum(counts, 1))
        for i in np.flatnonzero(counts):
            ratio = float(rms[i] / max(1.0, float(np.median(np.delete(rms, i)))))
            if ratio > _DISAGREES and (worst is None or ratio > worst[0]):
                worst = ratio, int(i)
    return None if worst is None else worst[1]


def _strangers(observations: Sequence[PoseObservation], sieve: Screened) -> list[Finding]:
    bad = [i for i in range(len(observations)) if sieve.strangers[i] > 0 and not sieve.usable[i]]
    if not bad:
        return []
    shares = ", ".join(f"{observations[i].name} ({100 * sieve.strangers[i]:.0f} %)" for i in bad)
    return [
        Finding(
            "mislabelled_points",
            2 * len(bad) >= len(observations),
            f"in {len(bad)} of {len(observations)} poses many points do not lie where the rest of their board says: "
            f"{shares}; these poses are left out",
            "Check that the board in use is the board that was named (kind, rows and columns, dictionary), and that no "
            "light reflects from it; then take these poses again.",
        )
    ]


def _too_few(usable: int, taken: int) -> Finding:
    return Finding(
        "too_few_poses",
        True,
        f"{usable} of {taken} poses can be used, a calibration needs {LEAST_POSES} and ten make a good one",
        "Take more poses with the board whole in the camera's and the projector's picture, tilted differently.",
    )
