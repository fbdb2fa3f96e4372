"""Projector response: light against grey level, what its harmonics do to the phase, contrast against frequency."""

from __future__ import annotations

import numpy as np

from calibration.capture import photographed, recorded
from calibration.focus import projector_focus
from calibration.guide.guidance import Curve, Step
from calibration.photometry import (
    Harmonics,
    Ramp,
    gamma_of_harmonics,
    measure_harmonics,
    measure_mtf,
    mtf_plan,
    predict_phase_error,
    response_of_ramp,
    take_ramp,
)
from calibration.work import Work
from drivers import Bench, NoiseModel
from scanner.patterns import Plan, phase_steps
from scanner.phasors import RoundPhasors

STEP: Step = "response"

_COARSE, _COARSE_STEPS = 1 / 64, 16
_FINEST = 1 / 16


def run(work: Work) -> None:
    """Project a ramp of grey levels, a coarse fringe with and without correction, and fringes of many frequencies.

    The ramp and the harmonics of the uncorrected fringe tell γ independently of each other; the harmonics of the
    corrected one tell what is left.

    Raises
    ------
    StepFailedError
        The light is not steady or does not rise with the grey level, or the fringes are far out of focus.
    """
    with work.bench() as bench:
        work.hold_facing(
            bench,
            STEP,
            "light against grey level",
            "Hold the board's back, or white paper, in the middle of the volume, and still.",
        )
        measured = response_of_ramp(_ramp(work, bench))
        response = measured.response
        uncorrected, corrected = (
            _harmonics(work, bench, values, name)
            for values, name in ((None, "uncorrected"), (response.values, "corrected"))
        )
        plan = mtf_plan(bench.projector_size, response=response.values)
        phasors = RoundPhasors(plan, bench.frame_format)
        place = work.folder.new_take(f"{STEP}-frequencies")
        occasion = work.occasion(STEP, plan=plan.to_json())
        with (
            recorded(bench, place, occasion, plan.frame_count) as recording,
            work.counting("response: frequency") as count,
        ):
            for number, frames in photographed(recording, plan):
                phasors.add(number, frames)
                count(number + 1, len(plan.sequences))
        noise = phasors.estimate_noise() or bench.noise or NoiseModel(1.5)
    mtf = measure_mtf(phasors, noise)
    focus = projector_focus(mtf, _FINEST)
    second = gamma_of_harmonics(uncorrected, mtf=mtf)
    steps = work.settings.geometry.steps
    expected = predict_phase_error(response.light, _FINEST, steps, mtf=mtf)
    work.report(
        STEP,
        {
            "response": response.to_json(),
            "gamma_of_harmonics": {"gamma": second.gamma, "sigma": second.sigma},
            "second_harmonic": {"uncorrected": float(uncorrected.ratio[1]), "corrected": float(corrected.ratio[1])},
            "phase_error_px": {"steps": steps, "period_px": 1 / _FINEST, "uncorrected": expected.rms_px},
            "mtf": mtf.to_json(),
        },
        [*measured.findings, *([] if focus.finding is None else [focus.finding])],
        [
            f"γ = {response.gamma:.3f} ± {response.gamma_sigma:.2g} by the ramp, "
            f"{second.gamma:.3f} ± {second.sigma:.2g} by the second harmonic",
            f"second harmonic of a fringe: {100 * uncorrected.ratio[1]:.2f} % uncorrected, "
            f"{100 * corrected.ratio[1]:.2f} % corrected",
            f"fringes of {1 / _FINEST:.0f} px keep {100 * focus.value:.0f} % of their contrast",
        ],
        Curve(
            "response of the projector",
            measured.levels.astype(np.float64),
            100 * measured.light,
            "grey level",
            "light, % of white",
            fitted=100 * np.asarray(response.light)[measured.levels],
        ),
    )


def _ramp(work: Work, bench: Bench) -> Ramp:
    levels = sorted({round(level) for level in np.linspace(0, 255, work.settings.response.levels)})
    place = work.folder.new_take(f"{STEP}-ramp")
    occasion = work.occasion(STEP)
    with (
        recorded(bench, place, occasion, len(levels) + 6) as recording,
        work.counting("response: picture") as count,
    ):
        return take_ramp(recording, levels, count)


def _harmonics(work: Work, bench: Bench, response: tuple[float, ...] | None, name: str) -> Harmonics:
    sequence = phase_steps("x", _COARSE, _COARSE_STEPS)
    plan = Plan(bench.projector_size, (sequence,), response=response)
    place = work.folder.new_take(f"{STEP}-{name}")
    with recorded(bench, place, work.occasion(STEP, plan=plan.to_json()), plan.frame_count) as recording:
        ((_, frames),) = photographed(recording, plan)
        return measure_harmonics(frames, sequence, bench.frame_format.saturated_dn)
