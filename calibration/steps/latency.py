"""Display latency: how late a picture is on the surface, and whether every picture comes in its turn."""

from __future__ import annotations

import numpy as np

from calibration.capture import recorded, recorded_steps
from calibration.display import check_display
from calibration.guide.guidance import Curve, Step
from calibration.work import Work
from drivers import LatencyBound
from drivers.latency import STEPS

STEP: Step = "latency"


def run(work: Work) -> None:
    """Step between black and white, then show a coded sequence the way a scan does, and read every picture's number.

    Raises
    ------
    StepFailedError
        The display drops, repeats, mixes or delays pictures.
    """
    document = None
    lines = []
    with work.bench(still=True) as bench:
        work.hold_facing(
            bench,
            STEP,
            "how late is a picture?",
            "Hold the board still in the middle of the volume; the light will flash.",
        )
        if isinstance(bench, LatencyBound):
            place, occasion = work.folder.new_take(f"{STEP}-steps"), work.occasion(STEP)
            with recorded_steps(bench, place, occasion, 3 * STEPS) as keep, work.counting("latency: step") as count:
                latency = bench.measure_latency(count, keep)
            document = latency.to_json()
            lines.append(
                f"from hand-over to surface {latency.median_s * 1e3:.1f} ms (median), {latency.p99_s * 1e3:.1f} ms "
                f"(p99 of {latency.samples} steps)"
            )
            bench.use_latency(latency)
        else:
            lines.append(f"{bench.name} knows by itself when a picture is on the surface")
        period = getattr(getattr(bench, "projector", None), "period_s", None)
        place, occasion = work.folder.new_take(STEP), work.occasion(STEP)
        with recorded(bench, place, occasion, 64) as recording, work.counting("display: picture") as count:
            check = check_display(recording, progress=count)
    frames_late = None if document is None or not period else float(np.ceil(document["median_s"] / period))
    if frames_late is not None:
        lines.append(f"that is within {frames_late:.0f} refreshes")
    lines.append(f"coded sequence: {len(check.shown)} pictures, each seen in its own exposure" if check.good else "")
    work.report(
        STEP,
        {"latency": document, "refreshes": frames_late, "pictures_checked": len(check.shown)},
        check.findings,
        [line for line in lines if line],
        Curve(
            "picture that was seen",
            check.shown.astype(np.float64),
            check.seen.astype(np.float64),
            "picture that was asked for",
            "number read in its exposure",
            fitted=check.shown.astype(np.float64),
        ),
    )
