"""The figures that show maps: what each shows, on which scale, and what to look for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.report.figures import Scale, fitted, outline, picture, png, shrink
from scanner.report.surface import LocalPlanes, median
from scanner.report.wording import figure, grid, length, number, per_cent, section, table
from scanner.result import Flag, Maps

Array = NDArray[Any]

# In the order of painting: where a pixel carries several, the last one shows.
_FLAGS: tuple[tuple[Flag, str, str], ...] = (
    (Flag.RIPPLE, "#8fc7a6", "a bounce too weak for a pixel was taken off"),
    (Flag.INTERREFLECTION, "#f2a5a5", "a bounce was detected in round one"),
    (Flag.SECOND_ROUND, "#2f9e62", "measured in round two"),
    (Flag.SEPARATED, "#3a80c9", "from the two-path separation of round one"),
    (Flag.DEPTH_EDGE, "#7d5fb8", "mixes two surfaces at a depth edge"),
    (Flag.STRAY, "#b0568f", "refused: hardly any neighbour goes on with it"),
    (Flag.BLIND, "#6b2f6b", "refused: at a fold, where bounces come from too near to be seen"),
    (Flag.OUT_OF_VOLUME, "#8d6e46", "refused: outside the projector picture, or not in front of the rig"),
    (Flag.OFF_EPIPOLAR, "#d3a21a", "refused: (x, y) does not lie on the pixel's epipolar line"),
    (Flag.MISFIT, "#e25a2c", "refused: the fringes do not fit one path"),
    (Flag.THIRD_PATH, "#a8481c", "sees more than two light paths"),
    (Flag.NOT_LIT, "#12456b", "round two did not light this place"),
    (Flag.INCOMPLETE, "#b9bdc3", "the recording ended before this pixel was decided"),
    (Flag.LOW_MODULATION, "#3b4048", "too little fringe modulation: shadow, black surface, background"),
    (Flag.SATURATED, "#ff3fa4", "at full scale in at least one frame"),
)
_CLEAN = "#cfe5da"


def has(flags: NDArray[np.uint16], some: Flag) -> NDArray[np.bool_]:
    """Tell where at least one of ``some`` is set."""
    return np.asarray((flags & np.uint16(some)) != 0)


@dataclass(frozen=True)
class _Plate:
    """A map reduced to the size of its picture, with the scale that paints it."""

    key: str
    title: str
    small: NDArray[np.float32]
    scale: Scale

    def figure(self, caption: str, region: NDArray[np.bool_] | None = None, *, bar: bool = True) -> str:
        """Make the figure, with ``region`` (at any size) outlined in red."""
        size = self.small.shape[1], self.small.shape[0]
        alt = f"{self.title.replace('<sub>', '').replace('</sub>', '')}: map of {size[0]} by {size[1]} px"
        if bar:
            alt += f", colours from {self.scale.low:.4g} to {self.scale.high:.4g} {self.scale.unit}"
        content = picture(self.scale.png(self.small), size, alt, "" if region is None else outline(region, size))
        return figure(self.key, self.title, content + (self.scale.bar() if bar else ""), caption)


def _plate(key: str, title: str, values: Array, colormap: str, unit: str, *, logarithmic: bool = False) -> _Plate:
    small = shrink(values)
    return _Plate(key, title, small, Scale.of(small, colormap, unit, logarithmic=logarithmic))


def _signed(key: str, title: str, values: Array, unit: str, reach: float) -> _Plate:
    """Paint a map about zero, blue below and red above, out to ± ``reach``."""
    return _Plate(key, title, shrink(values), Scale("RdBu_r", -reach, reach, unit))


def round_one(maps: Maps) -> str:
    """Show the fringes' modulation, its variation with the detected region, and the misfit of one path."""
    figures = [
        _plate("modulation", "Modulation B", maps.modulation, "viridis", "DN").figure(
            "Amplitude of the fringes. Where it is low, σ is large; a sudden drop on a smooth surface is a shadow."
        )
    ]
    if maps.variation is not None:
        title = "Variation B<sub>v</sub> over the frequencies"
        figures.append(
            _plate("variation", title, maps.variation, "gray", "DN").figure(
                "One light path gives the same modulation at every frequency. Where two paths meet it varies: the "
                "detected bounce region is outlined in red. Bright texture outside the outline is a miss.",
                maps.interreflection,
            )
        )
    unit = "χ² per degree of freedom, logarithmic"
    figures.append(
        _plate("misfit", "Misfit χ²/ν of one path", maps.misfit, "magma", unit, logarithmic=True).figure(
            "About 1 where one path and the noise model explain the fringes. Well above 1: a bounce, a depth edge, "
            "motion, or more noise than the model has."
        )
    )
    return grid("Round one", figures)


def round_two(maps: Maps) -> str:
    """Show what round two lit and photographed, and what it changed in the region."""
    figures = []
    if maps.regional_pattern is not None:
        figures.append(
            _plate("regional", "Round two as captured", maps.regional_pattern, "gray", "DN").figure(
                "A pattern of round two. Inside the red line there should be clean fringes; the places that threw "
                "light into it in round one should be dark.",
                maps.interreflection,
            )
        )
    if maps.lit is not None:
        turns = 0 if maps.lit_by is None else int(maps.lit_by.max()).bit_length()
        lit = _Plate("lit", "Lit projector pixels", shrink(maps.lit.astype(np.uint8)), Scale("gray", 0, 1))
        figures.append(
            lit.figure(
                f"Projector picture, not camera: round two lit {per_cent(float(maps.lit.mean()))} of it (white)"
                + (f" in {turns} sequences, since places of the region light each other" if turns > 1 else "")
                + ". Only places whose direct light falls into the region should be lit.",
                bar=False,
            )
        )
    if maps.x_p is not None and maps.x_p_round1 is not None:
        figures.append(_change("x", maps.x_p, maps.x_p_round1, maps.interreflection))
    elif maps.y_p is not None and maps.y_p_round1 is not None:
        figures.append(_change("y", maps.y_p, maps.y_p_round1, maps.interreflection))
    return grid("Round two", figures)


def _change(axis: str, fused: Array, first: Array, region: NDArray[np.bool_]) -> str:
    """Show what the region's treatment changed, cut out around the region."""
    change = np.where(region, fused - first, np.nan)
    moved = np.abs(change[np.isfinite(change)])
    reach = max(float(np.percentile(moved, 99)), 0.05) if moved.size else 1.0
    some, far = (per_cent(float((moved > limit).mean())) if moved.size else "–" for limit in (0.5, 8))
    rows, columns = window_around(region)
    title = f"{axis}<sub>p</sub> fused minus round one"
    return _signed(f"change-{axis}", title, change[rows, columns], "px", reach).figure(
        f"What one path would have got wrong in the region, cut out: {some} of it moved by more than 0.5 px, {far} by "
        "more than 8 px. Stripes of whole fringes are the errors that a bounce makes."
    )


def window_around(region: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns around ``region`` with some air, in the aspect of the picture; all of it where it is empty."""
    height, width = region.shape
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    if rows.size == 0:
        return slice(0, height), slice(0, width)
    scale = min(1.0, 1.15 * max((np.ptp(rows) + 1) / height, (np.ptp(columns) + 1) / width))
    window = []
    for found, extent in ((rows, height), (columns, width)):
        side = max(1, round(scale * extent))
        first = int(np.clip((found[0] + found[-1] + 1 - side) // 2, 0, extent - side))
        window.append(slice(first, first + side))
    return window[0], window[1]


def coordinates(maps: Maps) -> str:
    """Show the projector coordinates and how well the two axes agree."""
    figures = []
    for axis, values, along in (("x", maps.x_p, "columns"), ("y", maps.y_p, "rows")):
        if values is not None:
            title = f"Projector coordinate {axis}<sub>p</sub>"
            figures.append(
                _plate(f"{axis}_p", title, values, "viridis", "px").figure(
                    f"Which of the projector's {along} each pixel sees. It runs smoothly over a smooth surface: a jump "
                    "without an edge is a wrong fringe."
                )
            )
    if maps.epipolar_px is not None:
        title, unit = "Distance from the epipolar line", "px, logarithmic"
        figures.append(
            _plate("epipolar", title, np.abs(maps.epipolar_px), "viridis", unit, logarithmic=True).figure(
                "(x, y) of a true point lies on its line within noise. A smooth pattern over the whole field says that "
                "the rig has moved since its calibration."
            )
        )
    return grid("Coordinates", figures)


def precision(maps: Maps, planes: LocalPlanes | None) -> str:
    """Show depth, predicted σ, and how far the points lie from local planes."""
    figures = []
    if maps.depth is not None:
        figures.append(
            _plate("depth", "Depth z", maps.depth, "cividis", "mm").figure(
                "Distance along the camera's axis. Grey is not measured; the flags say why."
            )
        )
    if maps.sigma_point is not None:
        sigma = _plate(
            "sigma", "Predicted σ of a point", maps.sigma_point, "viridis", "mm, logarithmic", logarithmic=True
        )
        figures.append(
            sigma.figure(
                "One standard deviation along the viewing ray, from fringe modulation and camera noise through the rig."
            )
        )
    else:
        for axis, values in (("x", maps.sigma_x), ("y", maps.sigma_y)):
            if values is not None:
                title = f"Predicted σ of {axis}<sub>p</sub>"
                figures.append(
                    _plate(f"sigma_{axis}", title, values, "viridis", "px, logarithmic", logarithmic=True).figure(
                        "One standard deviation of the projector coordinate, from fringe modulation and camera noise."
                    )
                )
    if planes is not None:
        spread, reach = 1.4826 * median(np.abs(planes.residual)), _robust_reach(planes.residual)
        factor, unit = (1000.0, "µm") if reach < 0.5 else (1.0, "mm")
        neighbours = "px" if planes.stride == 1 else f"px, every {number(planes.stride)}th"
        figures.append(
            _signed("residual", "Distance from the local plane", planes.residual * factor, unit, reach * factor).figure(
                f"Each point against a robust plane through {planes.window} × {planes.window} {neighbours}, less the "
                f"curvature there; robust σ {length(spread)}. Grain is noise. Ripples along the fringes are a phase "
                "error; steps are wrong fringes."
            )
        )
    return grid("Depth and precision", figures)


def _robust_reach(values: Array) -> float:
    """Span three robust standard deviations about zero: noise stays visible beside outliers."""
    spread = 3 * 1.4826 * median(np.abs(values))
    return spread if spread > 0 else 1e-3


def flags(maps: Maps) -> str:
    """Show why each pixel is as it is, with counts."""
    size = fitted(maps.flags.shape)
    small = np.asarray(cv2.resize(maps.flags, size, interpolation=cv2.INTER_NEAREST), np.uint16)
    indices, palette = np.zeros(small.shape, np.uint8), np.zeros((256, 3), np.uint8)
    palette[0] = _rgb(_CLEAN)
    found = [(_CLEAN, "no remark", int((maps.flags == 0).sum()), "one path, one round")]
    for index, (flag, colour, meaning) in enumerate(_FLAGS, start=1):
        indices[has(small, flag)] = index
        palette[index] = _rgb(colour)
        name = str(flag.name).lower().replace("_", " ")
        found.append((colour, name, int(np.count_nonzero(has(maps.flags, flag))), meaning))
    plate = picture(png(indices, palette), size, "Map of the flag of each pixel; the table beside it has the counts")
    rows = [
        ("", (f'<i style="background:{colour}"></i>{name}', number(n), per_cent(n / maps.flags.size), meaning))
        for colour, name, n, meaning in found
    ]
    caption = "A pixel may carry several flags; the one lowest in the table shows."
    return section(
        "Flags",
        '<div class="beside">'
        + figure("flag-map", "Why each pixel is as it is", plate, caption)
        + table("flags", ("Flag", "Pixels", "Share", "Meaning"), rows)
        + "</div>",
    )


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
