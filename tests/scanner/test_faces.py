"""Faces of scenes made of planes, balls and cylinders, traced here: which pixel belongs to which is known.

The limits were set on rendered scenes (a table with objects, a groove of 100°); none of these was used for that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from scanner.faces import Faces, find_faces
from scanner.rig import Lens, Rig

WIDTH, HEIGHT = 240, 180
SIGMA_PX = 0.03


@dataclass
class Plane:
    """n · X = distance."""

    normal: tuple[float, float, float]
    distance: float

    def depth(self, rays):
        return self.distance / (rays @ np.array(self.normal))


@dataclass
class Ball:
    centre: tuple[float, float, float]
    radius: float
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def depth(self, rays):
        """Nearer crossing; with an ``axis`` of length one that of a cylinder."""
        across = np.eye(3) - np.outer(self.axis, self.axis)
        d, c = rays @ across, across @ np.array(self.centre)
        a, b = (d * d).sum(-1), d @ c
        root = b * b - a * (c @ c - self.radius**2)
        return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def rig_of(scale=1):
    camera = np.array([[300.0 * scale, 0, 119.5 * scale], [0, 300 * scale, 89.5 * scale], [0, 0, 1]])
    projector = np.array([[700.0, 0, 319.5], [0, 700, 199.5], [0, 0, 1]])
    turn = np.radians(14)
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    nothing = np.empty(0)
    size = (WIDTH * scale, HEIGHT * scale)
    centre = np.array([150.0, 20.0, 0.0])
    return Rig(Lens(camera, nothing, size), Lens(projector, nothing, (640, 400)), rotation, -rotation @ centre)


def see(bodies, scale=1, seed=5, hollow=False):
    """What a camera sees: rig, number of the body from 1 on, and coordinates without and with noise.

    Of planes that form a hollow the nearer one is seen, and of those that form a ridge the farther one; balls are in
    front of whatever is behind them.
    """
    rig = rig_of(scale)
    v, u = np.mgrid[: HEIGHT * scale, : WIDTH * scale].astype(float)
    k = rig.camera.matrix
    rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], axis=-1)
    depths = np.stack([b.depth(rays) for b in bodies])
    flat = np.array([isinstance(b, Plane) for b in bodies])
    if not hollow and flat.sum() > 1:
        far = depths[flat].max(axis=0)
        depths[flat] = np.where(depths[flat] == far, depths[flat], np.inf)
    part = depths.argmin(axis=0) + 1
    points = rays * depths.min(axis=0)[..., None]
    seen = points @ rig.rotation.T + rig.translation
    p = rig.projector.matrix
    x, y = (seen[..., a] / seen[..., 2] * p[a, a] + p[a, 2] for a in (0, 1))
    noise = np.random.default_rng(seed).normal(0, SIGMA_PX, (2, *x.shape))
    noisy = tuple((c + n).astype(np.float32) for c, n in zip((x, y), noise, strict=True))
    return rig, part, (x, y), noisy


def groove(opening_deg, turn_deg=5.0, distance=520.0):
    """Two planes that meet in a line across the picture's middle, upright but for 3°."""
    faces = []
    for side in (-1, 1):
        angle = np.radians(side * (90 - opening_deg / 2) + turn_deg)
        normal = np.array([np.sin(angle), 0.05, np.cos(angle)])
        faces.append(Plane(tuple(normal), float(normal @ (0, 0, distance))))
    return faces


def away_from_borders(part, reach):
    """Pixels whose surroundings all see one body."""
    same = np.ones(part.shape, bool)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            same &= np.roll(part, (dy, dx), (0, 1)) == part
    same[:reach] = same[-reach:] = same[:, :reach] = same[:, -reach:] = False
    return same


def agree(label, part, where):
    """Whether faces and bodies are the same division of some pixels, but for one in 500."""
    pairs, counts = np.unique(np.stack([label[where], part[where]]), axis=1, return_counts=True)
    large = pairs[:, counts > where.sum() / 500]
    return large.shape[1] == len(set(large[0])) == len(set(large[1])) == len(np.unique(part[where]))


TABLE = Plane((0.0, 0.85, 0.53), 330.0)
WALL = Plane((0.0, 0.0, 1.0), 640.0)


@pytest.mark.parametrize(
    ("bodies", "hollow"),
    [
        (groove(100.0), True),
        (groove(140.0), True),
        (groove(255.0), False),
        ([WALL, TABLE], True),
        ([WALL, TABLE, Ball((-30.0, 40.0, 480.0), 50.0)], True),
        ([WALL, Ball((20.0, 140.0, 560.0), 160.0, (1.0, 0.0, 0.0))], True),
    ],
    ids=["groove", "wide groove", "ridge", "wall and table", "with a ball", "cylinder before a wall"],
)
def test_faces_part_at_creases_and_edges_to_the_pixel(bodies, hollow):
    rig, part, _, noisy = see(bodies, hollow=hollow)
    faces = find_faces(rig, noisy, [], np.ones(part.shape, bool))
    assert agree(faces.label, part, away_from_borders(part, 1))


def test_a_ball_and_a_gentle_bend_are_one_face_each():
    for bodies in ([Ball((0.0, 0.0, 800.0), 400.0)], groove(168.0)):
        rig, part, _, noisy = see(bodies, hollow=True)
        faces = find_faces(rig, noisy, [], np.ones(part.shape, bool))
        assert (faces.label == np.bincount(faces.label.ravel()).argmax()).mean() > 0.99
        assert faces.label.max() == 1


@pytest.mark.parametrize("scale", [1, 4])
def test_over_what_is_open_faces_go_on_with_the_path_on_them(scale):
    # Beside the crease of a groove both paths are known, not which is direct; nearer to it nothing is.
    rig, part, (x, y), noisy = see(groove(104.0), scale, hollow=True)
    crease = np.abs(np.diff(part, axis=1, prepend=part[:, :1])).argmax(axis=1)
    away = np.abs(np.arange(part.shape[1]) - crease[:, None]) / scale
    open_to, nothing = away < 50, away < 8
    random = np.random.default_rng(8)
    direct = [np.where(open_to & ~nothing, c, np.nan).astype(np.float32) for c in noisy]
    bounce = [np.where(open_to & ~nothing, c, np.nan).astype(np.float32) for c in (x[:, ::-1], y[:, ::-1])]
    swap = random.random(part.shape) < 0.5
    wrong = random.random(part.shape) < 0.1
    first = tuple(np.where(wrong, c + 80, np.where(swap, b, c)) for c, b in zip(direct, bounce, strict=True))
    second = tuple(np.where(swap, c, b) for c, b in zip(direct, bounce, strict=True))
    sure = tuple(np.where(open_to, np.float32(np.nan), c) for c in noisy)
    faces = find_faces(rig, sure, [first, second], np.ones(part.shape, bool))
    assert agree(faces.label, part, away_from_borders(part, 2 * scale))
    # Where planes were continued over 8 px of the camera, four of the projector, they miss by little more than noise.
    off = np.hypot(faces.x - x, faces.y - y)
    pitch = np.abs(np.diff(x, axis=1)).max()
    assert np.nanpercentile(off, 99) < max(10 * SIGMA_PX, scale * pitch)
    assert np.nanmedian(off[~open_to]) < max(2 * SIGMA_PX, scale * pitch / 2)


def rounded(noisy, over):
    """Coordinates averaged over so many columns: what bounces from close by do to them at a crease."""
    found = []
    for c in noisy:
        padded = np.pad(c, ((0, 0), (over // 2, over // 2)), mode="edge")
        found.append(np.mean([padded[:, k : k + c.shape[1]] for k in range(over)], axis=0).astype(np.float32))
    return tuple(found)


@pytest.mark.parametrize("over", [9, 17, 25])
@pytest.mark.parametrize("certain", [True, False], ids=["sure", "open"])
def test_faces_do_not_go_around_a_rounded_crease(over, certain):
    # Each step from cell to cell is small, and the face would turn from one plane into the other.
    rig, part, _, noisy = see(groove(96.0), hollow=True)
    crease = np.abs(np.diff(part, axis=1, prepend=part[:, :1])).argmax(axis=1)
    away = np.arange(part.shape[1]) - crease[:, None]
    round_one = rounded(noisy, over)
    near = np.abs(away) < over // 2 + 1
    # A gap on one side, as where a region is refused: no crease can be seen beside it.
    gap = (away > 4) & (away < 12) & (np.arange(part.shape[0]) % 60 < 40)[:, None]
    hidden = gap if certain else gap | near
    sure = tuple(np.where(hidden, np.float32(np.nan), c) for c in round_one)
    open_to = tuple(np.where(gap, np.float32(np.nan), c) for c in round_one)
    faces = find_faces(rig, sure, [open_to], np.ones(part.shape, bool))
    assert agree(faces.label, part, away_from_borders(part, 3) & (np.abs(away) > over // 2 + 4))


@pytest.mark.parametrize("right_too", [False, True])
def test_among_few_coordinates_faces_end_at_the_crease(right_too):
    # So few are known around the crease that nothing there tells normals; only what a face was like before does.
    rig, part, _, noisy = see(groove(96.0), hollow=True)
    crease = np.abs(np.diff(part, axis=1, prepend=part[:, :1])).argmax(axis=1)
    away = np.arange(part.shape[1]) - crease[:, None]
    few = (away < 40) & (away > (-40 if right_too else -8))
    missing = few & (np.random.default_rng(2).random(part.shape) < 0.65)
    sure = tuple(np.where(missing, np.float32(np.nan), c) for c in noisy)
    faces = find_faces(rig, sure, [], np.ones(part.shape, bool))
    assert (faces.label > 0).mean() > 0.99
    assert agree(faces.label, part, away_from_borders(part, 6) & (faces.label > 0))


def test_of_a_hole_that_hides_a_crease_each_face_gets_its_part():
    rig, part, _, noisy = see(groove(112.0), hollow=True)
    crease = np.abs(np.diff(part, axis=1, prepend=part[:, :1])).argmax(axis=1)
    away = np.arange(part.shape[1]) - crease[:, None]
    # It reaches 30 px to one side of the crease and 4 px to the other.
    sure = tuple(np.where((away > -30) & (away < 4), np.float32(np.nan), c) for c in noisy)
    faces = find_faces(rig, sure, [], np.ones(part.shape, bool))
    assert agree(faces.label, part, away_from_borders(part, 3))


def test_pieces_of_a_face_are_one():
    rig, part, _, noisy = see([WALL])
    parted = np.zeros(part.shape, bool)
    parted[:, 90:102] = parted[70:82] = True
    sure = tuple(np.where(parted, np.float32(np.nan), c) for c in noisy)
    faces = find_faces(rig, sure, [], np.ones(part.shape, bool))
    assert faces.label.min() == faces.label.max() == 1


def test_nothing_sure_is_no_face_and_what_was_not_asked_for_is_none():
    rig, part, _, noisy = see([WALL])
    nothing = (np.full(part.shape, np.nan, np.float32),) * 2
    assert find_faces(rig, nothing, [noisy], np.ones(part.shape, bool)).label.max() == 0
    hole = np.zeros(part.shape, bool)
    hole[60:90, 100:140] = True
    sure = tuple(np.where(hole, np.float32(np.nan), c) for c in noisy)
    faces = find_faces(rig, sure, [], ~hole)
    assert (faces.label[hole] == 0).all()
    assert np.isnan(faces.x[hole]).all()
    assert (find_faces(rig, sure, [], np.ones(part.shape, bool)).label[hole] == faces.label[0, 0]).all()


def test_beyond_the_reach_of_the_lens_model_is_no_face():
    rig, part, _, noisy = see([WALL, TABLE], hollow=True)
    k = rig.camera.matrix
    # Radial distortion that folds back within the picture's corners.
    strong = Rig(Lens(k, np.array([-1.6, 0, 0, 0]), rig.camera.size), rig.projector, rig.rotation, rig.translation)
    reached = np.isfinite(strong.camera.pixel_rays()[..., 0])
    assert 0.5 < reached.mean() < 0.99
    faces = find_faces(strong, noisy, [], np.ones(part.shape, bool))
    assert (faces.label[~reached] == 0).all()
    assert len(np.unique(faces.label[reached])) >= 2
    assert np.isfinite(faces.x[faces.label > 0]).all()


def test_coordinates_off_their_epipolar_line_are_no_face():
    # A mirror shows the wall from elsewhere: smooth, and on no surface.
    rig, part, _, (x, y) = see([WALL])
    mirror = np.zeros(part.shape, bool)
    mirror[40:120, 60:150] = True
    faces = find_faces(rig, (x, np.where(mirror, y + 12, y)), [], ~mirror)
    assert (faces.label[mirror] == 0).all()
    assert (faces.label[~mirror] > 0).mean() > 0.99


def test_of_two_paths_the_one_on_the_face_is_direct():
    x, y = (np.full((1, 4), c, np.float32) for c in (100.0, 50.0))
    faces = Faces(np.array([[1, 1, 1, 0]], np.int32), x, y)
    paths = np.array(
        [[[101, 300, 180, 101]], [[50, 70, 90, 50]], [[300, 99, 250, 300]], [[70, 51, 95, 70]]], np.float32
    )
    settled = faces.settled(paths)
    np.testing.assert_array_equal(settled[:, 0, 0], [100, 50, 300, 70])
    np.testing.assert_array_equal(settled[:, 0, 1], [100, 50, 300, 70])
    np.testing.assert_array_equal(settled[:, 0, 2], [100, 50, np.nan, np.nan])
    np.testing.assert_array_equal(settled[:, 0, 3], paths[:, 0, 3])


def test_other_faces_are_where_their_pixels_are_lit_from():
    rig, part, (x, y), noisy = see(groove(110.0), hollow=True)
    faces = find_faces(rig, noisy, [], np.ones(part.shape, bool))
    left = faces.label[90, 20]
    others = faces.others(np.array([left]), (640, 400))
    place = np.rint(np.stack([y, x])).astype(int)
    inside = (place[0] >= 0) & (place[0] < 400) & (place[1] >= 0) & (place[1] < 640) & away_from_borders(part, 3)
    said = others[tuple(np.where(inside, place, 0))]
    assert said[inside & (part != part[90, 20])].mean() > 0.99
    assert said[inside & (part == part[90, 20])].mean() < 0.01
