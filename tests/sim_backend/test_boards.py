"""Pictures of boards against the print seen through OpenCV's camera model."""

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from sim_backend.scenes import BoardScene, scene_of
from sim_backend.transport import RayCaster

SQUARE, COLUMNS, ROWS = 18.0, 11, 8
LENSES = {
    "camera": {
        "width_px": 320,
        "height_px": 240,
        "distortion_k1": -0.15,
        "distortion_k2": 0.1,
        "distortion_p1": 1e-3,
        "distortion_p2": -8e-4,
        "distortion_k3": 0.05,
        "principal_offset_px": [4.3, -3.1],
    },
    "projector": {"distortion_k1": 0.05, "principal_offset_px": [-5.0, 12.0]},
    "transport": {"supersample": 2},
}
WHITE = np.ones((400, 640), np.float32)


def _chessboard(**changes):
    squares = [
        ((x, y), (x + SQUARE, y), (x + SQUARE, y + SQUARE), (x, y + SQUARE))
        for j in range(ROWS)
        for i in range(COLUMNS)
        if (i + j) % 2 == 0
        for x, y in [((i - COLUMNS / 2) * SQUARE, (j - ROWS / 2) * SQUARE)]
    ]
    return {**SHEET, "polygons": squares, **changes}


def _inner_corners():
    """(n, 2) mm on the print."""
    x, y = (np.arange(1, n) * SQUARE - n * SQUARE / 2 for n in (COLUMNS, ROWS))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def _pose(document):
    """Rotation and translation of the board as scipy has them."""
    turns = [document.get(f"{axis}_deg", 0.0) for axis in ("pitch", "yaw", "roll")]
    place = [document.get(k, d) for k, d in (("offset_x_mm", 0.0), ("offset_y_mm", 0.0), ("distance_mm", 600.0))]
    return Rotation.from_euler("XYZ", turns, degrees=True), np.array(place)


def _seen(document, points, lens):
    """(n, 2) px of points (n, 3) of the board, by OpenCV."""
    rotation, place = _pose(document)
    px, _ = cv2.projectPoints(points, rotation.as_rotvec(), place, lens.matrix, lens.distortion)
    return px.reshape(-1, 2)


def _reflectance(found, blank):
    """(height, width) share of the light that the print leaves, seen through the blank sheet's light."""
    with np.errstate(invalid="ignore"):
        return 0.8 * found.optics.transport.direct_light(WHITE) / blank.optics.transport.direct_light(WHITE)


def _rim(disc):
    """(720, 2) mm on the print."""
    x, y, r = disc
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    return np.column_stack((x + r * np.cos(turn), y + r * np.sin(turn)))


def _assert_covers(reflectance, outline):
    """Hold the dark spot within an outline (n, 2) px to the outline's area and centroid."""
    (left, top), (right, bottom) = np.floor(outline.min(0)).astype(int) - 2, np.ceil(outline.max(0)).astype(int) + 3
    dark = (0.8 - reflectance[top:bottom, left:right]) / 0.75
    moments = cv2.moments(outline.astype(np.float32))
    v, u = np.mgrid[top:bottom, left:right]
    assert dark.sum() == pytest.approx(moments["m00"], rel=0.006)
    centre = [(dark * a).sum() / dark.sum() for a in (u, v)]
    np.testing.assert_allclose(centre, [moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]], atol=0.01)


SHEET = {"name": "board", "width_mm": 240.0, "height_mm": 180.0}
TILTED = {"yaw_deg": -22.0, "pitch_deg": 15.0, "roll_deg": 8.0, "offset_x_mm": 6.0, "offset_y_mm": -4.0}
FRONTAL = {"distance_mm": 560.0}


@pytest.mark.parametrize("pose", [FRONTAL, {**TILTED, "roll_deg": -115.0, "distance_mm": 700.0}])
def test_pixels_hold_the_print_in_its_share(truth, pose):
    """Against 20² rays for each of some pixels through OpenCV's lens, and the parity of the squares they meet."""
    document, side = _chessboard(**pose), 20
    found, blank = truth(scene=document, **LENSES), truth(scene={**document, "polygons": []}, **LENSES)
    clean = np.isfinite(found.x_p) & ~blank.edge
    assert clean.mean() > 0.3
    pixel = np.random.default_rng(0).permutation(np.argwhere(clean)[:, ::-1])[:1500]
    offset = (np.arange(side) + 0.5) / side - 0.5
    px = (pixel[:, None] + np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)).reshape(-1, 1, 2)
    lens = found.rig.camera
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 1e-9)
    xy = cv2.undistortPoints(px, lens.matrix, lens.distortion, None, None, None, criteria).reshape(-1, 2)
    rotation, place = _pose(document)
    normal = rotation.as_matrix()[:, 2]
    depth = (place @ normal) / (xy @ normal[:2] + normal[2])
    on_print = (np.column_stack((xy * depth[:, None], depth)) - place) @ rotation.as_matrix()[:, :2]
    square = np.floor(on_print / SQUARE + [COLUMNS / 2, ROWS / 2])
    dark = (square.sum(1) % 2 == 0) & ((square >= 0) & (square < [COLUMNS, ROWS])).all(1)
    expected = 0.8 - 0.75 * dark.reshape(-1, side**2).mean(1)
    assert ((expected > 0.06) & (expected < 0.79)).mean() > 0.05
    difference = _reflectance(found, blank)[pixel[:, 1], pixel[:, 0]] - expected
    # Of 20² rays, one in 40 along an edge is undecided; the illumination within a pixel varies by less than that.
    assert np.abs(difference).max() < 0.75 / 20
    assert np.sqrt((difference**2).mean()) < 0.003


@pytest.mark.parametrize("pose", [TILTED, FRONTAL])
def test_corners_are_where_the_camera_model_puts_them(truth, pose):
    document = _chessboard(**pose)
    found = truth(scene=document, **LENSES)
    corners = np.column_stack((_inner_corners(), np.zeros(len(_inner_corners()))))
    expected = _seen(document, corners, found.rig.camera)
    light = cv2.GaussianBlur(found.optics.transport.direct_light(WHITE), (0, 0), 1.0)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    start = expected.reshape(-1, 1, 2).astype(np.float32) + np.float32(0.4)
    located = cv2.cornerSubPix(250 * light / light.max(), start, (6, 6), (-1, -1), criteria).reshape(-1, 2)
    # What OpenCV finds wanders with the place of a corner in its pixel, even in pictures as soft as this one.
    assert np.sqrt(((located - expected) ** 2).mean()) < 0.04
    assert np.abs(located - expected).max() < 0.1


def test_the_projector_lights_a_board_where_it_stands(truth):
    document = _chessboard(**TILTED)
    found = truth(scene=document, **LENSES)
    lit = np.isfinite(found.x_p)
    points = found.points[lit]
    rotation, place = _pose(document)
    in_board = (points - place) @ rotation.as_matrix()
    np.testing.assert_allclose(in_board[:, 2], 0, atol=1e-3)
    px, _ = cv2.projectPoints(
        points,
        cv2.Rodrigues(found.rig.rotation)[0],
        found.rig.translation,
        found.rig.projector.matrix,
        found.rig.projector.distortion,
    )
    np.testing.assert_allclose(np.stack((found.x_p[lit], found.y_p[lit]), 1), px[:, 0], atol=1e-3)
    # Dark squares give little light, but some: they are lit.
    assert (found.x_p[found.object_id == 0] > -1).mean() > 0.9


@pytest.mark.parametrize("bend", [4.0, -4.0])
def test_a_bent_board_is_not_stretched(truth, bend):
    discs = [(x, y, 4.0) for x in (-100.0, -50.0, 0.0, 60.0, 105.0) for y in (-55.0, 50.0)]
    document = {**SHEET, "discs": discs, **TILTED, "bend_mm": bend}
    found, blank = truth(scene=document, **LENSES), truth(scene={**document, "discs": []}, **LENSES)
    # The section by small steps: z = ±bend at the sides, and the length along it is the sheet's width.
    half = 120.0
    for _ in range(20):
        x = np.linspace(-half, half, 20001)
        length = np.hypot(np.diff(x), np.diff(bend * (x / half) ** 2))
        half *= 240.0 / length.sum()
    along = np.concatenate(([0], np.cumsum(length))) - length.sum() / 2
    assert (240.0 - 2 * half) * 1000 > 100  # µm, far above what the centroids can tell
    for disc in discs:
        across = np.interp(_rim(disc)[:, 0], along, x)
        rim = np.column_stack((across, _rim(disc)[:, 1], bend * (across / half) ** 2))
        _assert_covers(_reflectance(found, blank), _seen(document, rim, found.rig.camera))

    seen = found.points[np.isfinite(found.x_p)]
    rotation, place = _pose(document)
    in_board = (seen - place) @ rotation.as_matrix()
    np.testing.assert_allclose(in_board[:, 2], bend * (in_board[:, 0] / half) ** 2, atol=1e-3)
    assert np.ptp(in_board[:, 2]) > 0.9 * abs(bend)


def test_normals_of_a_bent_board_are_at_right_angles_to_it():
    scene = scene_of(_chessboard(**{**TILTED, "bend_mm": -6.0}))
    caster = RayCaster(scene.surfaces())
    rays = np.column_stack((np.random.default_rng(3).uniform(-0.1, 0.1, (200, 2)), np.ones(200)))
    step = 1e-4
    here, right, below = (
        caster.first_hits(np.zeros(3), rays + shift) for shift in ([0, 0, 0], [step, 0, 0], [0, step, 0])
    )
    assert (here.surface == 0).all()
    for neighbour in (right, below):
        tangent = neighbour.point - here.point
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # A chord as long as this leaves the surface by its curvature times half its length.
        assert np.abs((tangent * here.normal).sum(1)).max() < 1e-3 * step * 600
    assert (here.normal[:, 2] < 0).all()


def test_discs_cover_the_area_of_their_images(truth):
    discs = [(x, y, r) for x, r in ((-60.0, 7.5), (0.0, 12.0), (55.0, 4.0)) for y in (-40.0, 35.0)]
    document = {**SHEET, "discs": discs, **TILTED}
    found, blank = truth(scene=document, **LENSES), truth(scene={**document, "discs": []}, **LENSES)
    for disc in discs:
        rim = np.column_stack((_rim(disc), np.zeros(720)))
        _assert_covers(_reflectance(found, blank), _seen(document, rim, found.rig.camera))


def test_a_lone_board_gets_no_bounce(truth):
    transport = truth(scene=_chessboard(), **LENSES).optics.transport
    assert transport.bounces == ()
    assert transport.bounced_light(WHITE).max() == 0


def test_a_sheet_scatters_its_mean(truth):
    (sheet,) = scene_of(_chessboard(discs=[(110.0, 0.0, 6.0)])).surfaces()
    dark = (COLUMNS * ROWS // 2 * SQUARE**2 + np.pi * 36) / (240 * 180)
    assert sheet.material.diffuse == pytest.approx(0.8 - 0.75 * dark, abs=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [
        {"polygons": [[[0, 0], [1, 1]]]},
        {"discs": [[0, 0, -1]]},
        {"discs": [[0, 0]]},
        {"discs": [[0, 0, 6], [10, 0, 6]]},
        {"bend_mm": 30.0},
        {"light_reflectance": 1.5},
        {"offset_x_mm": float("nan")},
        {"polygons": [[[0, 0], [1, float("inf")], [1, 0]]]},
        {"squares": 5},
    ],
)
def test_wrong_boards_are_refused(wrong):
    with pytest.raises(ValidationError):
        BoardScene.model_validate({"name": "board", **wrong})
