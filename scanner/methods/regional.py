"""What the regional sequences light, one after the other, and what each of them leaves to the next (method.md §5).

Places of the region that light each other take turns (`scanner.groups`). Where a sequence still detects a bounce, its
own phasors are separated, and what is left when all have been taken is divided and lit once more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from scanner.faces import Faces
from scanner.groups import group_places
from scanner.interreflection import Detection
from scanner.methods.base import FirstRound
from scanner.methods.fold import CLOSE_PATHS_PX, Fold
from scanner.methods.lit_sets import lit_sets
from scanner.methods.separated import Separated
from scanner.patterns import AXES
from scanner.regions import (
    between_paths,
    inside,
    lit_together,
    on_surface,
    pitch,
)
from scanner.result import Maps

CLEARANCE_PX = 2
"""Fringes this near to the end of the lit set are cut by the projector's blur."""

_CLEARANCE_PITCHES = 2.0
"""And those within so many camera pixels of it by the camera's."""

MOST_SEQUENCES = 8
"""One bit of `Maps.lit_by` each."""

WORTH = 0.01
"""Share of the region's pixels for which another sequence is taken."""

_PROGRESS = 0.7
"""Sequences for what is left follow only while they leave less than this share of what there was."""


@dataclass(frozen=True)
class Regional:
    """The regional sequences of a scan: what they have measured, and what they are still to light.

    Parameters
    ----------
    queue
        (height, width) bool each, what the next sequences light.
    x, y
        (H, W) where round one has the direct light of the served pixels come from, px; NaN where it does not tell.
    own
        (H, W) uint8, the sequence that is meant to measure the pixel, 0 for none.
    served
        (H, W) bool, undetected pixels whose coordinates the sequences may replace.
    fold
        What lies at folds: its strip stays dark.
    faces
        Faces of the scene; None where they are not known.
    most
        Sequences at most.
    taken
        Sequences so far.
    lit
        (height, width) uint8, bit k - 1 set where sequence k lit.
    sequence
        (H, W) uint8, the sequence that measured the pixel, 0 for none.
    modulation, misfit
        (H, W) what that sequence showed there, DN and χ² per degree of freedom; NaN where none did.
    failed
        (4, H, W) direct coordinates and those of the bounce where a sequence still detected one, px; NaN elsewhere.
    doubted
        (H, W) bool, where the sequence that measured a pixel, or all that lit it, still detects a bounce.
    left
        Pixels that were left over when sequences were last planned.
    """

    queue: tuple[NDArray[np.bool_], ...]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    own: NDArray[np.uint8]
    served: NDArray[np.bool_]
    fold: Fold
    faces: Faces | None
    most: int
    taken: int
    lit: NDArray[np.uint8]
    sequence: NDArray[np.uint8]
    modulation: NDArray[np.float32]
    misfit: NDArray[np.float32]
    failed: NDArray[np.float32]
    doubted: NDArray[np.bool_]
    left: int

    @classmethod
    def nothing(cls, shape: tuple[int, ...], size: tuple[int, int]) -> Regional:
        """No sequence, for a camera's (height, width) and a projector's (width, height)."""
        unknown, no = np.full(shape, np.nan, np.float32), np.zeros(shape, bool)
        return cls(
            queue=(),
            x=unknown,
            y=unknown,
            own=np.zeros(shape, np.uint8),
            served=no,
            fold=Fold.none(shape, size),
            faces=None,
            most=0,
            taken=0,
            lit=np.zeros((size[1], size[0]), np.uint8),
            sequence=np.zeros(shape, np.uint8),
            modulation=unknown,
            misfit=unknown,
            failed=np.full((4, *shape), np.nan, np.float32),
            doubted=no,
            left=0,
        )

    @property
    def planned(self) -> int:
        """Sequences that were taken or will be, as far as is known."""
        return self.taken + len(self.queue)


def begin(
    separated: Separated,
    detection: Detection,
    fold: Fold,
    faces: Faces | None,
    first: Maps,
    size: tuple[int, int],
    margin_px: float,
    most: int,
) -> Regional:
    """Plan the regional sequences from round one.

    Parameters
    ----------
    separated, detection, first
        Round one: both paths in its region, and the coordinates outside.
    fold
        What lies at folds: its strip stays dark.
    faces
        Faces of the scene, which are lit one after the other; None where they are not known.
    size
        Projector (width, height), px.
    margin_px
        By how much what is lit is grown.
    most
        Sequences at most.
    """
    shape = separated.shape
    paths = np.stack([plane(separated, values.get(a)) for values in (separated.u, separated.bounce) for a in AXES])
    known = plausible(separated)
    located = plane(separated, separated.located.astype(np.float32)) == 1
    nothing = np.full(shape, np.nan, np.float32)
    one_x, one_y = (nothing if u is None else u for u in (first.x_p_round1, first.y_p_round1))
    rim = detection.penumbra
    both = len(separated.u) == 2
    if both:
        x, y, from_x, from_y = (p[known] for p in paths)
        close = between_paths(x, y, from_x, from_y, size, CLOSE_PATHS_PX)
        rim = rim | (~detection.region & ~detection.depth_edge & inside(close, one_x, one_y, 0))
    rim = rim & first.valid & ~fold.blind
    if faces is not None:
        rim = rim | (_beside(detection, one_x, one_y) & first.valid & ~fold.blind & (faces.label > 0))
        paths = np.where(detection.region | rim, faces.settled(paths), np.float32(np.nan))
        one_x, one_y = (np.where(faces.label > 0, f, u) for f, u in ((faces.x, one_x), (faces.y, one_y)))
    group = np.where(known, np.int8(0), np.int8(-1))
    if both and most > 1:
        group = _groups(paths, located, detection.region, rim, faces, most)
    # Faces in one group do not light each other; of anything else in one group nobody knows.
    if both and group.max() < (1 if faces is None else 0):
        group = np.where(plausible(separated) & lit_together(*paths), np.int8(0), np.int8(-1))
    if faces is not None:
        # Of a face without a group nothing is lit.
        rim = rim & ((group >= 0) | (faces.label == 0))
    between = detection.region & (group < 0)
    x, y, group, masks = lit_sets(
        group, paths, located, between, rim, (one_x, one_y), separated, fold, faces, size, margin_px
    )
    return replace(
        Regional.nothing(shape, size),
        queue=tuple(masks) if masks and masks[0].any() else (),
        fold=fold,
        faces=faces,
        x=x,
        y=y,
        own=(group + 1).astype(np.uint8),
        served=rim,
        most=most,
        left=int(detection.region.sum()),
    )


def again(
    regional: Regional, region: NDArray[np.bool_], separated: Separated, size: tuple[int, int], margin_px: float
) -> Regional:
    """Plan sequences for what all sequences so far have left, where that is worth it.

    Parameters
    ----------
    regional
        Its queue is empty.
    region
        (H, W) bool, the detected region.
    separated
        Of round one; for pixels that no sequence has lit.
    size, margin_px
        As `begin`.
    """
    rest = remaining(regional, region)
    left = int(rest.sum())
    budget = regional.most - regional.taken
    if budget < 1 or left <= WORTH * region.sum() or left > _PROGRESS * regional.left:
        return regional
    once = np.stack([plane(separated, values.get(a)) for values in (separated.u, separated.bounce) for a in AXES])
    paths = np.where(np.isfinite(regional.failed[:1]), regional.failed, once)
    if regional.faces is not None:
        paths = regional.faces.settled(paths)
    paths = np.where(rest, paths, np.float32(np.nan))
    nothing, located = np.zeros_like(rest), np.isfinite(paths[2])
    group = _groups(paths, located, rest, nothing, regional.faces, budget)
    if group.max() < 1:
        group = np.where(on_surface(paths[0], paths[1]) & lit_together(*paths), np.int8(0), np.int8(-1))
    between, first = rest & (group < 0), (paths[0], paths[1])
    x, y, group, masks = lit_sets(
        group, paths, located, between, nothing, first, separated, regional.fold, regional.faces, size, margin_px
    )
    new = np.isfinite(x)
    return replace(
        regional,
        queue=tuple(masks) if masks and masks[0].any() else (),
        x=np.where(new, x, regional.x),
        y=np.where(new, y, regional.y),
        own=np.where(group >= 0, group + 1 + regional.taken, regional.own).astype(np.uint8),
        left=left,
    )


def _groups(
    paths: NDArray[np.float32],
    located: NDArray[np.bool_],
    region: NDArray[np.bool_],
    rim: NDArray[np.bool_],
    faces: Faces | None,
    most: int,
) -> NDArray[np.int8]:
    """(H, W) number of the group of every pixel of the region, and with faces of its rim; -1 for none."""
    group = np.full(region.shape, -1, np.int8)
    known = region & on_surface(paths[0], paths[1])
    if faces is not None:
        known = (region & (known | (faces.label > 0))) | (rim & (faces.label > 0))
    x, y = (p[known] for p in paths[:2])
    from_x, from_y = (np.where(located, p, np.float32(np.nan))[known] for p in paths[2:])
    group[known] = group_places(x, y, from_x, from_y, most, None if faces is None else faces.label[known])
    return group


def _beside(detection: Detection, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) bool, undetected pixels less than two fringes from the region: weaker bounces arrive there."""
    reach = int(np.ceil(CLOSE_PATHS_PX / max(pitch(x, y), 1 / 16)))
    near = distance_transform_edt(~detection.region) <= reach
    return np.asarray(near & ~detection.region & ~detection.depth_edge)


def remaining(regional: Regional, region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) bool, pixels of the region with a known direct place that no sequence has measured without a bounce."""
    return np.asarray(
        region & ((regional.sequence == 0) | regional.doubted) & (np.isfinite(regional.x) | np.isfinite(regional.y))
    )


def plane(separated: Separated, values: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """(H, W) values of the plausible pixels, NaN elsewhere."""
    found = np.full(separated.shape, np.nan, np.float32)
    if values is not None:
        found.reshape(-1)[separated.pixels[separated.plausible]] = values[separated.plausible]
    return found


def plausible(separated: Separated) -> NDArray[np.bool_]:
    """(H, W) bool, pixels with a separation that says where to light."""
    return np.asarray(plane(separated, np.ones(separated.pixels.size, np.float32)) == 1)


def lit_here(lit: NDArray[np.bool_], x: NDArray[np.float32] | None, y: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """Whether a coordinate lies where a sequence lit and its fringes were whole."""
    if x is not None and y is not None:
        return inside(lit, x, y, max(CLEARANCE_PX, math.ceil(_CLEARANCE_PITCHES * pitch(x, y))))
    if x is not None:
        columns = np.asarray(lit.any(axis=0))
        return inside(np.repeat(columns[None], lit.shape[0], axis=0), x, np.zeros_like(x), CLEARANCE_PX)
    assert y is not None
    rows = np.asarray(lit.any(axis=1))
    return inside(np.repeat(rows[:, None], lit.shape[1], axis=1), np.zeros_like(y), y, CLEARANCE_PX)


def concluded(first: FirstRound, said: str, region: NDArray[np.bool_], state: Regional, more: bool) -> FirstRound:
    """Say after the last sequence how many there were, what they have left, and whether ``more`` could be allowed."""
    if state.queue:
        return first
    rest = int(remaining(state, region).sum())
    share = rest / max(int(region.sum()), 1)
    told = f"{state.taken} regional sequences: places of the bounce region light each other" if state.taken > 1 else ""
    notes = []
    if share > WORTH:
        notes.append(
            f"{100 * share:.1f} % of the bounce region's pixels still see a bounce after {state.taken} regional "
            f"sequence{'s' * (state.taken > 1)}, or could not be lit: they hold what round one separates, or nothing"
            + ("; scan.max_regional_sequences allows more" if more and state.taken >= state.most else "")
        )
    return replace(first, decision="; ".join(t for t in (said, told) if t), notes=notes)
