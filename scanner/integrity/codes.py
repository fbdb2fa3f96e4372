"""Sequences of several frequencies, one frame each: they are right if their codes are those of projector columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import NoiseModel
from scanner.integrity.code_errors import STEPS, Codes, code_errors
from scanner.integrity.findings import Finding
from scanner.integrity.sampling import Grid
from scanner.integrity.waveform import FEWEST, Waveform
from scanner.patterns import FringeSequence
from scanner.unwrapping import Coordinates

_WHOLE, _PART = (1.6, 1.2, 1.5), (5.0, 1.5, 5.0)
_SAME_PICTURE, _OTHER_PICTURE = 1.5, 4.0
_ASKED = 2_000
_FEWEST_OF_BAND = 40


def wrong_codes(
    values: NDArray[np.float32], fringes: FringeSequence, extent: int, waveform: Waveform, cells: Grid
) -> list[Finding]:
    """Frames without which the codes fit, and with which they do not, everywhere or in some rows.

    Parameters
    ----------
    values
        (N, P) grey values; the frames before the first of another frequency are the steps of ``waveform``.
    extent
        Projector pixels along the axis.

    Notes
    -----
    Where no single frame is to blame, either harmonics spoil all codes alike, which is a property of the projector and
    is let pass, or several frames are wrong.
    """
    pixels = np.flatnonzero(waveform.usable)
    if pixels.size < FEWEST:
        return []
    pixels = pixels[:: max(1, pixels.size // _ASKED)]
    count = len(fringes.fringes)
    bands = [pixels] + [b for b in np.array_split(pixels, 8) if b.size >= _FEWEST_OF_BAND]

    def misfits(left_out: int | None) -> list[float]:
        kept = [n for n in range(count) if n != left_out]
        c = _decoded(values, fringes, kept, extent, waveform.sigma_dn, pixels)
        found = c.chi2[0] / c.dof
        return [float(np.median(found[np.isin(pixels, band)])) for band in bands]

    if again := _shown_again(values, fringes, extent, waveform, pixels):
        return again
    together = misfits(None)
    # In a part of the picture many pixels may see two paths of light, which fit no code either.
    limits = [_WHOLE] + [_PART] * (len(bands) - 1)
    found = []
    for n in range(STEPS, count) if any(t > limit for t, (limit, _, _) in zip(together, limits, strict=True)) else ():
        for band, whole, without, (misfit, fits, better) in zip(bands, together, misfits(n), limits, strict=True):
            if whole > misfit and without < fits and whole > better * without:
                rows = cells.rows_px[band]
                where = "" if band is pixels else f" in rows {int(rows.min()) + 1} to {int(rows.max()) + 1}"
                found.append(
                    Finding(n, f"frame {n + 1} does not fit the code of the others{where}: stale, torn or mixed")
                )
                break
    if found:
        return found
    everything = _decoded(values, fringes, list(range(count)), extent, waveform.sigma_dn, pixels)
    return code_errors(Codes.of(values[:, pixels], fringes, everything, waveform.sigma_dn))


def _shown_again(
    values: NDArray[np.float32], fringes: FringeSequence, extent: int, waveform: Waveform, pixels: NDArray[np.intp]
) -> list[Finding]:
    """Frames that are the one before them but for the noise, where the patterns should have differed."""
    found = []
    noise = np.sqrt(2) * waveform.sigma_dn
    for n in range(1, len(fringes.fringes)):
        seen = np.sqrt(np.square(values[n, pixels] - values[n - 1, pixels]).mean())
        if seen > _SAME_PICTURE * noise:
            continue
        # Where the pixels lie, the others tell: two frequencies may be alike over all of a small object.
        kept = [k for k in range(len(fringes.fringes)) if k < STEPS or k not in (n - 1, n)]
        c = _decoded(values, fringes, kept, extent, waveform.sigma_dn, pixels)
        now, before = (
            np.cos(2 * np.pi * f.frequency * c.u[0] + f.step_rad) for f in (fringes.fringes[n], fringes.fringes[n - 1])
        )
        if np.sqrt(np.square(c.amplitude[0] * (now - before)).mean()) > _OTHER_PICTURE * noise:
            found.append(Finding(n, f"frame {n + 1} shows the pattern of frame {n} again: a stale frame"))
    return found


def _decoded(
    values: NDArray[np.float32],
    fringes: FringeSequence,
    kept: list[int],
    extent: int,
    sigma_dn: float,
    pixels: NDArray[np.intp],
) -> Coordinates:
    from scanner.methods.gupta_nayar import nearest_code

    part = FringeSequence(fringes.axis, tuple(fringes.fringes[n] for n in kept))
    frames: Any = values[kept][:, None, pixels]
    return nearest_code(frames, part, extent, NoiseModel(sigma_dn)).coordinates
