"""Where the projector sees a board's points: read from the lit paper around each, never from the print.

A phase is only as good as its light: dark print carries hardly any, and pixels near its edges mix both. So a coordinate
at a point comes from the white paper around it, by a weighted plane through what a smooth surface over the whole board
leaves of the decoded coordinates. The surface (a polynomial of the fifth order in camera pixels) holds perspective and
lenses to 0.01 px or so; the plane holds the rest, and being local it follows a bent board as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.detection.mapping import PlaneMap
from calibration.observations import BoardView, PoseObservation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CLEAR_OF_EDGES_PX = 3.0  # a lens's blur of 0.8 px shifts the light by 0.0004 px there, and by 0.2 px at 1 px
_CLEAR_OF_EDGES_SHARE = 0.12  # of the pitch, where that is less
_WINDOW = 0.5  # of the pitch, from the point: no pixel tells of two points, so that their errors are independent
_LIT_SHARE = 0.4  # of the modulation of white paper nearby; print in black has 0.1 or so
_FEWEST_PIXELS = 24
_ENOUGH_PIXELS = 100  # around a point; where there are fewer, pixels nearer to print are taken as well
_FARTHEST = 1.0  # Mahalanobis distance of a point from its pixels; more is extrapolation
_SURFACE_ORDER = 5
_SURFACE_PIXELS = 20_000
_ROUNDS = 4
_HUBER = 2.5
_TUKEY = 5.0


def observe(
    name: str,
    view: BoardView,
    board: Board,
    x_p: NDArray[np.float32] | None,
    sigma_x: NDArray[np.float32] | None,
    y_p: NDArray[np.float32] | None,
    sigma_y: NDArray[np.float32] | None,
    modulation: NDArray[np.float32],
    valid: Mask | None = None,
) -> PoseObservation:
    """Read the projector coordinates of a board's points.

    Parameters
    ----------
    name
        Of the pose.
    view
        The points in the camera's picture.
    board
        The board.
    x_p, y_p
        (H, W) px, decoded projector columns and rows, NaN where invalid; None for an axis that was not projected.
    sigma_x, sigma_y
        (H, W) px, their standard deviations; None with their axis.
    modulation
        (H, W) DN, amplitude of the fringes.
    valid
        (H, W) False for pixels that must not be used, such as detected inter-reflections; None: all may.

    Returns
    -------
    The observation. ``projector_sigma`` is that of the coordinate at the very place where the point was found: the
    fit's own, times max(1, √(χ²/ν)); how the coordinate moves with that place is ``projector_gradient``. NaN where
    fewer than 24 lit pixels surround a point, or lie to one side of it only.

    Raises
    ------
    ValueError
        No axis, an axis without its σ, or maps of different shapes.
    """
    axes = _checked(x_p, sigma_x, y_p, sigma_y, modulation, valid)
    plane = PlaneMap.fitted(board.points[view.ids, :2], view.xy, 1 / view.sigma) if len(view.ids) >= 4 else None
    projector = np.full((len(view.ids), 2), np.nan)
    sigma = np.full((len(view.ids), 2), np.nan)
    gradient = np.zeros((len(view.ids), 2, 2))
    if plane is not None:
        paper = _white_paper(plane, board, view, modulation.shape)
        first, _ = plane.expanded(board.points[view.ids, :2], board.pitch_mm / 10)
        lit = _lit(paper, modulation, board.pitch_mm * float(np.median(np.linalg.norm(first, axis=1))))
        if valid is not None:
            lit &= valid
        for axis, maps in enumerate(axes):
            if maps is not None:
                projector[:, axis], sigma[:, axis], gradient[:, axis] = _at_points(view, board, first, *maps, lit)
    return PoseObservation(
        name=name,
        ids=view.ids,
        points_board=board.points[view.ids],
        camera=view.xy,
        camera_sigma=np.repeat(view.sigma[:, None], 2, axis=1),
        projector=projector,
        projector_sigma=sigma,
        projector_gradient=gradient,
    )


def _checked(
    x_p: NDArray[np.float32] | None,
    sigma_x: NDArray[np.float32] | None,
    y_p: NDArray[np.float32] | None,
    sigma_y: NDArray[np.float32] | None,
    modulation: NDArray[np.float32],
    valid: Mask | None,
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]] | None, ...]:
    pairs: list[tuple[NDArray[np.float32], NDArray[np.float32]] | None] = []
    for what, u, sigma in (("x_p", x_p, sigma_x), ("y_p", y_p, sigma_y)):
        if (u is None) != (sigma is None):
            raise ValueError(f"{what} and its standard deviation must both be given, or neither")
        pairs.append(None if u is None or sigma is None else (u, sigma))
    given = [maps for pair in pairs if pair is not None for maps in pair]
    if not given:
        raise ValueError("neither x_p nor y_p is given")
    for other in (*given, *(() if valid is None else (valid,))):
        if other.shape != modulation.shape:
            raise ValueError(f"maps must have one shape, not {other.shape} and {modulation.shape}")
    return tuple(pairs)


def _white_paper(plane: PlaneMap, board: Board, view: BoardView, shape: tuple[int, ...]) -> Mask:
    """(H, W) pixels that see white paper and keep clear of print and of the sheet's edge."""
    import cv2

    def drawn(polygons: list[Array]) -> NDArray[np.uint8]:
        canvas = np.zeros(shape, np.uint8)
        for polygon in polygons:
            # cv2.fillPoly takes fixed-point numbers.
            cv2.fillPoly(canvas, [np.rint(plane(polygon) * 256).astype(np.int32)], 1, shift=8)
        return canvas

    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.column_stack((np.cos(turn), np.sin(turn)))
    prints = board.polygons + [circle * radius + (x, y) for x, y, radius in board.discs]
    # Beyond the outermost points the map is a guess: half the margin there is enough.
    width, height = np.array(board.pattern_mm) / 2 + board.margin_mm / 2
    sheet = drawn([np.array([[-width, -height], [width, -height], [width, height], [-width, height]])])
    printed = drawn(prints)
    points = board.points[view.ids, :2]
    first, _ = plane.expanded(points, board.pitch_mm / 10)
    pitch_px = board.pitch_mm * float(np.median(np.linalg.svd(first, compute_uv=False)[:, 1]))
    columns, rows = np.rint(view.xy).astype(np.int64).T
    columns, rows = columns.clip(0, shape[1] - 1), rows.clip(0, shape[0] - 1)
    window = 2 * round(_WINDOW * pitch_px) + 1
    for clear in range(max(1, round(min(_CLEAR_OF_EDGES_PX, _CLEAR_OF_EDGES_SHARE * pitch_px))), 0, -1):
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * clear + 1, 2 * clear + 1))
        paper = (cv2.erode(sheet, disc) > 0) & (cv2.dilate(printed, disc) == 0)
        # The rims around markers may be too narrow to keep that clear of print.
        count = cv2.blur(paper.astype(np.float32), (window, window)) * window**2
        if float(np.median(np.asarray(count)[rows, columns])) >= _ENOUGH_PIXELS:
            break
    return np.asarray(paper)


def _lit(paper: Mask, modulation: NDArray[np.float32], pitch_px: float) -> Mask:
    """White paper that is lit as its surroundings are: shadows and what covers the board fall out."""
    import cv2

    known = paper & np.isfinite(modulation) & (modulation > 0)
    size = 2 * round(pitch_px) + 1
    weight = cv2.blur(known.astype(np.float32), (size, size))
    nearby = cv2.blur(np.where(known, modulation, 0).astype(np.float32), (size, size))
    typical = float(np.median(modulation[known])) if known.any() else np.inf
    # Half of the board's own level keeps a place that is dark all over from being its own measure.
    level = np.maximum(np.asarray(nearby) / np.maximum(weight, 1e-6), typical / 2)
    return np.asarray(known & (modulation > _LIT_SHARE * level))


def _at_points(
    view: BoardView, board: Board, first: Array, u: NDArray[np.float32], sigma: NDArray[np.float32], lit: Mask
) -> tuple[Array, Array, Array]:
    """Coordinates (n,), standard deviations (n,) and gradients (n, 2) of one axis at the points."""
    coordinate, deviation = np.full(len(view.ids), np.nan), np.full(len(view.ids), np.nan)
    gradient = np.zeros((len(view.ids), 2))
    rows, columns = np.nonzero(lit & np.isfinite(u) & (sigma > 0) & np.isfinite(sigma))
    if len(rows) < _FEWEST_PIXELS:
        return coordinate, deviation, gradient
    surface = _Surface.fitted(columns, rows, u[rows, columns], sigma[rows, columns])
    if surface is None:
        return coordinate, deviation, gradient
    rest = u[rows, columns] - surface(columns, rows)
    whole = np.full(u.shape, np.nan)
    whole[rows, columns] = rest
    at_points, slopes = surface(*view.xy.T), surface.slopes(*view.xy.T)
    half = _WINDOW * board.pitch_mm
    inverse = np.linalg.inv(first)
    reach = np.ceil(half * np.abs(first).sum(axis=2)).astype(int)
    for i, (x, y) in enumerate(view.xy):
        left, top = max(0, round(x) - reach[i, 0]), max(0, round(y) - reach[i, 1])
        window = np.s_[top : max(0, round(y) + reach[i, 1] + 1), left : max(0, round(x) + reach[i, 0] + 1)]
        row, column = np.nonzero(np.isfinite(whole[window]))
        dx, dy = column + left - x, row + top - y
        near = (np.abs(inverse[i] @ np.stack((dx, dy))) <= half).all(axis=0)
        row, column, dx, dy = row[near], column[near], dx[near], dy[near]
        found = _local(dx, dy, whole[window][row, column], sigma[window][row, column])
        if found is not None:
            offset, variance, slope = found
            coordinate[i], deviation[i], gradient[i] = at_points[i] + offset, np.sqrt(variance), slopes[i] + slope
    return coordinate, deviation, gradient


def _local(dx: Array, dy: Array, rest: Array, sigma: Array) -> tuple[float, float, Array] | None:
    """Value, variance and slope at (0, 0) of a plane by Tukey's weights; None where pixels do not determine it."""
    # The first guess must not be led astray by wrong fringe orders.
    is_kept = np.abs(rest - np.median(rest)) < np.maximum(20 * sigma, 1.0) if len(rest) else np.zeros(0, bool)
    dx, dy, rest, sigma = dx[is_kept], dy[is_kept], rest[is_kept], sigma[is_kept]
    if len(rest) < _FEWEST_PIXELS:
        return None
    design = np.column_stack((np.ones_like(dx), dx, dy)) / sigma[:, None]
    weight = np.ones_like(rest)
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(design * root[:, None], rest / sigma * root, rcond=None)[0]
        residual = rest / sigma - design @ solution
        spread = max(1.0, 1.4826 * float(np.median(np.abs(residual))))
        weight = np.clip(1 - (residual / (_TUKEY * spread)) ** 2, 0, None) ** 2
    used = weight > 0
    if used.sum() < _FEWEST_PIXELS:
        return None
    place = np.column_stack((dx[used], dy[used]))
    middle = place.mean(axis=0)
    spread_of_place = np.cov(place.T) + 1e-6 * np.eye(2)
    if middle @ np.linalg.solve(spread_of_place, middle) > _FARTHEST**2:
        return None
    freedom = max(weight.sum() - 3, 1.0)
    misfit = max(1.0, float((weight * residual**2).sum() / freedom))
    covariance = np.linalg.inv((design * weight[:, None]).T @ design) * misfit
    return float(solution[0]), float(covariance[0, 0]), solution[1:]


@dataclass(frozen=True, eq=False)
class _Surface:
    """A polynomial of two variables in Legendre's basis."""

    terms: Array
    centre: Array
    half: Array

    @classmethod
    def fitted(
        cls, x: NDArray[np.int64], y: NDArray[np.int64], u: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> _Surface | None:
        """Fit by Huber's weights; None where even most of the pixels agree on no surface."""
        step = max(1, len(x) // _SURFACE_PIXELS)
        x, y = x[::step], y[::step]
        target, deviation = u[::step].astype(np.float64), sigma[::step].astype(np.float64)
        low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
        empty = cls(np.zeros((_SURFACE_ORDER + 1,) * 2), (low + high) / 2, np.maximum((high - low) / 2, 1.0))
        design = empty._basis(x, y)
        weight = 1 / np.maximum(deviation, 1e-6) ** 2
        factor = np.ones_like(weight)
        terms = np.zeros(design.shape[1])
        for _ in range(2 * _ROUNDS):
            weighted = design * (weight * factor)[:, None]
            normal = weighted.T @ design
            terms = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(len(normal)), weighted.T @ target)
            residual = np.abs(target - design @ terms) / deviation
            spread = max(1.0, 1.4826 * float(np.median(residual)))
            factor = 1 / np.maximum(1.0, residual / (_HUBER * spread)) ** 2
        if not np.isfinite(terms).all():
            return None
        coefficients = np.zeros_like(empty.terms)
        coefficients[_ORDERS] = terms
        return cls(coefficients, empty.centre, empty.half)

    def _basis(self, x: NDArray[np.int64], y: NDArray[np.int64]) -> Array:
        p = legendre.legvander((x - self.centre[0]) / self.half[0], _SURFACE_ORDER)
        q = legendre.legvander((y - self.centre[1]) / self.half[1], _SURFACE_ORDER)
        return np.asarray(p[:, _ORDERS[0]] * q[:, _ORDERS[1]])

    def __call__(self, x: NDArray[np.int64] | Array, y: NDArray[np.int64] | Array) -> Array:
        """(n,) values at pixels (n,)."""
        p, q = (x - self.centre[0]) / self.half[0], (y - self.centre[1]) / self.half[1]
        return np.asarray(legendre.legval2d(p, q, self.terms), np.float64)

    def slopes(self, x: Array, y: Array) -> Array:
        """(n, 2) derivatives after x and y."""
        step = 0.5
        return np.column_stack(
            (
                (self(x + step, y) - self(x - step, y)) / (2 * step),
                (self(x, y + step) - self(x, y - step)) / (2 * step),
            )
        )


_ORDERS = np.nonzero(np.add.outer(np.arange(_SURFACE_ORDER + 1), np.arange(_SURFACE_ORDER + 1)) <= _SURFACE_ORDER)
