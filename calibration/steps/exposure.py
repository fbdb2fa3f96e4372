"""Exposure: the longest at which white does not saturate the board, in whole refreshes of the projector."""

from __future__ import annotations

import numpy as np

from calibration.capture import recorded
from calibration.exposure import MAX_SHOTS, Shot, search_exposure
from calibration.guide.guidance import Curve, Step
from calibration.work import StepFailedError, Work
from drivers import Pixels

STEP: Step = "exposure"


def run(work: Work) -> None:
    """Search the exposure with a bench that is opened anew for each, and keep what was found.

    Raises
    ------
    StepFailedError
        No allowed exposure is right, with what to do about the light.
    """
    settings = work.settings.exposure
    camera = getattr(work.loaded.bench_settings, "camera", None)
    present = getattr(camera, "exposure_us", None)
    if camera is None or not hasattr(camera, "exposure_us"):
        work.report(
            STEP,
            {"adjustable": False},
            [],
            [f"a bench of kind {work.loaded.config.bench.kind} sets its exposure itself"],
        )
        return
    with work.bench(still=True) as bench:
        saturated_dn = bench.frame_format.saturated_dn
        projector = getattr(bench, "projector", None)
        period = getattr(projector, "refresh_s", getattr(projector, "period_s", None))
        work.hold_facing(
            bench,
            STEP,
            "how long may the camera look?",
            f"Hold the board where it is brightest, {work.settings.geometry.nearest_mm / 10:.0f} cm from the camera, "
            "and still until the exposure is found.",
            nearest=True,
        )
    taken = 0

    def photograph(exposure_us: float) -> Pixels:
        nonlocal taken
        taken += 1
        work.operator.wait(f"exposure: {exposure_us:.0f} µs", taken, MAX_SHOTS)
        with work.bench(still=True, bench__camera__exposure_us=exposure_us) as bench:
            work.operator.keep(bench)
            width, height = bench.projector_size
            frame = np.empty(bench.frame_format.shape, bench.frame_format.dtype)
            place = work.folder.new_take(f"{STEP}-{taken:02d}")
            with recorded(bench, place, work.occasion(STEP, exposure_us=exposure_us), 1) as recording:
                recording.prepare([np.full((height, width), 255, np.uint8)])
                recording.expose(0, frame)
        work.terminal.say(
            [f"  {exposure_us:.0f} µs: brightest {100 * int(frame.max()) / saturated_dn:.0f} % of full scale"]
        )
        return frame

    try:
        found = search_exposure(
            photograph,
            saturated_dn=saturated_dn,
            minimum_us=settings.shortest_us,
            maximum_us=settings.longest_us,
            period_s=period if settings.whole_refreshes else None,
            start_us=present,
            max_saturated_share=min(0.001, work.loaded.config.scan.max_saturated_share),
        )
    except ValueError as error:
        raise StepFailedError(
            f"exposure: {error}", "Widen calibration.exposure.shortest_us and longest_us of the bench file."
        ) from None
    work.report(
        STEP,
        {
            "adjustable": True,
            "exposure_us": found.exposure_us,
            "refreshes": found.periods,
            "brightest": found.brightest,
            "saturated_share": found.saturated_share,
        },
        found.findings,
        [found.reason],
        _curve(found.shots),
    )


def _curve(shots: tuple[Shot, ...]) -> Curve | None:
    """Brightness against exposure; one point is no curve."""
    if len(shots) < 2:
        return None
    return Curve(
        "brightest pixels",
        np.array([shot.exposure_us / 1e3 for shot in shots]),
        np.array([100 * shot.brightest for shot in shots]),
        "exposure, ms",
        "% of full scale",
    )
