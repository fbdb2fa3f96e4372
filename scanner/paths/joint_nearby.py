"""Other places of the bounce near a fit, all of them: what decides how well a direct place is known.

About a direct place u₁ that is known to a fraction of a fringe the phasors of an axis are linear in all but the place
of the bounce,

    z_t e^{-iω_t u₁} = m_t (a₁ + a₁ δu iω_t + a₂ e^{iω_t d}) + noise,

so that the power which a bounce at distance d explains beyond the direct path is one dot product with a profile that
depends on the plan alone. All distances up to a period of the comb are looked at, and the direct place one fringe to
either side as well: the minima of χ² that the fits of `scanner.paths.joint_seeds` do not lead to.

Numba's cache of `joint_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.comb import Comb
from scanner.paths.rotation import compiled, rotation

Reals = NDArray[np.float64]
Floats = NDArray[np.float32]
Phasors = NDArray[np.complex128]
Profile = tuple[Reals, Floats, Reals, Reals]
Workspace = tuple[Reals, Reals, Reals, Reals, Reals, Floats, Floats, Reals, Reals, Reals]

NEARBY = 8
"""Pairs of places that are handed on, the likeliest."""
_PLACES = 40
"""Places of the bounce that are kept of one axis about one direct place: all that there can be."""
_MOST_REACH = 4
"""Steps that the direct place is moved at most."""
_TRIED = 6
"""Of these the ones, the likeliest first, that are tried with each of the other axis."""
_HOPELESS_CHI2 = 14.0
"""χ² above the best from which a place, or a pair, is hopeless."""
_LANES = 16
"""Numbers that a processor may take at a time: no row of a table has a remainder."""
_STEP_RAD = 0.8
"""Step of the distances, as a phase: half of it costs 8 % of a path's power."""
_CLOSEST_RAD = math.pi / 2
"""Nearer than a quarter fringe, two paths are as good as one."""
_CLEAR_SIGMAS = 5.0
"""Amplitude over σ_z from which a bounce that is far on an axis is beyond doubt there."""
_FARTHEST_MOVE_RAD = 1.0
"""A direct place that the bounce moves by more is another one."""


@dataclass(frozen=True)
class Profiles:
    """What a bounce adds to a direct path on one axis, for G distances to one side; to the other it is conjugate.

    Parameters
    ----------
    distance
        (G,) d, px, ascending.
    table
        (2, T, ≥ G) float32 real and imaginary part of √g e^{iωd} less what amplitude and place of the direct path can
        take of it, of unit length; zero from G on.
    length
        (G,) its length before.
    taken
        (2, G) how much of amplitude, and of a₁ δu, a bounce of unit amplitude takes from the direct path.
    """

    distance: Reals
    table: Floats
    length: Reals
    taken: Reals

    @classmethod
    def of(cls, comb: Comb) -> Profiles:
        """All distances up to 1/(TΔf), the least at which the modulation varies by a whole period."""
        omega = comb.carrier * (1 + comb.xi)
        reach = 2 * math.pi / (omega.size * comb.carrier * comb.step_rad)
        distance = np.arange(_CLOSEST_RAD, reach * comb.carrier, _STEP_RAD) / comb.carrier
        root = comb.gain[:, None]
        wave = root * np.exp(1j * omega[:, None] * distance)
        place = root * omega[:, None]
        by_amplitude = (root * wave.real).sum(0) / (root**2).sum()
        by_place = (place * wave.imag).sum(0) / (place**2).sum()
        rest = np.stack([wave.real - root * by_amplitude, wave.imag - place * by_place])
        length = np.sqrt((rest**2).sum((0, 1)))
        table = np.zeros((2, omega.size, -(-distance.size // _LANES) * _LANES), np.float32)
        table[:, :, : distance.size] = rest / length
        return cls(distance, table, length, np.stack([by_amplitude, by_place]))

    @property
    def arrays(self) -> Profile:
        """As the kernel takes them."""
        return self.distance, self.table, self.length, self.taken


@compiled  # pragma: no cover
def _insert(found: Reals, first: int, count: int, most: int, row: Reals) -> int:
    """Put a row into the list ``found[first:count]``, which ascends in χ², its first column; returns the new count."""
    if count - first == most:
        if not row[0] < found[count - 1, 0]:
            return count
        count -= 1
    place = count
    while place > first and row[0] < found[place - 1, 0]:
        for m in range(row.size):
            found[place, m] = found[place - 1, m]
        place -= 1
    for m in range(row.size):
        found[place, m] = row[m]
    return count + 1


@compiled  # pragma: no cover
def _far_bounce(x: Reals, gain: Reals, sigma: float, omega0: float, step: float, d: float, s0: float, s2: float) -> Any:
    """What `Profiles` says about one distance: power, length, and what it takes of amplitude and place."""
    count = gain.size
    e, turn = rotation(omega0 * d), rotation(step * d)
    c0 = c1 = along = 0.0
    for t in range(count):
        root, omega = gain[t] / sigma, omega0 + t * step
        c0 += root * root * e.real
        c1 += root * root * omega * e.imag
        along += root * (x[t] * e.real + x[count + t] * e.imag)
        e *= turn
    by_amplitude, by_place = c0 / s0, c1 / s2
    for t in range(count):
        root, omega = gain[t] / sigma, omega0 + t * step
        along -= root * (x[t] * by_amplitude + x[count + t] * omega * by_place)
    length = math.sqrt(s0 - by_amplitude * c0 - by_place * c1)
    return along / length, length, by_amplitude, by_place


@compiled  # pragma: no cover
def _explained(x: Reals, table: Floats, power: Floats) -> None:
    """Square roots of the power that a bounce at each distance explains, (2, G): to the one side, and to the other."""
    count, size = table.shape[1], table.shape[2]
    for j in range(size):
        power[0, j] = power[1, j] = np.float32(0)
    for t in range(0, count - 2, 3):
        # Three at a time, because fetching the sums takes longer than adding to them.
        r0, r1, r2 = np.float32(x[t]), np.float32(x[t + 1]), np.float32(x[t + 2])
        i0, i1, i2 = np.float32(x[count + t]), np.float32(x[count + t + 1]), np.float32(x[count + t + 2])
        for j in range(size):
            power[0, j] += r0 * table[0, t, j] + r1 * table[0, t + 1, j] + r2 * table[0, t + 2, j]
            power[1, j] += i0 * table[1, t, j] + i1 * table[1, t + 1, j] + i2 * table[1, t + 2, j]
    for t in range(count - count % 3, count):
        r0, i0 = np.float32(x[t]), np.float32(x[count + t])
        for j in range(size):
            power[0, j] += r0 * table[0, t, j]
            power[1, j] += i0 * table[1, t, j]
    for j in range(size):
        even, odd = power[0, j], power[1, j]
        power[0, j], power[1, j] = even + odd, even - odd


@compiled  # pragma: no cover
def _peaks(power: Floats, floor: float, last: int, peaks: Floats) -> None:
    """Maxima of ``power`` above a floor, zero elsewhere. At the ends, and beside the direct path, there are none."""
    least, nothing = np.float32(floor), np.float32(0)
    for side in range(2):
        for j in range(1, last):
            before, here, after = power[side, j - 1], power[side, j], power[side, j + 1]
            peaks[side, j] = here if (here > least) & (here >= before) & (here > after) else nothing


@compiled  # pragma: no cover
def _set_place(
    row: Reals, chi2: float, u1: float, d: float, a1: float, a2: float, information: float, by_place: float,
    moved: float, omega0: float,
) -> bool:  # fmt: skip
    """Write a place of the bounce as a row of `_places`; False where the direct path is none or another then."""
    move = (moved - a2 * by_place) / a1
    if not (a1 > 0 and abs(move) * omega0 < _FARTHEST_MOVE_RAD):
        return False
    row[0], row[1], row[2], row[3] = chi2, u1 + move, u1 + d, a1
    row[4], row[5], row[6], row[7] = a2, information, math.inf, by_place
    return True


@compiled  # pragma: no cover
def _places(
    y: Phasors, gain: Reals, sigma: float, omega0: float, step: float, u1: float, u2: float, only_u2: bool,
    profile: Profile, scratch: tuple[Reals, Floats, Floats, Reals], found: Reals, order: Reals, count: int,
    limit: float,
) -> int:  # fmt: skip
    """Places of the bounce about the direct place u₁ that are local maxima of the likelihood, as rows of ``found``.

    A bounce at u₂ is one of them where the profiles do not reach it, and with ``only_u2`` the only one. Of a row: χ²,
    u₁, u₂, a₁, a₂, information of a₂, room for the χ² of a pair, what a bounce of unit amplitude takes of a₁ δu. Places
    of a χ² above ``limit`` are none. Returns the new number of rows; the first ``count`` stay, and ``order`` lists χ²
    and number of the others.
    """
    distance, table, length, taken = profile
    x, power, peaks, row = scratch
    e, turn = rotation(-omega0 * u1), rotation(-step * u1)
    total = own = moved = s0 = s2 = 0.0
    reciprocal = 1 / sigma
    for t in range(y.size):
        q, root, omega = e * y[t], gain[t] * reciprocal, omega0 + t * step
        x[t], x[y.size + t] = root * q.real, root * q.imag
        total += x[t] * x[t] + x[y.size + t] * x[y.size + t]
        own += root * x[t]
        moved += root * omega * x[y.size + t]
        s0 += root * root
        s2 += root * root * omega * omega
        e *= turn
    own, moved = own / s0, moved / s2
    total -= own * own * s0 + moved * moved * s2
    first, last = count, distance.size - 1
    if abs(u2 - u1) > distance[last]:
        amount, size, by_amplitude, by_place = _far_bounce(x, gain, sigma, omega0, step, u2 - u1, s0, s2)
        chi2, a2 = total - amount * amount, amount / size
        a1 = own - a2 * by_amplitude
        if (
            amount > 0
            and chi2 < limit
            and _set_place(found[count], chi2, u1, u2 - u1, a1, a2, size * size, by_place, moved, omega0)
        ):
            limit = min(limit, chi2 + _HOPELESS_CHI2)
            row[0], row[1] = chi2, count
            count = _insert(order, first, count, _PLACES, row[:2])
    if only_u2:
        return count
    _explained(x, table, power)
    _peaks(power, math.sqrt(max(total - limit, 0.0)), last, peaks)
    for side in range(2):
        sign = 1 - 2 * side
        for j in range(1, last):
            amount = peaks[side, j]
            if not amount > 0:
                continue
            chi2, size = total - amount * amount, length[j] * reciprocal
            a2 = amount / size
            if (
                chi2 < limit
                and count - first < _PLACES
                and _set_place(
                    found[count], chi2, u1, sign * distance[j], own - a2 * taken[0, j], a2, size * size,
                    sign * taken[1, j], moved, omega0,
                )
            ):  # fmt: skip
                limit = min(limit, chi2 + _HOPELESS_CHI2)
                row[0], row[1] = chi2, count
                count = _insert(order, first, count, _PLACES, row[:2])
    return count


@compiled  # pragma: no cover
def nearby(
    ya: Phasors, yb: Phasors, gain_a: Reals, gain_b: Reals, sigma_a: float, sigma_b: float, comb: Reals, theta: Reals,
    chi2_of_theta: float, prior: Reals, profile_a: Profile, profile_b: Profile, work: Workspace, known_a: int,
    known_b: int, found: Reals, reach: int, per_fringe: int,
) -> Any:  # fmt: skip
    """Starts near the fit ``theta`` as rows (u₁, u₂, a₁, a₂ along and across) of ``found`` (NEARBY, 9); χ² is last.

    The direct place is tried ``reach`` steps to either side, ``per_fringe`` of which are one fringe.
    The profiles are `Profiles.arrays` of both axes, ``work`` is `workspace`. Returns how many starts there are, and the
    new lengths of the last two arrays of ``work``: χ², direct place along or across, its σ, by place of the bounce.
    """
    along, across, order_a, order_b, x, power, peaks, row, posterior_a, posterior_b = work
    distance_a, distance_b, scratch = profile_a[0], profile_b[0], (x, power, peaks, row)
    # A bounce that is far and clear leaves no room for another one.
    clear_a = abs(theta[1] - theta[0]) > distance_a[-1] and theta[3] > _CLEAR_SIGMAS * sigma_a
    clear_b = abs(theta[5] - theta[4]) > distance_b[-1] and theta[7] > _CLEAR_SIGMAS * sigma_b
    if clear_a and clear_b:
        return 0, known_a, known_b
    limit = chi2_of_theta + _HOPELESS_CHI2
    columns = _places(
        yb, gain_b, sigma_b, comb[2], comb[3], theta[4], theta[5], clear_b, profile_b, scratch, across, order_b, 0,
        limit,
    )  # fmt: skip
    if columns == 0:
        return 0, known_a, known_b
    fringe = 2 * math.pi / (comb[0] + 0.5 * (ya.size - 1) * comb[1])
    rows = 0
    for number in range(1 if clear_a else 2 * reach + 1):
        # The middle first; the line leaves the order across it no choice.
        order = (-((number + 1) // 2) if number % 2 else number // 2) / per_fringe
        rows = _places(
            ya, gain_a, sigma_a, comb[0], comb[1], theta[0] + order * fringe, theta[1], clear_a, profile_a, scratch,
            along, order_a, rows, limit - order_b[0, 0],
        )  # fmt: skip
    kappa, count = math.exp(prior[4]), 0
    for m in range(rows):
        for n in range(columns):
            if not order_a[m, 0] + order_b[n, 0] < limit or (m >= _TRIED and n >= _TRIED):
                break
            i, j = int(order_a[m, 1]), int(order_b[n, 1])
            a2, b2 = kappa * along[i, 4], across[j, 4]
            spread = kappa * kappa / along[i, 5] + 1 / across[j, 5] + (prior[6] * max(a2, b2)) ** 2
            chi2 = along[i, 0] + across[j, 0] + (a2 - b2) ** 2 / spread
            if not chi2 < limit:
                continue
            along[i, 6], across[j, 6] = min(along[i, 6], chi2), min(across[j, 6], chi2)
            row[0], row[1], row[2] = chi2, i, j
            count = _insert(found, 0, count, NEARBY, row)
    for n in range(count):
        chi2, i, j = found[n, 0], int(found[n, 1]), int(found[n, 2])
        for m in range(4):
            found[n, m], found[n, 4 + m] = along[i, 1 + m], across[j, 1 + m]
        found[n, 8] = chi2
    known_a = _posterior(along, rows, gain_a, sigma_a, comb[0], comb[1], posterior_a, known_a)
    known_b = _posterior(across, columns, gain_b, sigma_b, comb[2], comb[3], posterior_b, known_b)
    return count, known_a, known_b


@compiled  # pragma: no cover
def _posterior(
    places: Reals, count: int, gain: Reals, sigma: float, omega0: float, step: float, posterior: Reals, known: int
) -> int:  # fmt: skip
    """Append χ², direct place and σ by each place of the bounce to ``posterior``; returns its new length."""
    information = 0.0
    for t in range(gain.size):
        information += (gain[t] / sigma * (omega0 + t * step)) ** 2
    for i in range(count):
        if places[i, 6] < math.inf:
            posterior[known, 0], posterior[known, 1] = places[i, 6], places[i, 1]
            spread = 1 / information + places[i, 7] * places[i, 7] / places[i, 5]
            posterior[known, 2] = math.sqrt(spread) / places[i, 3]
            known += 1
    return known


def workspace(profiles_a: Profiles, profiles_b: Profiles) -> Workspace:
    """Arrays that `nearby` works in; one set a thread."""
    _, count, size = np.maximum(profiles_a.table.shape, profiles_b.table.shape)
    most = (2 * _MOST_REACH + 1) * _PLACES
    return (
        np.empty((most, 8)),
        np.empty((_PLACES, 8)),
        np.empty((most, 2)),
        np.empty((_PLACES, 2)),
        np.empty(2 * count),
        np.empty((2, size), np.float32),
        np.empty((2, size), np.float32),
        np.empty(3),
        # Of three calls, two of which reach one step to either side.
        np.empty((most + 6 * _PLACES, 3)),
        np.empty((3 * _PLACES, 3)),
    )
