"""Camera and projector as one instrument: two lenses, their relative pose, and the files that hold them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import OperatorError
from scanner import optics

_FORMAT, _VERSION = "mfs-scanner rig", 1
_RIG_KEYS = frozenset({"format", "version", "camera", "projector", "rotation", "translation_mm"})
_RIG_NOTES = frozenset({"metadata"})
_LENS_KEYS = frozenset({"matrix", "distortion", "size"})
_DISTORTION_TERMS = (0, 4, 5, 8, 12, 14)
_BLOCK = 1 << 16  # points per thread and turn: below it a thread costs more than it saves


class RigError(OperatorError):
    """A rig, or the file it should come from, is not usable."""

    def inside(self, place: str) -> RigError:
        """Say where the error was found."""
        return RigError(f"{place}: {self.message}", self.remedy)


def _numbers(name: str, values: Any, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Copy ``values`` to a read-only float64 array; refuse what is not finite or not of ``shape``."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise RigError(f"{name} is not an array of numbers", f"Write {name} as a list of numbers.") from None
    if shape is not None and array.shape != shape:
        raise RigError(f"{name} has shape {array.shape}, not {shape}", f"Give {name} as {shape} numbers.")
    if not np.isfinite(array).all():
        raise RigError(f"{name} holds values that are not finite", "Repeat the calibration.")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera, or a projector seen as one: pinhole and distortion as OpenCV defines them.

    Parameters
    ----------
    matrix
        (3, 3) camera matrix, px, without skew (OpenCV's model has none).
    distortion
        0, 4, 5, 8, 12 or 14 terms in OpenCV order: k1, k2, p1, p2, k3, k4…k6, s1…s4, τx, τy.
    size
        (width, height), px.

    Raises
    ------
    RigError
        Wrong shapes, values that are not finite, a focal length or size that is not positive, skew.
    """

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        matrix = _numbers("matrix", self.matrix, (3, 3))
        distortion = _numbers("distortion", self.distortion).reshape(-1)
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise RigError(
                f"focal lengths must be positive, not {matrix[0, 0]:g} and {matrix[1, 1]:g} px",
                "Check the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], or repeat the calibration.",
            )
        if not np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
            raise RigError(
                "matrix is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
                "Calibrate without skew; if the matrix was written column by column, transpose it.",
            )
        if distortion.size not in _DISTORTION_TERMS:
            raise RigError(
                f"distortion has {distortion.size} terms",
                "Give 0, 4, 5, 8, 12 or 14 terms in the order of OpenCV: k1, k2, p1, p2, k3, …",
            )
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "size", _size(self.size))

    @cached_property
    def vector(self) -> NDArray[np.float64]:
        """(26,) the lens as the kernels of `scanner.optics` take it."""
        vector = optics.lens_vector(self.matrix, self.distortion)
        vector.flags.writeable = False
        return vector

    def project(self, X: ArrayLike) -> NDArray[np.float64]:
        """Pixels of points in the lens's own frame.

        Parameters
        ----------
        X
            (..., 3) mm.

        Returns
        -------
        (..., 2) px, NaN where z ≤ 0 or so far off the axis that the distortion model folds back.
        """
        points = np.asarray(X, np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        out = np.empty((len(flat), 2))
        optics.in_blocks(
            len(flat), lambda i, j: optics.project_points(self.vector, flat[i:j], out[i:j]), at_least=_BLOCK
        )
        return out.reshape(*points.shape[:-1], 2)

    def rays(self, px: ArrayLike) -> NDArray[np.float64]:
        """Undistorted viewing directions of pixels.

        Parameters
        ----------
        px
            (..., 2) px, inside the image or not.

        Returns
        -------
        (..., 3) directions with z = 1, exact to rounding (`project` gives the pixel back); NaN where the
        distortion model reaches no such pixel.
        """
        pixels = np.asarray(px, np.float64)
        flat = np.ascontiguousarray(pixels.reshape(-1, 2))
        out = np.empty((len(flat), 3))
        optics.in_blocks(
            len(flat), lambda i, j: optics.pixel_directions(self.vector, flat[i:j], out[i:j]), at_least=_BLOCK
        )
        return out.reshape(*pixels.shape[:-1], 3)

    def pixel_rays(self) -> NDArray[np.float32]:
        """(height, width, 3) float32 `rays` of all pixel centres."""
        width, height = self.size
        out = np.empty((height, width, 3), np.float32)

        def rows(begin: int, end: int) -> None:
            directions = np.empty((width, 2))
            for row in range(begin, end):
                optics.row_directions(self.vector, float(row), directions)
                out[row, :, :2] = directions
                out[row, :, 2] = np.where(np.isnan(directions[:, 0]), np.nan, 1.0)

        optics.in_blocks(height, rows)
        return out

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document."""
        return {
            "matrix": self.matrix.tolist(),
            "distortion": self.distortion.tolist(),
            "size": list(self.size),
        }

    @classmethod
    def from_json(cls, document: Any) -> Self:
        """Inverse of `to_json`."""
        _check_keys(document, _LENS_KEYS)
        return cls(document["matrix"], document["distortion"], document["size"])


@dataclass(frozen=True, eq=False)
class Rig:
    """A camera and a projector; the origin is the camera, lengths are mm.

    Parameters
    ----------
    camera, projector
        The lenses.
    rotation
        (3, 3), with ``translation``: X_proj = rotation @ X_cam + translation.
    translation
        (3,) mm.
    metadata
        JSON-ready notes: where the rig comes from, reprojection errors, dates.

    Raises
    ------
    RigError
        Wrong shapes, or a rotation that is none.
    """

    camera: Lens
    projector: Lens
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rotation = _numbers("rotation", self.rotation, (3, 3))
        translation = _numbers("translation", _numbers("translation", self.translation).squeeze(), (3,))
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        determinant = float(np.linalg.det(rotation))
        # Six printed digits leave 1e-6; anything coarser bends space by more than a scan can bear.
        if error > 1e-5 or determinant < 0:
            raise RigError(
                f"rotation is not a rotation: R Rᵀ differs from 1 by {error:.2g}, det R = {determinant:.6g}",
                "Give the 3×3 matrix R of X_proj = R X_cam + T with seven digits, or repeat the calibration.",
            )
        if not translation.any():
            raise RigError(
                "translation is zero: camera and projector stand at one place",
                "Depth needs a baseline: give the translation of X_proj = R X_cam + T in mm.",
            )
        if not isinstance(self.metadata, Mapping):
            raise RigError("metadata is not an object with named notes", "Write metadata as {} or leave it out.")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @property
    def projector_centre_cam(self) -> NDArray[np.float64]:
        """(3,) the projector's centre of projection in the camera frame, mm."""
        return -self.rotation.T @ self.translation

    def to_projector_frame(self, X_cam: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) from the camera's into the projector's frame, mm."""
        return np.asarray(X_cam, np.float64) @ self.rotation.T + self.translation

    def epipoles(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image (2,) of the projector's centre in the camera and of the camera's centre in the projector, px.

        Pinhole images without distortion, because epipoles commonly lie far outside the pictures; a centre
        seen at a right angle gives inf.
        """
        return (
            _pinhole(self.camera.matrix, self.projector_centre_cam),
            _pinhole(self.projector.matrix, self.translation),
        )

    def epipolar_line(self, px: ArrayLike) -> NDArray[np.float64]:
        """Lines in the undistorted projector picture on which the points of camera pixels lie.

        Parameters
        ----------
        px
            (..., 2) camera px.

        Returns
        -------
        (..., 3) coefficients of a·x + b·y + c = 0 with a² + b² = 1 and x, y in px of a projector without
        distortion: l = Kp⁻ᵀ (T × R d) (Hartley & Zisserman, Multiple View Geometry, 2004, ch. 9).
        `epipolar_curve` is what the real lens makes of it.
        """
        turned = self.camera.rays(px) @ self.rotation.T
        lines = np.cross(self.translation, turned) @ np.linalg.inv(self.projector.matrix)
        return np.asarray(lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True))

    def epipolar_curve(self, px: ArrayLike, depth: ArrayLike) -> NDArray[np.float64]:
        """Projector px (..., 2) of the points that camera pixels see at given depths, distortion included.

        Parameters
        ----------
        px
            (..., 2) camera px.
        depth
            (...) mm along the camera's z; broadcasts with ``px``.
        """
        points = self.camera.rays(px) * np.asarray(depth, np.float64)[..., None]
        return self.projector.project(self.to_projector_frame(points))

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; the inverse of `from_json`."""
        return {
            "format": _FORMAT,
            "version": _VERSION,
            "camera": self.camera.to_json(),
            "projector": self.projector.to_json(),
            "rotation": self.rotation.tolist(),
            "translation_mm": self.translation.tolist(),
            "metadata": dict(self.metadata),
        }

    @classmethod
    def from_json(cls, document: Any) -> Self:
        """Rig of a document that `to_json` wrote, or an error that names the field."""
        _check_keys(document, _RIG_KEYS, _RIG_NOTES)
        kind, version = document["format"], document["version"]
        if (kind, version) != (_FORMAT, _VERSION):
            raise RigError(
                f"{kind!r} version {version!r} is not {_FORMAT!r} version {_VERSION}",
                "Read it with the version of this program that wrote it, or save the rig again.",
            )
        lenses = {}
        for name in ("camera", "projector"):
            try:
                lenses[name] = Lens.from_json(document[name])
            except RigError as error:
                raise error.inside(name) from None
        return cls(
            lenses["camera"],
            lenses["projector"],
            document["rotation"],
            document["translation_mm"],
            document.get("metadata", {}),
        )

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        camera_size: tuple[int, int] | None = None,
        projector_size: tuple[int, int] | None = None,
    ) -> Self:
        """Read a rig from its own JSON or from an OpenCV FileStorage (.xml, .yml, .json, also .gz).

        Parameters
        ----------
        path
            The file. A FileStorage may use the names of SLStudio (Kc, kc, Kp, kp, Rp, Tp, frameWidth, …), of
            Moreno & Taubin's scan3d (cam_K, cam_kc, proj_K, …) or of `cv2.stereoCalibrate` with the camera as
            first and the projector as second view (K1 or M1 or cameraMatrix1, D1 or distCoeffs1, …, R, T).
            Its T is taken as mm.
        camera_size, projector_size
            (width, height), px, for files that do not say; refused where the file says otherwise.

        Raises
        ------
        RigError
            The file is missing, unreadable, incomplete, ambiguous or not a valid rig.
        """
        path = Path(path)
        sizes = {"camera": camera_size, "projector": projector_size}
        if not path.is_file():
            raise RigError(f"rig file {path} does not exist", "Check the path, or calibrate the bench first.")
        try:
            document = _read_own(path) or _read_opencv(path, sizes)
            for name, size in sizes.items():
                lens = document.get(name)
                if size and isinstance(lens, Mapping) and list(lens.get("size", size)) != list(size):
                    raise RigError(
                        f"the {name} is {lens['size']} px, but {list(size)} px is asked for",
                        "Use the rig that was calibrated for this picture size.",
                    )
            return cls.from_json(document)
        except RigError as error:
            raise error.inside(str(path)) from None

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON; a rig that was there is replaced whole or not at all."""
        path = Path(path)
        partial = path.with_name(f".{path.name}.partial")
        try:
            partial.write_text(json.dumps(self.to_json(), indent=2) + "\n", encoding="utf-8")
            partial.replace(path)
        except OSError as error:
            raise RigError(
                f"cannot write rig {path}: {error.strerror}", "Choose a place that can be written."
            ) from None


def _pinhole(matrix: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((matrix @ X)[:2] / X[2])


def _size(values: Any) -> tuple[int, int]:
    size = _numbers("size", values, (2,))
    if not all(v > 0 and math.isfinite(v) and v == int(v) for v in size):
        raise RigError(f"size {list(values)} is not (width, height) in whole px", "Give the size as [width, height].")
    return int(size[0]), int(size[1])


# What other programs call the parts of a rig in a FileStorage. In a stereo calibration the camera is view 1.
_OPENCV_NAMES = {
    "camera matrix": ("Kc", "cam_K", "K1", "M1", "cameraMatrix1"),
    "camera distortion": ("kc", "cam_kc", "D1", "distCoeffs1"),
    "projector matrix": ("Kp", "proj_K", "K2", "M2", "cameraMatrix2"),
    "projector distortion": ("kp", "proj_kc", "D2", "distCoeffs2"),
    "rotation": ("Rp", "R"),
    "translation": ("Tp", "T"),
}
_OPENCV_SIZES = {
    "camera": (("frameWidth", "frameHeight"), ("image_width", "image_height")),
    "projector": (("screenResX", "screenResY"),),
}


def _read_own(path: Path) -> dict[str, Any] | None:
    """Read the rig document in a JSON file; None where the file is no JSON or is OpenCV's."""
    if path.suffix.lower() != ".json":
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RigError(f"cannot be read as JSON: {error}", "Take the file from a backup, or calibrate again.") from None
    written_by_opencv = isinstance(document, dict) and any(
        isinstance(value, dict) and "type_id" in value for value in document.values()
    )
    if written_by_opencv:
        return None
    _check_keys(document, _RIG_KEYS, _RIG_NOTES)
    return dict(document)


def _read_opencv(path: Path, sizes: Mapping[str, tuple[int, int] | None]) -> dict[str, Any]:
    """Read the rig document that an OpenCV FileStorage amounts to."""
    import cv2

    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        root = storage.root()
        content = {key: _node_values(root.getNode(key)) for key in root.keys()}  # noqa: SIM118 - not a dict
    except (cv2.error, SystemError):
        raise RigError(
            "is neither a rig of this program nor an OpenCV FileStorage",
            "Give a rig JSON, or the XML or YAML file that cv::FileStorage wrote.",
        ) from None
    found = {}
    for part, names in _OPENCV_NAMES.items():
        present = [name for name in names if content.get(name) is not None]
        if len(present) != 1:
            raise RigError(
                f"{'more than one' if present else 'no'} {part}: looked for {', '.join(names)}"
                + (f", found {', '.join(present)}" if present else ""),
                f"Name the {part} {names[0]}, once.",
            )
        found[part] = content.pop(present[0])
    for lens, pairs in _OPENCV_SIZES.items():
        stated = [pair for pair in pairs if all(content.get(name) is not None for name in pair)]
        if stated:
            found[f"{lens} size"] = [content.pop(name) for name in stated[0]]
        elif sizes[lens] is not None:
            found[f"{lens} size"] = list(sizes[lens] or ())
        else:
            raise RigError(
                f"does not say the size of the {lens} picture",
                f"Add {pairs[0][0]} and {pairs[0][1]} (px) to the file as plain numbers.",
            )
    return {
        "format": _FORMAT,
        "version": _VERSION,
        **{
            lens: {key: found[f"{lens} {key}"] for key in ("matrix", "distortion", "size")}
            for lens in ("camera", "projector")
        },
        "rotation": found["rotation"],
        "translation_mm": found["translation"],
        "metadata": {
            "source": path.name,
            **{k: v for k, v in content.items() if isinstance(v, int | float | str)},
        },
    }


def _node_values(node: Any) -> Any:
    """Read a FileStorage node: a matrix, a list, a number, a text, or None for anything else."""
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_node_values(node.at(i)) for i in range(node.size())]
    return node.mat() if node.isMap() and not node.getNode("dt").empty() else None


def _check_keys(document: Any, required: frozenset[str], optional: frozenset[str] = frozenset()) -> None:
    if not isinstance(document, Mapping):
        raise RigError("not a JSON object", f"Give an object with the keys {', '.join(sorted(required))}.")
    missing, unknown = required - set(document), set(document) - required - optional
    if missing or unknown:
        found = [
            f"{name} {', '.join(sorted(keys))}" for name, keys in (("missing", missing), ("unknown", unknown)) if keys
        ]
        raise RigError("; ".join(found), f"The keys are {', '.join(sorted(required | optional))}.")
