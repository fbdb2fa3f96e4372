"""Focus and aperture: whether the camera's edges are sharp where the board is held."""

from __future__ import annotations

import numpy as np

from calibration.capture import recorded
from calibration.focus import camera_focus, edge_blur
from calibration.guide.guidance import Step
from calibration.work import Work

STEP: Step = "focus"


def run(work: Work) -> None:
    """Judge the camera's focus by the printed edges of the board, under steady white light.

    The projector's is judged by its fringes in the step ``response``, which needs the exposure first.
    """
    with work.bench(still=True) as bench:
        work.hold_facing(
            bench,
            STEP,
            "is the camera in focus?",
            "Hold the board in the middle of the volume; turn the camera's focus ring until its edges are sharpest.",
        )
        width, height = bench.projector_size
        frame = np.empty(bench.frame_format.shape, bench.frame_format.dtype)
        occasion = work.occasion(STEP)
        with recorded(bench, work.folder.new_take(STEP), occasion, 1) as recording:
            # Grey rather than white: at an exposure nobody has set yet, white may saturate.
            recording.prepare([np.full((height, width), 160, np.uint8)])
            recording.expose(0, frame)
        saturated_dn = bench.frame_format.saturated_dn
        noise = bench.noise
        blur = edge_blur(
            frame, saturated_dn, 1.5 if noise is None else float(np.sqrt(noise.variance(saturated_dn / 4)))
        )
    if blur is None:
        work.report(
            STEP,
            {"edge_px": None},
            [],
            ["too few clear edges to judge the focus by; look at the picture yourself"],
        )
        return
    focus = camera_focus(blur)
    findings = [] if focus.finding is None else [focus.finding]
    work.report(
        STEP,
        {"edge_px": blur.width_px, "edges": blur.edges},
        findings,
        [f"printed edges are {blur.width_px:.1f} px wide (10 to 90 %)"],
    )
