"""How well a scan repeats itself while nothing moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calibration.acceptance.figures import Figure, Quantity
from calibration.acceptance.segmentation import Mask
from scanner.result import Maps

_ONE_SCAN = "one scan only: repeatability takes two or more of the same place"


def repeatability(
    title: str, scans: Sequence[Maps], region: Mask, lengths: Sequence[tuple[float, float]]
) -> list[Figure]:
    """Standard deviations over repeated scans of one place.

    Parameters
    ----------
    title
        Of the artefact.
    scans
        One or more.
    region
        (H, W) bool, the artefact's pixels.
    lengths
        Of each scan the measured diameter or spacing and its standard uncertainty by noise, mm; empty for artefacts
        without a length.

    Returns
    -------
    The repeatability of a point (pooled standard deviation of the distance along the viewing ray, over all pixels that
    every scan measured), and that of the length where there is one. The uncertainty of a standard deviation s with ν
    degrees of freedom is s/√(2ν).
    """
    quantities = [Quantity.REPEATABILITY, *([Quantity.REPEATABILITY_LENGTH] if lengths else [])]
    if len(scans) < 2:
        return [Figure(q, title, None, note=_ONE_SCAN) for q in quantities]
    figures = [_of_points(title, scans, region)]
    if lengths:
        values, u = (np.array(column) for column in zip(*lengths, strict=True))
        spread, dof = float(values.std(ddof=1)), len(values) - 1
        expected = float(np.sqrt(np.mean(u**2)))
        figures.append(
            Figure(
                Quantity.REPEATABILITY_LENGTH,
                title,
                spread,
                {"few repetitions": spread / math.sqrt(2 * dof)},
                noise_mm=expected,
                noise_std_mm=expected / math.sqrt(2 * dof),
                note=f"{len(values)} scans",
            )
        )
    return figures


def _of_points(title: str, scans: Sequence[Maps], region: Mask) -> Figure:
    everywhere = region.copy()
    for maps in scans:
        assert maps.points is not None
        everywhere &= np.isfinite(maps.points[..., 2])
    if not everywhere.any():
        return Figure(Quantity.REPEATABILITY, title, None, note="no pixel of the artefact has a point in every scan")
    distance = np.stack([np.linalg.norm(m.points[everywhere].astype(np.float64), axis=1) for m in scans])  # type: ignore[index]
    variance = np.mean([np.square(m.sigma_point[everywhere], dtype=np.float64) for m in scans])  # type: ignore[index]
    spread = float(np.sqrt(distance.var(axis=0, ddof=1).mean()))
    dof = distance.shape[1] * (len(scans) - 1)
    expected = float(np.sqrt(variance))
    return Figure(
        Quantity.REPEATABILITY,
        title,
        spread,
        {"few repetitions": spread / math.sqrt(2 * dof)},
        points=distance.shape[1],
        noise_mm=expected,
        noise_std_mm=expected / math.sqrt(2 * dof),
        note=f"{len(scans)} scans, along the viewing ray",
    )
