"""What a rig's covariance does to points, against rigs that are drawn from it and triangulate the same coordinates."""

import cv2
import numpy as np
import pytest

from drivers import NoiseModel
from scanner import optics
from scanner.config import ScanSection
from scanner.decoding import Decoder
from scanner.methods import METHODS
from scanner.rig import Lens, Rig, RigError
from scanner.rig_uncertainty import along_rays, covariance_fault, sigma_rig
from scanner.triangulation import triangulate

SIZE = (64, 48)
MATRICES = np.array([[[104.0, 0, 32.25], [0, 103.0, 23.5], [0, 0, 1]], [[1700.0, 0, 655.5], [0, 1710, 610], [0, 0, 1]]])
TERMS = np.array([[-0.08, 0.05, 0.0011, -0.0007, 0.01], [-0.05, 0.02, -0.0005, 0.001, 0.0]])
TURN, SHIFT = np.array([0.12, -0.28, 0.02]), np.array([155.0, -90.0, 28.0])
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
NAMES = (
    *(f"{part}.{name}" for part in ("camera", "projector") for name in LENS),
    *(f"{part}.{axis}" for part in ("rotation", "translation") for axis in "xyz"),
    "board.bend_xx",
)
_LENSES = [[0.02, 0.02, 0.03, 0.03, 4e-4, 2e-3, 5e-5, 5e-5, 2e-3], [0.2, 0.2, 0.4, 0.4, 4e-4, 2e-3, 5e-5, 5e-5, 2e-3]]
_PLACE = [2e-4, 3e-4, 1e-4, 0.05, 0.05, 0.08, 0.01]
SIGMAS = np.concatenate((*_LENSES, _PLACE))
SIGMA_X, SIGMA_Y = 0.02, 0.05


def _covariance(seed=0):
    """Strongly correlated, as a calibration's is."""
    mixed = np.random.default_rng(seed).standard_normal((len(NAMES), 8))
    shape = mixed @ mixed.T + 0.5 * np.eye(len(NAMES))
    scale = SIGMAS / np.sqrt(np.diag(shape))
    return shape * scale[:, None] * scale


def _rig(steps=None, metadata=None):
    steps = np.zeros(len(NAMES)) if steps is None else steps
    lenses = []
    for i, size in enumerate((SIZE, (1280, 800))):
        step, matrix = steps[9 * i : 9 * i + 9], MATRICES[i].copy()
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
        lenses.append(Lens(matrix, TERMS[i] + step[4:], size))
    rotation = cv2.Rodrigues(steps[18:21])[0] @ cv2.Rodrigues(TURN)[0]
    return Rig(*lenses, rotation, SHIFT + steps[21:24], metadata or {})


def _stating(covariance, names=NAMES):
    return _rig(metadata={"calibration": {"parameters": list(names), "covariance": covariance.tolist()}})


def _scene(axes="xy"):
    """Depth of a slanted wall with a step in it, mm, with projector coordinates and their σ."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    depth = (560 + 2.0 * x - 1.5 * y - np.where(x > 40, 120, 0)).astype(np.float32)
    seen = _rig().epipolar_curve(np.stack((x, y), -1).astype(float), depth.astype(float))
    maps = []
    for i, (axis, sigma) in enumerate((("x", SIGMA_X), ("y", SIGMA_Y))):
        measured = axis in axes
        maps += [seen[..., i] if measured else None, np.full(depth.shape, sigma, np.float32) if measured else None]
    return depth, maps


@pytest.mark.parametrize("axes", ["x", "xy"])
def test_points_scatter_over_rigs_drawn_from_the_covariance_as_sigma_says(axes):
    covariance, (depth, maps) = _covariance(), _scene(axes)
    sigma = sigma_rig(_stating(covariance), depth, maps[1], maps[3])
    ray = _rig().camera.pixel_rays()
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(len(NAMES)), covariance, 400)
    off = [
        ((triangulate(_rig(step), *maps).points - ray * (depth / ray[..., 2])[..., None]) * ray).sum(-1)
        for step in draws
    ]
    ratio = np.std(off, axis=0) / sigma
    # A standard deviation of 400 draws scatters by 3.5 %; neighbours share theirs.
    assert np.abs(ratio - 1).max() < 4.5 * 0.035
    assert sigma.min() > 0.05
    assert sigma.max() / sigma.min() > 1.3


def test_to_first_order_and_between_the_nodes_of_its_grid():
    """Steps along the principal axes through the plain twin of the triangulation, in double precision."""
    covariance, (depth, maps) = _covariance(3), _scene()
    variance, axes = np.linalg.eigh(covariance)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    px = np.stack((x.ravel(), y.ravel()), 1).astype(float)
    sigma = np.repeat([[SIGMA_X], [SIGMA_Y]], len(px), 1)
    measured = np.stack((maps[0].ravel(), maps[2].ravel()))

    def points(steps):
        rig = _rig(steps)
        rays = rig.camera.rays(px)
        z, _, _ = optics.triangulate_plain(
            rays[:, :2], rig.projector.vector, rig.rotation, rig.translation, measured, sigma
        )
        return rays * z[:, None]

    ray = _rig().camera.rays(px)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    steps = 0.1 * np.sqrt(np.maximum(variance, 0))[:, None] * axes.T
    off = [((points(step) - points(-step)) * ray).sum(1) / 0.2 for step in steps]
    expected = np.sqrt(np.sum(np.square(off), axis=0)).reshape(depth.shape)
    weights = np.array([SIGMA_X, SIGMA_Y]) ** -2.0
    exact = along_rays(_rig(), list(NAMES), covariance, px, depth.ravel().astype(float), weights)
    np.testing.assert_allclose(exact.reshape(depth.shape), expected, rtol=2e-4)
    np.testing.assert_allclose(sigma_rig(_stating(covariance), depth, maps[1], maps[3]), expected, rtol=0.02)


def test_square_pixels_move_together():
    """A calibration that holds fx = fy states one of them."""
    covariance, (depth, maps) = _covariance(), _scene()
    both = np.eye(len(NAMES))
    for fx in (0, 9):
        both[fx + 1] = both[fx]
    kept = [i for i, name in enumerate(NAMES) if not name.endswith(".fy")]
    one = sigma_rig(_stating(covariance[np.ix_(kept, kept)], [NAMES[i] for i in kept]), depth, maps[1], maps[3])
    np.testing.assert_allclose(one, sigma_rig(_stating(both @ covariance @ both.T), depth, maps[1], maps[3]), rtol=1e-5)


def test_no_point_no_sigma():
    depth, maps = _scene()
    depth[5:20] = np.nan
    sigma = sigma_rig(_stating(_covariance()), depth, maps[1], maps[3])
    np.testing.assert_array_equal(np.isnan(sigma), np.isnan(depth))
    nowhere = np.full_like(depth, np.nan)
    assert np.isnan(sigma_rig(_stating(_covariance()), nowhere, maps[1], maps[3])).all()


def test_a_rig_that_states_no_covariance_has_no_sigma():
    depth, maps = _scene()
    assert sigma_rig(_rig(), depth, maps[1], maps[3]) is None
    assert sigma_rig(_rig(metadata={"calibration": {"rms": 0.1}}), depth, maps[1], maps[3]) is None


@pytest.mark.parametrize("fault", ["short", "words", "nan", "foreign", "twice", "number", "numbers"])
def test_a_covariance_of_another_program_is_left_out_and_said_so_before_a_scan(fault):
    covariance, names = _covariance(), list(NAMES)
    document = {"parameters": names, "covariance": covariance.tolist()}
    if fault == "short":
        document["covariance"] = covariance[:-1].tolist()
    elif fault == "words":
        document["covariance"] = "large"
    elif fault == "nan":
        document["covariance"][0][0] = float("nan")
    else:
        document["parameters"] = {
            "foreign": [*names[:-1], "tripod.height"],
            "twice": [names[0], *names[:-1]],
            "number": len(names),
            "numbers": list(range(len(names))),
        }[fault]
    depth, maps = _scene()
    rig = _rig(metadata={"calibration": document})
    assert sigma_rig(rig, depth, maps[1], maps[3]) is None
    said = covariance_fault(rig)
    assert "covariance" in said
    assert "without sigma_rig" in said
    assert Decoder(METHODS["tps"], ScanSection(), NoiseModel(1.0), rig).warnings == [said]


def test_nothing_is_said_of_a_rig_whose_covariance_is_used_or_that_has_none():
    for rig in (_stating(_covariance()), _rig(), _rig(metadata={"calibration": {"rms": 0.1}})):
        assert covariance_fault(rig) is None
        assert Decoder(METHODS["tps"], ScanSection(), NoiseModel(1.0), rig).warnings == []


def test_parameters_that_no_rig_has_are_refused():
    with pytest.raises(RigError, match=r"tripod\.height"):
        along_rays(_rig(), ["tripod.height"], np.eye(1), np.zeros((1, 2)), np.array([500.0]), np.ones(2))
