"""Evidence for weak bounces, pooled over neighbours (method.md §4).

What a one-path fit leaves of a pixel's phasors, turned back by the phase of the fitted path, is noise or the second
path: ``e_t = a₂ e^{i2πf_t Δu}`` less what the fit took. From pixel to pixel Δu changes, and with it the phase of e, but
on a smooth surface it changes evenly: inside a small window the residuals are the samples of a plane wave with one
unknown vector over t,

    e_t(p) ≈ s_t e^{i k·p} + noise,   k = 2πf ∇Δu, nearly the same for all frequencies.

The Fourier transform of a window collects such a wave in one bin (the generalised likelihood ratio test for a signal
linear in its unknown amplitudes: Kay, *Fundamentals of Statistical Signal Processing II: Detection Theory*, §7.6): of M
pixels, M times the power of one against the same noise. Adding χ² of the pixels, which forgets the phases, gains √M.

Where a window's strongest bin is beyond noise, its wave predicts every pixel. A pixel's evidence is the log-likelihood
ratio of that prediction (made without the pixel itself, so that clean pixels gain nothing by chance) against noise. It
belongs to the single pixel and keeps borders sharp; `scanner.labelling` joins it.
"""

from scanner.pooling.evidence import Pooled, compile_all, pool, single_pixel_evidence
from scanner.pooling.residuals import Residuals, one_path_residuals
from scanner.pooling.spectra import Spectra
from scanner.pooling.windows import WINDOW

__all__ = [
    "WINDOW",
    "Pooled",
    "Residuals",
    "Spectra",
    "compile_all",
    "one_path_residuals",
    "pool",
    "single_pixel_evidence",
]
