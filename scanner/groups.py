"""Groups of places that do not light each other: each gets a regional sequence of its own (method.md §5).

Round one's separated paths say of every pixel which projector place lights it directly and which one its bounce comes
from: a graph "place A lights place B" over cells of the projector's picture. Where the faces of the scene are known
(`scanner.faces`) each is a group to begin with, and those that do not light each other are joined. A group that still
lights itself is cut in two so that few bounces have both ends in one part, and neighbours rarely part, by the mean
field of that energy, annealed (Peterson & Anderson, Complex Systems 1, 995 (1987)); partners lie on opposite ends of
their bounces, so that the main direction of the bounces says where to begin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from scanner.regions import CELL_PX, HARM, LEAST_SURFACE

_COHERENCE = 0.25
"""What parting two neighbouring cells costs, in pixels of a cell: those that the end of the lit set cuts."""

_HOLLOW = 0.5
"""Share of a face's bounces that come from the face itself."""

_LEAST_GROUP = 0.01
"""Share of the pixels below which a group is not worth a sequence."""

_TOO_CLOSE_PX = 6.0
"""A bounce from nearer than this cannot be left dark while its pixel is lit."""

_SEEN = 3
"""Direct coordinates that make a cell one of the region's."""

_GAINS = np.geomspace(1.0, 30.0, 80)
"""Inverse temperatures of the annealing."""

_LEAST_GAIN = 0.2
"""A cut that removes less than this share of its group's conflicts is none."""


@dataclass(frozen=True)
class _Graph:
    """Cells of the region: pixels in each, who lights whom, and who lies beside whom.

    ``lights[i, j]`` counts the pixels of cell i whose bounce comes from cell j; ``beside`` is symmetric; ``towards`` is
    the (n, 2) mean way from a cell to its sources, px. A place that two faces share at a crease is a cell of each.
    """

    face: NDArray[np.intp]
    pixels: NDArray[np.float64]
    lights: csr_array
    beside: csr_array
    towards: NDArray[np.float64]

    def conflicts(self, members: NDArray[np.bool_]) -> float:
        """Pixels whose direct place and bounce both lie among ``members``."""
        inside = members.astype(float)
        return float(inside @ (self.lights @ inside))


def group_places(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    bounce_x: NDArray[np.float32],
    bounce_y: NDArray[np.float32],
    most: int,
    face: NDArray[np.int32] | None = None,
) -> NDArray[np.int8]:
    """Divide pixels into the fewest groups in which hardly any bounce starts where a member is lit.

    Parameters
    ----------
    x, y
        (P,) direct projector coordinates, px; NaN where unknown.
    bounce_x, bounce_y
        (P,) where their bounces come from; NaN where unknown or where there is none.
    most
        Groups at most.
    face
        (P,) number of the face that a pixel sees, 0 where none is known; None where faces are not known at all.

    Returns
    -------
    NDArray
        (P,) number of the group, the largest first; -1 without a coordinate, and in groups too small for a sequence.
    """
    group = np.full(x.shape, -1, np.int8)
    cell, graph = _graph(x, y, bounce_x, bounce_y, np.zeros(x.shape, np.int32) if face is None else face)
    if not graph.pixels.size:
        return group
    allowed = HARM * max(float(np.isfinite(bounce_x).sum()), 1.0)
    label = _merged(graph, _by_size(graph, graph.face), allowed, most)
    whole = np.zeros(label.size, bool)
    while (count := int(label.max()) + 1) < most:
        conflicts = [0.0 if whole[label == k].any() else _to_part(graph, label == k) for k in range(count)]
        worst = int(np.argmax(conflicts))
        if conflicts[worst] <= allowed / count:
            break
        members = label == worst
        side = _cut(graph, members)
        kept = graph.conflicts(members & side) + graph.conflicts(members & ~side)
        if kept > (1 - _LEAST_GAIN) * conflicts[worst]:
            whole |= members
            continue
        label[members & side] = count
        label = _merged(graph, label, allowed, most)
    label = _by_size(graph, label)
    sizes = np.bincount(label, graph.pixels)
    label[(sizes < max(_LEAST_GROUP * sizes.sum(), LEAST_SURFACE))[label]] = -1
    known = cell >= 0
    group[known] = label[cell[known]]
    return group


def _to_part(graph: _Graph, members: NDArray[np.bool_]) -> float:
    """Conflicts of a group that are worth a cut; of known faces only where most of their bounces are their own.

    A face lights itself where it is hollow; else a bounce with a wrong fringe order says so now and then.
    """
    conflicts = graph.conflicts(members)
    arriving = float(members.astype(float) @ graph.lights.sum(axis=1))
    return 0.0 if graph.face[members].all() and conflicts <= _HOLLOW * arriving else conflicts


def _by_size(graph: _Graph, label: NDArray[np.intp]) -> NDArray[np.intp]:
    """Labels of the cells numbered anew without gaps, that of the most pixels first."""
    label = np.unique(label, return_inverse=True)[1]
    order = np.argsort(-np.bincount(label, graph.pixels), kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    return np.asarray(rank[label])


def _graph(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    bounce_x: NDArray[np.float32],
    bounce_y: NDArray[np.float32],
    face: NDArray[np.int32],
) -> tuple[NDArray[np.intp], _Graph]:
    """Cell of every pixel, -1 for none, and the graph of the cells."""
    known = np.isfinite(x) & np.isfinite(y)
    row, column = (np.floor(np.where(known, u, 0) / CELL_PX).astype(np.intp) for u in (y, x))
    height, width = (int(v[known].max(initial=0)) + 2 for v in (row, column))
    known &= (row >= 0) & (column >= 0)
    layers = int(face.max(initial=0)) + 1
    flat = np.where(known, (face * height + row) * width + column, 0)
    counts = np.bincount(flat[known], minlength=layers * height * width)
    number = np.full(counts.size, -1)
    number[counts >= _SEEN] = np.arange(np.count_nonzero(counts >= _SEEN))
    cell = np.where(known, number[flat], -1)
    n = int(number.max()) + 1
    grid, seen = number.reshape(layers, height, width), counts.reshape(layers, height, width)
    # Who lights whom: only sources within the region count, and none that no mask could leave dark.
    lit = (cell >= 0) & np.isfinite(bounce_x) & np.isfinite(bounce_y)
    away = np.stack([bounce_x - x, bounce_y - y], axis=1).astype(np.float64)
    lit &= np.nan_to_num(np.hypot(away[:, 0], away[:, 1])) > _TOO_CLOSE_PX
    from_row, from_column = (np.floor(np.where(lit, u, -1) / CELL_PX).astype(np.intp) for u in (bounce_y, bounce_x))
    lit &= (from_row >= 0) & (from_row < height) & (from_column >= 0) & (from_column < width)
    there = np.where(lit, from_row, 0), np.where(lit, from_column, 0)
    # Where faces share a place, another than the pixel's own throws the bounce.
    most = np.argsort(-seen, axis=0, kind="stable")
    own = most[0][there] == face
    from_face = np.where(own & (layers > 1), most[min(1, layers - 1)][there], most[0][there])
    from_face = np.where(grid[from_face, *there] >= 0, from_face, most[0][there])
    source = np.where(lit, grid[from_face, *there], -1)
    lit &= source >= 0
    pairs = (cell[lit], source[lit])
    lights = csr_array((np.ones(pairs[0].size), pairs), shape=(n, n))
    emitting = np.maximum(np.bincount(pairs[0], minlength=n), 1)
    towards = np.stack([np.bincount(pairs[0], away[lit, k], n) / emitting for k in (0, 1)], axis=1)
    # Who lies beside whom.
    ones = [(grid[:, :, :-1], grid[:, :, 1:]), (grid[:, :-1], grid[:, 1:])]
    first, second = (np.concatenate([pair[k].ravel() for pair in ones]) for k in (0, 1))
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    pixels = counts[counts >= _SEEN].astype(np.float64)
    weight = np.minimum(pixels[first], pixels[second])
    beside = csr_array((weight, (first, second)), shape=(n, n))
    layer = np.flatnonzero(counts >= _SEEN) // (height * width)
    return cell, _Graph(layer, pixels, lights, csr_array(beside + beside.T), towards)


def _cut(graph: _Graph, members: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Side of every cell, (n,) bool, in the cut of ``members`` that parts bounces from their places, not neighbours."""
    some = np.flatnonzero(members)
    lights = graph.lights[some][:, some]
    coupling = csr_array(_COHERENCE * graph.beside[some][:, some] - (lights + lights.T))
    strength = np.maximum(abs(coupling).sum(axis=1), 1e-9)
    way = graph.towards[some]
    along = np.linalg.eigh(way.T @ way)[1][:, -1]
    side = way @ along
    side /= max(float(np.abs(side).max()), 1e-9)
    for gain in _GAINS:
        # Half of the old state: partners that follow each other at once would swing for ever.
        side = 0.5 * side + 0.5 * np.tanh(gain * (coupling @ side) / strength)
    cut = np.zeros(members.shape, bool)
    cut[some] = side > 0
    return cut


def _merged(graph: _Graph, label: NDArray[np.intp], allowed: float, most: int) -> NDArray[np.intp]:
    """Join groups that can be lit together after all, and those that suffer least where there are too many."""
    count = int(label.max()) + 1
    one = csr_array((np.ones(label.size), (np.arange(label.size), label)), shape=(label.size, count))
    between = (one.T @ (graph.lights @ one)).toarray()
    between += between.T
    np.fill_diagonal(between, np.inf)
    into = np.arange(count)
    while count > 1:
        a, b = sorted(np.unravel_index(np.argmin(between), between.shape))
        if between[a, b] > HARM * allowed and count <= most:
            break
        into[into == b] = a
        between[a] += between[b]
        between[:, a] += between[:, b]
        between[b] = between[:, b] = between[a, a] = np.inf
        count -= 1
    return np.unique(into[label], return_inverse=True)[1]
