"""Points of the unit circle, and their angles, for the kernels of the separation: faster than the C library's.

Numba's cache of a kernel does not see this file: `make` compiles them anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_TURN = 2 * math.pi

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz"},
    "_nrt": False,
}
_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])


def compiled(kernel: _Kernel) -> _Kernel:
    """Compile a kernel of the separation; NaN and infinity keep their meaning.

    None makes an array of its own, so that Numba need not count who uses which. Counting each row that is taken of a
    table, by the atomic operations that threads need, took as long as the arithmetic.
    """
    fast: _Kernel = njit(**_OPTIONS)(kernel)
    return fast


@compiled  # pragma: no cover
def rotation(angle: float) -> complex:
    """e^{i·angle} to 1e-10, for angles up to 1e5 rad.

    Notes
    -----
    A quarter of what is left of the angle beside whole turns goes through Taylor's series, and is doubled twice: no
    case is told from another, at which a processor would have to guess.
    """
    r = 0.25 * (angle - math.floor(angle * (1 / _TURN) + 0.5) * _TURN)
    q = r * r
    sine = r * (1 + q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * (1 / 362880 - q * (1 / 39916800))))))
    cosine = q * (1 / 24 + q * (-1 / 720 + q * (1 / 40320 - q * (1 / 3628800 - q * (1 / 479001600)))))
    cosine = 1 + q * (-1 / 2 + cosine)
    sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
    return complex(1 - 2 * sine * sine, 2 * sine * cosine)


@compiled  # pragma: no cover
def angle_of(z: complex) -> float:
    """Angle of a complex number to 2e-8 rad; 0 of zero.

    Notes
    -----
    Hastings' polynomial (Abramowitz & Stegun, Handbook of Mathematical Functions, 1964, 4.4.49), without a branch.
    """
    x, y = abs(z.real), abs(z.imag)
    t = min(x, y) / max(max(x, y), 1e-300)
    q = t * t
    high = 0.0429096138 + q * (-0.0161657367 + q * 0.0028662257)
    high = -0.1420889944 + q * (0.1065626393 + q * (-0.0752896400 + q * high))
    r = t * (1 + q * (-0.3333314528 + q * (0.1999355085 + q * high)))
    r = 0.5 * math.pi - r if y > x else r
    r = math.pi - r if z.real < 0 else r
    return math.copysign(r, z.imag)
