"""Sequences of several frequencies, one frame each: they are right if their codes are those of projector columns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers import NoiseModel
from scanner.integrity.findings import Finding
from scanner.integrity.sampling import Grid
from scanner.integrity.waveform import FEWEST, Waveform
from scanner.patterns import FringeSequence

_MISFIT, _FITS = 8.0, 3.0
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
    Where harmonics spoil all codes alike, no single frame is to blame, and none is named.
    """
    pixels = np.flatnonzero(waveform.usable)
    if pixels.size < FEWEST:
        return []
    pixels = pixels[:: max(1, pixels.size // _ASKED)]
    count = len(fringes.fringes)
    bands = [pixels] + [b for b in np.array_split(pixels, 8) if b.size >= _FEWEST_OF_BAND]

    def misfits(left_out: int | None) -> list[float]:
        kept = [n for n in range(count) if n != left_out]
        found = _misfit(
            values[kept][:, pixels],
            FringeSequence(fringes.axis, tuple(fringes.fringes[n] for n in kept)),
            extent,
            waveform.sigma_dn,
        )
        return [float(np.median(found[np.isin(pixels, band)])) for band in bands]

    together = misfits(None)
    if max(together) < _MISFIT:
        return []
    first_single = next(n for n, f in enumerate(fringes.fringes) if f.frequency != fringes.fringes[0].frequency)
    found = []
    for n in range(first_single, count):
        for band, whole, without in zip(bands, together, misfits(n), strict=True):
            if whole > _MISFIT and without < _FITS and whole > 8 * without:
                rows = cells.rows_px[band]
                where = "" if band is pixels else f" in rows {int(rows.min()) + 1} to {int(rows.max()) + 1}"
                found.append(
                    Finding(n, f"frame {n + 1} does not fit the code of the others{where}: stale, torn or mixed")
                )
                break
    return found


def _misfit(values: NDArray[np.float32], fringes: FringeSequence, extent: int, sigma_dn: float) -> NDArray[np.float32]:
    from scanner.methods.gupta_nayar import nearest_code

    c, _, _ = nearest_code(values[:, None], fringes, extent, NoiseModel(sigma_dn))  # type: ignore[arg-type]
    return np.asarray((c.chi2 / np.float32(c.dof))[0])
