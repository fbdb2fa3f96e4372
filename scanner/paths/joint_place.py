"""Where the one path lies that phasors hold; see `scanner.paths.joint_seeds`.

The frequencies are equally spaced: what lies above the middle one is turned by as much as what lies below it is turned
back, so that sums run over pairs of frequencies, as in `scanner.paths.folding`.

Numba's cache of `seed_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.rotation import angle_of, compiled, rotation

Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

ORDERS = 2
"""Fringe orders tried to either side of what a pole says."""
_TURN = 2 * math.pi
_TINY = 1e-300


def order_turns(count: int, omega0: float, step: float) -> Phasors:
    """(ORDERS, T // 2) turn of a path that lies one, two, … fringes of the middle frequency further on.

    At the frequencies above the middle, over its turn there; below the middle it is the conjugate.
    """
    above = np.arange(count // 2) + (1 if count % 2 else 0.5)
    fringe = 2 * np.pi / (omega0 + 0.5 * (count - 1) * step)
    return np.asarray(np.exp(1j * fringe * step * np.outer(1 + np.arange(ORDERS), above)))


@compiled  # pragma: no cover
def _outwards(count: int, angle: float) -> Any:
    """e^{i·angle} of the first frequency above the middle, and from one to the next; ``angle`` is of one step."""
    if count % 2:
        turn = rotation(angle)
        return turn, turn
    half = rotation(0.5 * angle)
    return half, half * half


@compiled  # pragma: no cover
def wave_of(u: float, omega0: float, step: float, wave: Phasors) -> None:
    """Phasors e^{iωu} of a path at all frequencies, from the middle outwards: half as long a chain of products."""
    count, half = wave.size, wave.size // 2
    middle = rotation((omega0 + 0.5 * (count - 1) * step) * u)
    e, turn = _outwards(count, step * u)
    wave[half] = middle
    for j in range(half):
        wave[half - 1 - j], wave[count - half + j] = middle * e.conjugate(), middle * e
        e *= turn


@compiled  # pragma: no cover
def lone_path(
    left: Phasors, g: Reals, lag: complex, omega0: float, step: float, turns: Phasors, orders: int, low: float,
    high: float,
) -> Any:  # fmt: skip
    """Place of the one path in ``left``, whose pole has the angle of ``lag``, and Σ g times its amplitude there.

    Of the place that the phase at the middle frequency gives and of ``orders`` fringes to either side that where there
    is most light; -inf where none of them lies within the picture.
    """
    count, half = left.size, left.size // 2
    centre, per_step = omega0 + 0.5 * (count - 1) * step, 1 / step
    per_centre = 1 / centre
    coarse = angle_of(lag) * per_step
    coarse -= _TURN * per_step * math.floor((coarse - 0.5 * (low + high)) * step * (1 / _TURN) + 0.5)
    # Of an odd comb the turn from one frequency to the next is that of the pole itself.
    turn = lag * (1 / max(math.sqrt(lag.real * lag.real + lag.imag * lag.imag), _TINY))
    first = turn
    if count % 2 == 0:
        first, turn = _outwards(count, step * coarse)
    middle = g[half] * left[half] if count % 2 else 0j
    e, c = first, middle
    for j in range(half):
        above, below = g[count - half + j] * left[count - half + j], g[half - 1 - j] * left[half - 1 - j]
        s, d = above + below, above - below
        c += complex(s.real * e.real + d.imag * e.imag, s.imag * e.real - d.real * e.imag)
        e *= turn
    off = angle_of(c) - coarse * centre
    off -= _TURN * math.floor(off * (1 / _TURN) + 0.5)
    fine = coarse + off * per_centre
    c *= 1 / max(math.sqrt(c.real * c.real + c.imag * c.imag), _TINY)
    more, further = _outwards(count, step * per_centre * off)
    e, turn = first * more, turn * further
    here = middle.real * c.real + middle.imag * c.imag
    up1 = up2 = down1 = down2 = here
    for j in range(half):
        above, below = g[count - half + j] * left[count - half + j], g[half - 1 - j] * left[half - 1 - j]
        s, d = above + below, above - below
        even = c.real * (s.real * e.real + d.imag * e.imag) + c.imag * (s.imag * e.real - d.real * e.imag)
        odd = c.real * (d.imag * e.real - s.real * e.imag) - c.imag * (d.real * e.real + s.imag * e.imag)
        here += even
        # A path k fringes on is turned by as much one way as one k fringes back is the other.
        same, other = even * turns[0, j].real, odd * turns[0, j].imag
        up1, down1 = up1 + (same + other), down1 + (same - other)
        same, other = even * turns[1, j].real, odd * turns[1, j].imag
        up2, down2 = up2 + (same + other), down2 + (same - other)
        e *= turn
    place, most = fine, -math.inf
    for k, light in ((-2, down2), (-1, down1), (0, here), (1, up1), (2, up2)):
        u = fine + k * _TURN * per_centre
        if light > most and abs(k) <= orders and low <= u < high:
            place, most = u, light
    return place, most
