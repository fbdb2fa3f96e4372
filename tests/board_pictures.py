"""Pictures of boards whose points are known: rays from camera pixels to the print, many for each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from calibration.observations import BoardPose

DARK_DN, WHITE_DN, BEHIND_DN = 22.0, 190.0, 60.0


@dataclass(frozen=True)
class View:
    """A camera before a board."""

    pose: BoardPose
    matrix: np.ndarray
    distortion: np.ndarray
    size: tuple[int, int] = (1024, 768)

    @property
    def rotation(self):
        x, y, z = (math.radians(a) for a in (self.pose.pitch_deg, self.pose.yaw_deg, self.pose.roll_deg))
        about_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
        about_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
        about_z = np.array([[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]])
        return about_x @ about_y @ about_z

    @property
    def translation(self):
        return np.array([self.pose.offset_x_mm, self.pose.offset_y_mm, self.pose.distance_mm], float)

    def project(self, points):
        turn = cv2.Rodrigues(self.rotation)[0]
        points = np.asarray(points, float).reshape(-1, 1, 3)
        return cv2.projectPoints(points, turn, self.translation, self.matrix, self.distortion)[0].reshape(-1, 2)

    def on_board(self, pixels):
        """(n, 2) mm, where rays of pixels (n, 2) meet the board's plane."""
        bent = (np.asarray(pixels, float) - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        rays = bent.copy()
        for _ in range(60):  # a fixed point of the radial model, to rounding
            squared = (rays**2).sum(axis=1, keepdims=True)
            rays = bent / (1 + self.distortion[0] * squared + self.distortion[1] * squared**2)
        rays = np.column_stack((rays, np.ones(len(rays)))) @ self.rotation
        origin = -self.translation @ self.rotation
        return (origin - rays * (origin[2] / rays[:, 2:]))[:, :2]


def camera(focal=1400.0, k1=0.0, k2=0.0, size=(1024, 768)):
    matrix = np.array([[focal, 0, size[0] / 2 - 3.3], [0, focal, size[1] / 2 + 2.1], [0, 0, 1]])
    return matrix, np.array([k1, k2, 0.0, 0.0, 0.0])


def picture(view, board, blur_px=0.7, fine=6, light=(0.15, -0.1)):
    """(H, W) noise-free grey values of a board; ``light`` is the slope of the illumination over the picture."""
    width, height = view.size
    image = np.full((height, width), BEHIND_DN)
    window, white = rendered(view, board, lambda u, v: albedo(board, u, v), blur_px, fine)
    image[window] = white
    slope_x, slope_y = np.meshgrid(np.linspace(-1, 1, width) * light[0], np.linspace(-1, 1, height) * light[1])
    return image * (1 + slope_x + slope_y)


def phasors(view, board, projector, frequency, blur_px=0.7, fine=4):
    """(H, W) complex, what a camera records of the fringes exp(i 2π f x_p) on a board, NaN off the sheet.

    ``projector`` maps points (n, 3) of the board to projector columns (n,).
    """
    width, height = view.size

    def light(u, v):
        # Columns are smooth over the board: exact on a grid, cubic in between.
        x, y = np.asarray(board.size_mm) * 0.7
        grid_u, grid_v = np.linspace(-x, x, 90), np.linspace(-y, y, 80)
        points = np.stack([*np.meshgrid(grid_u, grid_v), np.zeros((80, 90))], axis=2).reshape(-1, 3)
        column = RectBivariateSpline(grid_v, grid_u, projector(points).reshape(80, 90)).ev(v, u)
        return albedo(board, u, v) / 2.2 * np.exp(2j * np.pi * frequency * column)

    window, z = rendered(view, board, light, blur_px, fine)
    image = np.full((height, width), np.nan, complex)
    image[window] = z
    return image


def rendered(view, board, value, blur_px, fine):
    """The part of the picture around the sheet as slices, and ``value(u, v)`` of the print blurred and binned there."""
    width, height = view.size
    x, y = board.size_mm
    sheet = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) / 2
    outline = view.project(sheet)
    rim = math.ceil(4 * blur_px) + 8
    left, top = np.maximum(np.floor(outline.min(axis=0)).astype(int) - rim, 0)
    right, bottom = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + rim, (width - 1, height - 1))
    columns, rows = right - left + 1, bottom - top + 1
    # Where the print is seen is smooth: exact on every fourth pixel, cubic in between.
    coarse_x, coarse_y = np.arange(left - 8, right + 13, 4.0), np.arange(top - 8, bottom + 13, 4.0)
    grid = np.stack(np.meshgrid(coarse_x, coarse_y), axis=2)
    places = view.on_board(grid.reshape(-1, 2)).reshape(grid.shape)
    within = (np.arange(fine) + 0.5) / fine - 0.5
    fine_x = (np.arange(left, right + 1)[:, None] + within).ravel()
    fine_y = (np.arange(top, bottom + 1)[:, None] + within).ravel()
    u, v = (RectBivariateSpline(coarse_y, coarse_x, places[..., i])(fine_y, fine_x) for i in range(2))
    values = value(u, v)
    parts = [values.real, values.imag] if np.iscomplexobj(values) else [values]
    binned = [
        cv2.GaussianBlur(part.astype(np.float32), (0, 0), blur_px * fine, borderType=cv2.BORDER_REPLICATE)
        .reshape(rows, fine, columns, fine)
        .mean(axis=(1, 3))
        for part in parts
    ]
    window = np.s_[top : bottom + 1, left : right + 1]
    return window, binned[0] + 1j * binned[1] if len(binned) == 2 else binned[0]


def albedo(board, u, v):
    """Grey values of the print at (u, v) mm, from what the kind of board means, not from its polygons.

    Edges are ramps as wide as the distance of two samples, so that none of them jumps to a sample.
    """
    width, height = board.size_mm
    ramp_u, ramp_v = (sum(np.abs(slope) for slope in np.gradient(w)) for w in (u, v))
    if board.kind == "chessboard":
        p, inside_p = _stripes(u, ramp_u, board.square_mm, board.columns + 1)
        q, inside_q = _stripes(v, ramp_v, board.square_mm, board.rows + 1)
        dark = inside_p * inside_q * (1 + p * q) / 2
    elif board.kind == "charuco":
        scale = 12  # px per mm
        size = [round(side * scale) for side in board.pattern_mm]
        printed = cv2.copyMakeBorder(board.opencv.generateImage(size), *(4,) * 4, cv2.BORDER_CONSTANT, value=255)
        x, y = (w * scale + side / 2 + 3.5 for w, side in ((u, size[0]), (v, size[1])))
        dark = 1 - cv2.remap(
            printed, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
            borderValue=255,
        ) / 255  # fmt: skip
    else:
        rows = np.rint(v / board.spacing_mm + (board.rows - 1) / 2).clip(0, board.rows - 1)
        y = (rows - (board.rows - 1) / 2) * board.spacing_mm
        if board.kind == "circles":
            x0, step = -(board.columns - 1) / 2 * board.spacing_mm, board.spacing_mm
        else:
            x0 = (rows % 2 - (2 * board.columns - 1) / 2) * board.spacing_mm
            step = 2 * board.spacing_mm
        columns = np.rint((u - x0) / step).clip(0, board.columns - 1)
        du, dv = u - x0 - columns * step, v - y
        reach = np.hypot(du, dv)
        ramp = np.hypot(ramp_u * du, ramp_v * dv) / np.maximum(reach, 1e-9)
        dark = np.clip(0.5 + (board.diameter_mm / 2 - reach) / np.maximum(ramp, 1e-9), 0, 1)
    inside = (np.abs(u) < width / 2) & (np.abs(v) < height / 2)
    return np.where(inside, WHITE_DN + (DARK_DN - WHITE_DN) * dark, BEHIND_DN)


def _stripes(w, ramp, side, count):
    """±1 in turn, with ramps between, and the share of each sample that lies on the squares."""
    place = w / side + count / 2
    edge = np.rint(place)
    inside = np.clip(0.5 + (count / 2 - np.abs(w / side)) / (ramp / side), 0, 1)
    # Left of an even edge lies an odd square.
    return np.where(edge % 2 == 0, 1, -1) * np.clip((place - edge) / (ramp / side) * 2, -1, 1), inside


def exposed(clean, noise_dn, rng):
    """(H, W) uint8 with noise."""
    return np.clip(np.rint(clean + rng.normal(0, noise_dn, clean.shape)), 0, 255).astype(np.uint8)
