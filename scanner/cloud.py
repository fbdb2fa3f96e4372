"""The point cloud: what the maps hold as points with normals, brightness and σ, and its PLY and PCD files."""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drivers.errors import OperatorError
from drivers.libusb import load_libusb
from scanner.optics import in_blocks

Map = NDArray[np.float32]

_STEEPEST = 6.0  # a surface turned further than this slope (81°) from facing the camera counts as a jump
_JUMP_SIGMAS = 5.0
_NORMAL_NOISE_RAD = 0.03
_FARTHEST_PX = 8
# Bytes of one point as Open3D writes it: ten floats less the colour's width (PLY 3 × uchar, PCD one packed word).
_RECORD_BYTES = {".ply": 31, ".pcd": 32}


class CloudError(OperatorError):
    """A point cloud cannot be made or written."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in the camera frame.

    Parameters
    ----------
    points
        (N, 3) float32, mm; x right, y down, z forward, the camera at the origin.
    normals
        (N, 3) float32 unit vectors that look to the camera's side; NaN where a point has no neighbours.
    sigma
        (N,) float32 predicted standard deviation along the viewing ray, mm.
    grey
        (N,) uint8 brightness.
    simulated
        True where no light was involved; files are stamped with it.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigma: NDArray[np.float32]
    grey: NDArray[np.uint8]
    simulated: bool

    @classmethod
    def from_grid(cls, points: Map, sigma: Map, brightness: Map, *, simulated: bool) -> Self:
        """Collect the valid pixels of a scan.

        Parameters
        ----------
        points
            (H, W, 3) mm in the camera frame, NaN where invalid.
        sigma
            (H, W) standard deviation along the viewing ray, mm.
        brightness
            (H, W) mean grey value, DN; the brightest per cent of the points becomes white.
        simulated
            See `Cloud`.
        """
        valid = np.isfinite(points).all(axis=-1)
        value = brightness[valid]
        white = float(np.percentile(value, 99)) if value.size else 0.0
        return cls(
            points=points[valid],
            normals=grid_normals(points, sigma)[valid],
            sigma=sigma[valid],
            grey=np.clip(value * (255 / max(white, 1e-6)) + 0.5, 0, 255).astype(np.uint8),
            simulated=simulated,
        )

    def save(self, path: str | Path) -> None:
        """Write a binary PLY or PCD file, as the suffix says.

        The vertex properties are x y z nx ny nz, red green blue (all the grey value) and the float ``sigma``. The
        header's comments name unit and frame, and say SIMULATED DATA where it is so. The file appears when complete.

        Raises
        ------
        CloudError
            Another suffix, a cloud without points, or a place that cannot be written or is full.
        """
        path = Path(path)
        record = _RECORD_BYTES.get(path.suffix)
        if record is None:
            raise CloudError(f"{path}: unknown kind of point cloud", "Name the file .ply or .pcd.")
        if not len(self.points):
            raise CloudError(
                f"{path}: the cloud has no points",
                "Look at the scan's flags: most often the exposure or the modulation is too low.",
            )
        try:
            with tempfile.TemporaryDirectory(prefix=".cloud-", dir=path.parent) as folder:
                bare, complete = Path(folder, f"bare{path.suffix}"), Path(folder, f"complete{path.suffix}")
                self._write(bare)
                with open(bare, "rb") as source, open(complete, "wb") as target:
                    for line in self._header(source):
                        target.write(line)
                    # Open3D reports success on a full disk; the size tells.
                    if bare.stat().st_size != source.tell() + record * len(self.points):
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                    shutil.copyfileobj(source, target, 1 << 22)
                complete.replace(path)
        except OSError as error:
            raise CloudError(
                f"cannot write {path}: {error.strerror or error}",
                "Choose a place that can be written and has room.",
            ) from None

    def _write(self, path: Path) -> None:
        """Let Open3D write the file, without comments of ours."""
        o3d = _open3d()
        tensor = o3d.core.Tensor
        cloud = o3d.t.geometry.PointCloud()
        cloud.point.positions = tensor(np.ascontiguousarray(self.points, np.float32))
        cloud.point.normals = tensor(np.ascontiguousarray(self.normals, np.float32))
        cloud.point.colors = tensor(np.repeat(self.grey[:, None], 3, axis=1))
        cloud.point.sigma = tensor(np.ascontiguousarray(self.sigma[:, None], np.float32))
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            if not o3d.t.io.write_point_cloud(str(path), cloud, write_ascii=False, compressed=False):
                raise OSError(errno.EIO, "Open3D could not write the file")

    def _header(self, source: IO[bytes]) -> Iterator[bytes]:
        """Header lines of the file at ``source`` with our comments put in; leaves ``source`` at the data."""
        ply = source.readline() == b"ply\n"
        source.seek(0)
        mark, after, last = (b"comment", b"format", b"end_header") if ply else (b"#", b"#", b"DATA")
        for line in source:
            yield line
            if line.startswith(after):
                for comment in self._comments():
                    yield b"%s %s\n" % (mark, comment.encode("ascii"))
            if line.startswith(last):
                return

    def _comments(self) -> list[str]:
        stamp = ["SIMULATED DATA"] if self.simulated else []
        return [
            *stamp,
            "unit: mm",
            "frame: camera (x right, y down, z forward, origin at the centre of projection)",
            "sigma: predicted standard deviation along the viewing ray, mm",
        ]


def grid_normals(points: Map, sigma: Map) -> NDArray[np.float32]:
    """Surface normals of an organised grid: the cross product of differences along rows and columns.

    A difference spans from a pixel's furthest neighbour on one side to that on the other: central on a surface,
    one-sided at its border. Neighbours are reached pixel by pixel and never across a depth jump, a step in z above
    both five σ and a slope of 81°; at most as far (8 px) as keeps the noise of a typical normal near 0.03 rad.

    Parameters
    ----------
    points
        (H, W, 3) mm in the camera frame, NaN where invalid.
    sigma
        (H, W) standard deviation along the viewing ray, mm.

    Returns
    -------
    (H, W, 3) float32 unit vectors on the camera's side of the surface; NaN for lone and invalid points.
    """
    points, sigma = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(sigma, np.float32)
    reach = _reach(points, sigma)
    # Whether a pixel is joined to the next one of its row, and of its column.
    right, down = np.zeros(sigma.shape, bool), np.zeros(sigma.shape, bool)
    out = np.empty(points.shape, np.float32)
    in_blocks(len(points), lambda begin, end: _join(points, sigma, right, down, begin, end))
    in_blocks(len(points), lambda begin, end: _cross(points, right, down, reach, out, begin, end))
    return out


def _reach(points: Map, sigma: Map) -> int:
    """Half-width (px) of the differences: σ √2 / (2 · reach · pitch) is the noise of a slope."""
    rows = slice(None, None, max(1, len(points) // 256))
    depth = points[rows, :, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        pitch = depth[:, 1:] * np.abs(np.diff(points[rows, :, 0] / depth))
        noise = sigma[rows, 1:] / pitch
    noise = noise[np.isfinite(noise)]
    if not noise.size:
        return 1
    return min(_FARTHEST_PX, max(1, math.ceil(float(np.median(noise)) / (math.sqrt(2) * _NORMAL_NOISE_RAD))))


@njit(cache=True, nogil=True, error_model="numpy")
def _near(points: Any, sigma: Any, r: int, c: int, r2: int, c2: int) -> bool:
    """Whether no depth jump lies between two neighbouring pixels; False where one is NaN."""
    z, z2 = points[r, c, 2], points[r2, c2, 2]
    x, x2 = points[r, c, 0] / z, points[r2, c2, 0] / z2
    y, y2 = points[r, c, 1] / z, points[r2, c2, 1] / z2
    pitch = 0.5 * (z + z2) * math.hypot(x - x2, y - y2)
    return bool(abs(z - z2) <= _JUMP_SIGMAS * math.hypot(sigma[r, c], sigma[r2, c2]) + _STEEPEST * pitch)


@njit(cache=True, nogil=True, error_model="numpy")
def _join(points: Any, sigma: Any, right: Any, down: Any, begin: int, end: int) -> None:
    height, width = sigma.shape
    for r in range(begin, end):
        for c in range(width):
            right[r, c] = c + 1 < width and _near(points, sigma, r, c, r, c + 1)
            down[r, c] = r + 1 < height and _near(points, sigma, r, c, r + 1, c)


@njit(cache=True, nogil=True, error_model="numpy")
def _cross(points: Any, right: Any, down: Any, reach: int, out: Any, begin: int, end: int) -> None:
    for r in range(begin, end):
        for c in range(right.shape[1]):
            c0 = c1 = c
            while c - c0 < reach and c0 > 0 and right[r, c0 - 1]:
                c0 -= 1
            while c1 - c < reach and right[r, c1]:
                c1 += 1
            r0 = r1 = r
            while r - r0 < reach and r0 > 0 and down[r0 - 1, c]:
                r0 -= 1
            while r1 - r < reach and down[r1, c]:
                r1 += 1
            x, y, z = (
                points[r, c1, 0] - points[r, c0, 0],
                points[r, c1, 1] - points[r, c0, 1],
                points[r, c1, 2] - points[r, c0, 2],
            )
            u, v, w = (
                points[r1, c, 0] - points[r0, c, 0],
                points[r1, c, 1] - points[r0, c, 1],
                points[r1, c, 2] - points[r0, c, 2],
            )
            nx, ny, nz = y * w - z * v, z * u - x * w, x * v - y * u
            towards = -(nx * points[r, c, 0] + ny * points[r, c, 1] + nz * points[r, c, 2])
            # A pixel without a neighbour in its row or column has a difference of length 0: 0/0 leaves it NaN.
            scale = math.copysign(1.0, towards) / math.sqrt(nx * nx + ny * ny + nz * nz)
            out[r, c, 0], out[r, c, 1], out[r, c, 2] = nx * scale, ny * scale, nz * scale


def _open3d() -> Any:
    """Import Open3D, which needs libusb first."""
    load_libusb()
    import open3d

    return open3d
