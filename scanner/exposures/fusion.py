"""Several exposures of one pixel into one value of greater range.

Grey value I_k = black + e_k Φ + noise, with e_k in units of the bench's own exposure. Under Gaussian noise the
maximum-likelihood Φ is the mean of I_k / e_k weighted by e_k² / var(I_k), and its variance is one over the sum of these
weights (Robertson, Borman & Stevenson, J. Electron. Imaging 12(2), 219 (2003), with the noise of the camera in place of
their weights; Granados et al., CVPR 2010).

A pixel's weights are the same for all frames of a round, for two reasons. Whether an exposure saturates is asked of the
round as a whole: one that was left out of single frames, which are those of one phase, would bend the phase. And what
all frames share, a black level or an error of an exposure, then changes mean and modulation of a pixel, but no phase.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel, Pixels
from scanner import kernels
from scanner.exposures.linearity import LightRatio
from scanner.exposures.passes import ExposurePass
from scanner.exposures.series import ExposureSeries
from scanner.methods import Method, RoundFrames
from scanner.patterns import Plan

_LINEAR = 0.02
"""How far the light of two exposures may be from what their times say, as a share."""


class Source(Protocol):
    """Where recorded frames come from."""

    def __call__(self, exposure: int, sequence: int) -> Pixels:
        """(N, H, W) frames of a sequence that was recorded."""
        ...


@dataclass(frozen=True)
class FusedFormat(FrameFormat):
    """Format of fused frames: float32, and beyond the range of any exposure where all of them saturate.

    Parameters
    ----------
    range_dn
        Greatest grey value that the shortest exposure can tell, in units of the bench's own.
    """

    range_dn: float

    @property
    def dtype(self) -> np.dtype[Any]:
        """The NumPy type of a pixel."""
        return np.dtype(np.float32)

    @property
    def saturated_dn(self) -> int:
        """The value of pixels that are saturated in all exposures."""
        return int(self.range_dn) + 2


@dataclass(frozen=True)
class FusedNoise(NoiseModel):
    """Noise of fused frames: every pixel has its own, for each has its own exposures.

    Parameters
    ----------
    pixels
        (H, W) variance of a frame, DN² in units of the bench's own exposure. ``read_dn`` and ``dn_per_electron`` are
        those of a single frame.
    """

    pixels: NDArray[np.float32] = field(kw_only=True, repr=False, compare=False)

    def variance(self, mean_dn: NDArray[np.float32] | float) -> Any:
        """Variance (DN²) of fused frames in the shape of ``mean_dn``, of which nothing else is used any more.

        Raises
        ------
        ValueError
            ``mean_dn`` is not of the whole picture, (H, W) or flat.
        """
        if np.size(mean_dn) != self.pixels.size:
            raise ValueError(f"the noise of {self.pixels.size} fused pixels was asked for {np.size(mean_dn)} of them")
        return self.pixels.reshape(np.shape(mean_dn))


@dataclass(frozen=True)
class Fused:
    """One round after its exposures were fused.

    Parameters
    ----------
    frames
        What the method has collected of the fused frames.
    noise
        Of these.
    warnings
        Sentences for the operator.
    figures
        For each exposure, JSON-ready: ``exposure_s``, ``relative``, the share of pixels that are measured with it
        (``used_share``) and that saturate in it (``saturated_share``), and ``measured_relative``, what its light says;
        None where it shares too few pixels with the next.
    """

    frames: RoundFrames
    noise: FusedNoise
    warnings: list[str]
    figures: list[dict[str, Any]]


@dataclass(frozen=True)
class Weights:
    """How much each exposure counts in each pixel.

    Parameters
    ----------
    gain
        (E, H, W) what grey values are multiplied by; the weight over e_k, 0 where an exposure is left out.
    variance
        (H, W) of the sum, DN²; that of the reference where nothing is left.
    dead
        (H, W) bool, pixels that saturate in all exposures.
    """

    gain: NDArray[np.float32]
    variance: NDArray[np.float32]
    dead: NDArray[np.bool_]


def weigh(passes: Sequence[ExposurePass], relative: Sequence[float], noises: Sequence[NoiseModel]) -> Weights:
    """Inverse-variance weights of all pixels.

    A pixel is not taken from an exposure in which it comes near saturation, unless there is no other.

    Parameters
    ----------
    passes, relative, noises
        Of each exposure: where it saturates and its mean; e_k; the noise of its frames.
    """
    shape = passes[0].saturated.shape
    clear = np.logical_or.reduce([~p.bright for p in passes])
    used = [np.where(clear, ~p.bright, ~p.saturated) for p in passes]
    dead = ~np.logical_or.reduce(used)
    light = np.zeros(shape, np.float32)
    # Shortest first, so that the longest which is good has the last word.
    for k in np.argsort(relative):
        np.copyto(light, passes[k].mean / np.float32(relative[k]), where=used[k])
    gain = np.zeros((len(passes), *shape), np.float32)
    information = np.zeros(shape, np.float32)
    for k, (e, noise) in enumerate(zip(relative, noises, strict=True)):
        precision = np.where(used[k], np.float32(e) ** 2 / noise.variance(np.float32(e) * light), 0)
        information += precision
        gain[k] = precision / np.float32(e)
    variance = 1 / np.where(dead, 1 / noises[0].variance(0.0), information)
    gain *= variance
    return Weights(gain, np.asarray(variance, np.float32), dead)


def fuse(
    method: Method,
    plan: Plan,
    series: ExposureSeries,
    passes: Sequence[ExposurePass],
    read: Source,
    noise_of: Callable[[int, RoundFrames], NoiseModel],
) -> Fused:
    """Fuse the exposures of a round and have the method collect the result, one sequence at a time.

    Exposures of which sequences are missing are left out; where no exposure is whole, the one that has most of them is
    all that is taken.

    Parameters
    ----------
    method, plan, series
        What was projected and how often.
    passes
        Of each exposure, in the order of the series.
    read
        Reads the frames again.
    noise_of
        Noise model of the frames of one exposure, by its number and its pass.
    """
    whole = [k for k, p in enumerate(passes) if p.complete]
    chosen = whole or [max(range(len(passes)), key=lambda k: len(passes[k].added))]
    warnings = [
        f"{series.label(k)}: {len(p.added)} of {len(plan.sequences)} sequences are there; "
        + ("it is all there is" if k in chosen else "it is left out")
        for k, p in enumerate(passes)
        if not p.complete
    ]
    kept, relative = [passes[k] for k in chosen], [series.relative[k] for k in chosen]
    noises = [noise_of(k, passes[k]) for k in chosen]
    weights = weigh(kept, relative, noises)
    fmt = kept[0].frame_format
    wide = FusedFormat(fmt.width, fmt.height, fmt.bits, fmt.saturated_dn / min(relative))
    collected = method.collect(plan, wide)
    sampled = kept[0].sampled
    ratios = _ratios(kept, relative, noises)
    for sequence in sorted(kept[0].added.intersection(*(p.added for p in kept))):
        frames = np.zeros((len(plan.sequences[sequence]), *fmt.shape), np.float32)
        samples = []
        for exposure, gain in zip(chosen, weights.gain, strict=True):
            raw = read(exposure, sequence)
            _add_weighted(frames, raw, gain)
            samples.append(raw[:, *sampled].reshape(len(raw), -1).astype(np.float32))
            del raw
        for (longer, shorter), ratio in ratios.items():
            ratio.add(samples[longer], samples[shorter])
        frames[:, weights.dead] = wide.saturated_dn
        collected.add(sequence, cast(Pixels, frames))
    for (longer, shorter), ratio in ratios.items():
        if abs(ratio.measured * relative[longer] / relative[shorter] - 1) > _LINEAR:
            warnings.append(_not_linear(series, chosen[longer], chosen[shorter], ratio.measured))
    reference = int(np.argmin(np.abs(np.log(relative))))
    measured = dict(zip(chosen, _chained(reference, relative, ratios), strict=True))
    figures = [
        {
            "exposure_s": series.made_s[k],
            "relative": series.relative[k],
            "used_share": float((weights.gain[chosen.index(k)] > 0).mean()) if k in chosen else 0.0,
            "saturated_share": float(p.saturated.mean()) if p.added else None,
            "measured_relative": measured.get(k),
        }
        for k, p in enumerate(passes)
    ]
    nearest = noises[reference]
    noise = FusedNoise(nearest.read_dn, nearest.dn_per_electron, pixels=weights.variance)
    return Fused(collected, noise, warnings, figures)


def _add_weighted(total: NDArray[np.float32], frames: Pixels, gain: NDArray[np.float32]) -> None:
    """Add (N, H, W) ``frames`` times (H, W) ``gain`` to ``total``."""

    def rows(start: int, stop: int) -> None:
        for n in range(len(frames)):
            total[n, start:stop] += gain[start:stop] * frames[n, start:stop]

    kernels.over_rows(rows, gain.shape[0])


def _ratios(
    passes: Sequence[ExposurePass], relative: Sequence[float], noises: Sequence[NoiseModel]
) -> dict[tuple[int, int], LightRatio]:
    """For each exposure and the next shorter one, by their numbers, what compares their light."""
    sampled = passes[0].sampled
    found = {}
    for longer, shorter in pairwise(np.argsort(relative)[::-1].tolist()):
        good = ~(passes[longer].bright | passes[shorter].bright)[sampled].ravel()
        mean = passes[longer].mean[sampled].ravel()
        variance = np.broadcast_to(np.asarray(noises[longer].variance(mean), np.float32), mean.shape)
        found[longer, shorter] = LightRatio(good, variance)
    return found


def _chained(
    reference: int, relative: Sequence[float], ratios: Mapping[tuple[int, int], LightRatio]
) -> list[float | None]:
    """Light of every exposure in units of the bench's own, by the measured ratios; None where one is not known."""
    found: list[float | None] = [None] * len(relative)
    found[reference] = relative[reference]
    pairs = list(ratios.items())
    for (longer, shorter), ratio in pairs:
        known = found[longer]
        if known is not None and np.isfinite(ratio.measured):
            found[shorter] = known * ratio.measured
    for (longer, shorter), ratio in reversed(pairs):
        known = found[shorter]
        if known is not None and found[longer] is None and np.isfinite(ratio.measured):
            found[longer] = known / ratio.measured
    return found


def _not_linear(series: ExposureSeries, longer: int, shorter: int, told: float) -> str:
    return (
        f"{series.label(shorter)} gives {told:.3f} of the light of {1e3 * series.made_s[longer]:.4g} ms, not "
        f"{series.made_s[shorter] / series.made_s[longer]:.3f}: the camera does not respond linearly (a gamma is set, "
        "or the light flickers), or its exposure is not what it says; modulation and σ are off by as much"
    )
