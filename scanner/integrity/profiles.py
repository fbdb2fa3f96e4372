"""Sequences that show no fringes: what a binary pattern and its inverse tell, whatever the projector's response is.

Where a pattern lights, its inverse is dark: both together are the same light for every pair of a sequence, between its
brightest and its darkest level even where the optics blur an edge. A frame that is stale, torn, mixed or in another
light spoils the sum of its pair. This is weaker than what phase steps tell: a pattern that changed places with its
inverse, or pairs in another order, leave all sums as they are.
"""

from __future__ import annotations

import itertools

import numpy as np

from drivers import Pixels
from scanner.integrity.findings import SEQUENCE, Finding
from scanner.integrity.sampling import grid, unsaturated
from scanner.integrity.waveform import FEWEST
from scanner.patterns import ProfileSequence

_LIT_DN = 8.0
"""Contrast from which a pixel is asked: well above any camera's noise."""

_WRONG = 0.15
"""Of the contrast: an error of a pair's sum, in the mean over some rows, that is believed."""

_MORE_THAN_NOISE = 3.0
"""The error must also be so many times what the pairs of the sequence show among themselves."""

_BANDS = 8

ONLY_REPEATS = "no pattern has its inverse: only repeated frames would show"
NO_ORDER = "pairs in another order, and a pattern that changed places with its inverse, would not show"


def inverse_pairs(sequence: ProfileSequence) -> list[tuple[int, int]]:
    """Frames (i, j), i < j, whose patterns are binary and each other's inverse; every frame is in one pair at most."""
    pairs, taken = [], set()
    for i, first in enumerate(sequence.profiles):
        if i in taken or set(first) - {-1, 1}:
            continue
        inverse = tuple(-v for v in first)
        j = next((k for k in range(i + 1, len(sequence)) if k not in taken and sequence.profiles[k] == inverse), None)
        if j is not None:
            pairs.append((i, j))
            taken |= {i, j}
    return pairs


def check_pairs(frames: Pixels, sequence: ProfileSequence, saturated_dn: int) -> tuple[list[Finding], float, str]:
    """Compare the sums of all pairs of (N, H, W) ``frames``.

    Returns
    -------
    findings, usable, blind_to
        As in `SequenceCheck`.
    """
    pairs = inverse_pairs(sequence)
    if len(pairs) < 3:
        return [], float("nan"), ONLY_REPEATS
    cells = grid(frames.shape[1:])
    values = cells.take_all(frames)
    first, second = (values[[pair[k] for pair in pairs]] for k in (0, 1))
    contrast = np.median(np.abs(first - second), axis=0)
    total = first + second
    usable = unsaturated(values, saturated_dn) & (contrast > _LIT_DN)
    if np.count_nonzero(usable) < FEWEST:
        return [], float(usable.mean()), NO_ORDER
    off = np.abs(total - np.median(total, axis=0))
    findings: dict[int, Finding] = {}
    edges = np.linspace(0, frames.shape[1], _BANDS + 1)
    everywhere = (0.0, float(frames.shape[1]))
    for low, high in (everywhere, *itertools.pairwise(edges)):
        here = usable & (cells.rows_px >= low) & (cells.rows_px < high)
        if np.count_nonzero(here) < FEWEST:
            continue
        error, level = off[:, here].mean(axis=1), float(contrast[here].mean())
        usual = float(np.median(error))
        if usual > _WRONG * level and (low, high) == everywhere:
            what = "the frames are not the planned patterns and their inverses: several are stale, torn or mixed"
            return [Finding(SEQUENCE, what)], float(usable.mean()), NO_ORDER
        where = "" if (low, high) == everywhere else f" in rows {int(low) + 1} to {int(high)}"
        for k in np.flatnonzero((error > _WRONG * level) & (error > _MORE_THAN_NOISE * usual)):
            i, j = pairs[k]
            what = f"frames {i + 1} and {j + 1} are not each other's inverse{where}: one is stale, torn, mixed or dark"
            findings.setdefault(int(k), Finding(j, what))
    return list(findings.values()), float(usable.mean()), NO_ORDER
