"""Whether anything but the assumption of two paths speaks for a separation.

Where a third path is weak, two paths absorb it: they fit, one of them a fringe off. The axis across the epipolar line
contradicts that only where it separates the same two paths by itself, that is where they lie more than a fringe apart
on it. Elsewhere the assumption has to be corroborated: a third path does not stop at a pixel, so that pixels beside it
show it, refused by their χ² or undecided; and it is seen most where the bounce is stronger than the direct light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from scanner.paths.joint import DirectPaths

_WINDOW_PX = 9
"""Side of the neighbourhood, camera px."""
_UNTRUSTED = 0.15
"""Share of a neighbourhood's pixels that may be refused or undecided before the others are doubted too."""
_FRINGES_BESIDE_DOUBT, _FRINGES_STRONGER = 3.5, 1.5
"""Distance of the paths across the line, fringes, from which a pixel speaks for itself: in a doubted neighbourhood, and
where its bounce is the stronger path."""


def corroborated(
    found: DirectPaths, pixels: NDArray[np.intp], shape: tuple[int, ...], trusted: NDArray[np.bool_], fringe_px: float
) -> NDArray[np.bool_]:
    """Say of which pixels the separation is corroborated, (P,) bool.

    Parameters
    ----------
    found
        Both paths of P pixels.
    pixels
        (P,) flat numbers of the pixels.
    shape
        Of the picture, (H, W).
    trusted
        (P,) bool, the pixels whose own data leave no doubt of two paths and of which is direct.
    fringe_px
        Period of the middle fringes of the axis across the epipolar line, px.

    Notes
    -----
    The limits were set on rendered scenes of 192 x 144 pixels (a polished part, a mirror, a rough mirror, a V-groove, a
    sphere before a mirror) and judged on others (tests/scanner/test_corroboration.py).
    """
    across = 1 - found.along
    apart = np.abs(found.best.bounce[across] - found.best.direct[across]) / fringe_px
    doubted, counted = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    doubted.reshape(-1)[pixels] = ~trusted
    counted.reshape(-1)[pixels] = 1
    share = [uniform_filter(v, _WINDOW_PX, mode="constant").reshape(-1)[pixels] for v in (doubted, counted)]
    beside_doubt = share[0] > _UNTRUSTED * share[1]
    stronger = found.best.amplitude[1, found.along] > found.best.amplitude[0, found.along]
    with np.errstate(invalid="ignore"):
        alone = (beside_doubt & (apart < _FRINGES_BESIDE_DOUBT)) | (stronger & (apart < _FRINGES_STRONGER))
    return np.asarray(~alone)
