"""Is the picture bright enough and not too bright? Judged before anything is measured."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from drivers import OperatorError, Pixels
from scanner.exposures import NEAR_SATURATION, ExposureSeries, contrast_ratio

_OBEYED = 0.2
"""How far the light of an exposure may be from what its time says before anything is measured, as a share."""


class ExposureError(OperatorError):
    """The picture is too bright or too dark to measure with."""


def check_exposures(
    levels: Sequence[tuple[Pixels, Pixels]], series: ExposureSeries, saturated_dn: int, max_saturated_share: float
) -> None:
    """Refuse exposures that cannot be measured with, and a camera that does not make them.

    Parameters
    ----------
    levels
        For each exposure (H, W) frames of the brightest and the darkest level of the fringes.
    series
        The exposures.
    saturated_dn, max_saturated_share
        As in `check_exposure`; the share is that of the shortest exposure.

    Raises
    ------
    ExposureError
        The shortest saturates too much, the longest shows hardly any light, or the light of one does not go with its
        time.
    """
    order = sorted(range(len(series)), key=lambda k: series.made_s[k])
    shortest, longest = order[0], order[-1]
    check_exposure(levels[shortest][0], levels[longest][1], saturated_dn, max_saturated_share, lit=levels[longest][0])
    for one, other in pairwise(order):
        told = contrast_ratio(levels[other], levels[one], NEAR_SATURATION * saturated_dn, least_contrast(saturated_dn))
        expected = series.made_s[one] / series.made_s[other]
        if abs(told / expected - 1) > _OBEYED:
            raise ExposureError(
                f"exposure check: {1e3 * series.made_s[one]:.4g} ms give {told:.2f} of the light of "
                f"{1e3 * series.made_s[other]:.4g} ms, not {expected:.2f}",
                "Check that the camera takes the exposure while it is triggered (ExposureMode: Timed, ExposureAuto and "
                "Gamma off), and that the projector's light is steady.",
            )


def least_contrast(saturated_dn: int) -> float:
    """Contrast (DN) of the brightest and the darkest picture from which a pixel counts as lit."""
    return max(0.02 * saturated_dn, 4)


def check_exposure(
    bright: Pixels, dark: Pixels, saturated_dn: int, max_saturated_share: float, *, lit: Pixels | None = None
) -> None:
    """Refuse pictures that cannot be measured with.

    Parameters
    ----------
    bright, dark
        (H, W) frames of the brightest and the darkest level of the fringes.
    saturated_dn
        Grey value from which a pixel is saturated.
    max_saturated_share
        Share of the pixels that may be.
    lit
        (H, W) frame of the brightest level in which light is looked for, where it is another than ``bright``.

    Raises
    ------
    ExposureError
        Too many saturated pixels, or hardly any that the projector makes brighter.
    """
    share = float((bright >= saturated_dn).mean())
    if share > max_saturated_share:
        raise ExposureError(
            f"exposure check: {100 * share:.1f} % of the pixels are saturated under full light, "
            f"at most {100 * max_saturated_share:g} % may be",
            "Shorten bench.camera.exposure_us, close the aperture, add a shorter exposure to scan.exposures, or allow "
            "more with scan.max_saturated_share.",
        )
    # Averaged over 8 × 8 pixels, so that noise does not pass for light.
    bright = bright if lit is None else lit
    contrast = cv2.blur(bright.astype(np.float32) - dark, (8, 8))
    share = float((contrast > least_contrast(saturated_dn)).mean())
    if share < 0.001:
        raise ExposureError(
            f"exposure check: the projector makes {100 * share:.2f} % of the pixels brighter "
            f"(brightest grey value {int(bright.max())} of {saturated_dn})",
            "Take the lens caps off, switch the projector on, point both at the object, or lengthen the exposure.",
        )
