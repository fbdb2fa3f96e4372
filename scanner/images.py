"""Frames that others recorded: a folder of images with a small plan file that says what they show.

# plan.yaml, beside the images
projector: {width: 1824, height: 1140}
files: "*.png"                                # in natural order; or a list of names
phase: {sign: -1, first_step: 0}              # I = A + B cos(2πu/p + sign · 2π(i + first_step)/N), i = 0..N-1
sequences:                                    # in the order of the files
- {axis: x, period_px: 114, steps: 3}
- {axis: x, period_px: 1824, steps: 3}
rig: calibration.xml                          # optional: own JSON or OpenCV FileStorage
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers import FrameFormat, NoiseModel, OperatorError, Pixels
from scanner.config import check_plan_covers
from scanner.config.explain import explain
from scanner.config.source import read_source
from scanner.integrity import repeated_frames
from scanner.patterns import Fringe, FringeSequence, Plan

PLAN_FILE = "plan.yaml"

_DARK_DN = 0.02
"""Share of full scale that the brightest pixel of a lit frame exceeds."""


class ImagesError(OperatorError):
    """The images do not hold what the plan file says."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ProjectorSize(_Section):
    """The projector's picture."""

    width: int = Field(ge=16, description="Columns of the projected picture, px.")
    height: int = Field(ge=16, description="Rows of the projected picture, px.")


class PhaseConvention(_Section):
    """Frame i of N steps shows A + B cos(2πu/p + sign · 2π(i + first_step)/N)."""

    sign: Literal[1, -1] = Field(1, description="Sense of the phase steps.")
    first_step: float = Field(1, description="Step of the first frame, in units of 2π/N.")


class RecordedSequence(_Section):
    """Consecutive images of one fringe."""

    axis: Literal["x", "y"] = Field(description="x: the fringes vary along the columns; y: along the rows.")
    period_px: float = Field(gt=2, description="Fringe period, projector px.")
    steps: int = Field(ge=3, description="Images of this fringe.")
    first_file: int | None = Field(
        None, ge=0, description="Number of its first image in the order of the files; null: after the one before."
    )


class RecordedNoise(_Section):
    """Noise of a grey value: variance = read_dn² + dn_per_electron · grey value."""

    read_dn: float = Field(gt=0, description="Standard deviation in the dark, DN.")
    dn_per_electron: float = Field(0.0, ge=0, description="Conversion gain, DN per electron.")


class FramesPlan(_Section):
    """What a folder of images shows."""

    projector: ProjectorSize
    files: str | Annotated[list[str], Field(min_length=1)] = Field(
        "*.png", description="Pattern of the image names, taken in natural order, or a list of names in order."
    )
    phase: PhaseConvention = Field(default_factory=PhaseConvention)
    sequences: list[RecordedSequence] = Field(min_length=1, description="Sequences in the order of the files.")
    bits: int | None = Field(None, ge=8, le=16, description="Significant bits of a grey value; null: of the files.")
    noise: RecordedNoise | None = Field(None, description="Noise of the camera; null: from the frames themselves.")
    rig: str | None = Field(None, description="Calibrated rig, relative to this file; null: coordinates only.")


@dataclass(frozen=True)
class RecordedFrames:
    """A checked folder of images.

    Parameters
    ----------
    folder
        Where the images are.
    plan
        What they show.
    frame_format
        What they look like.
    files
        One tuple of paths per sequence of the plan.
    noise
        As the plan file has it.
    rig_path
        Where the rig is, or None.
    """

    folder: Path
    plan: Plan
    frame_format: FrameFormat
    files: tuple[tuple[Path, ...], ...]
    noise: NoiseModel | None
    rig_path: Path | None

    def sequences(self) -> Iterator[tuple[int, Pixels]]:
        """Read sequence after sequence: its number and its (N, H, W) frames.

        Raises
        ------
        ImagesError
            An image is truncated, has another size, is black, or repeats another.
        """
        for number, paths in enumerate(self.files):
            frames: Pixels = np.stack([_read(path, self.frame_format) for path in paths])
            label = self.plan.sequences[number].label
            for earlier, later in repeated_frames(frames):
                raise ImagesError(
                    f"{self.folder}: {paths[later].name} is {paths[earlier].name} over again, to the last bit "
                    f"(sequence {number + 1}, {label})",
                    "Check how the images were copied; a sequence needs a photograph of its own for every step.",
                )
            if frames.max() < _DARK_DN * self.frame_format.saturated_dn:
                raise ImagesError(
                    f"{self.folder}: all images of sequence {number + 1} ({label}) are black, the brightest grey value "
                    f"is {int(frames.max())} of {self.frame_format.saturated_dn}",
                    "Check the exposure, the lens cap and that the projector was on, or set `bits` in the plan file.",
                )
            if (frames.min(axis=0) >= self.frame_format.saturated_dn).mean() > 0.5:
                raise ImagesError(
                    f"{self.folder}: most pixels of sequence {number + 1} ({label}) are saturated in every image",
                    "Record again with a shorter exposure.",
                )
            yield number, frames


def open_images(folder: Path, plan_file: Path | None = None) -> RecordedFrames:
    """Read the plan file of a folder of images and check that the images are there and alike.

    Parameters
    ----------
    folder
        Folder of images.
    plan_file
        The plan; None: ``plan.yaml`` in the folder.

    Raises
    ------
    ImagesError
        No plan, no images, a wrong number of them, mixed sizes, colour, or files that are no images.
    ConfigError
        The plan file is wrong; all mistakes are told with their lines.
    """
    plan_file = plan_file or folder / PLAN_FILE
    if not plan_file.exists():
        raise ImagesError(
            f"{folder} is no take (it has no manifest.json), and there is no plan file {plan_file}",
            "Name a take, or write a plan file that says what the images show and name it with --plan; "
            "the README has an example.",
        )
    source = read_source(plan_file)
    try:
        recorded = FramesPlan.model_validate(source.data)
    except ValidationError as error:
        from scanner.config.problems import ConfigError

        raise ConfigError.of(explain(error, source, FramesPlan.model_json_schema())) from None
    paths = _files(folder, recorded)
    groups = _grouped(folder, paths, recorded)
    size = (recorded.projector.width, recorded.projector.height)
    plan = Plan(size, tuple(_sequence(s, recorded.phase) for s in recorded.sequences))
    for axis in plan.axes:
        frequencies = [s.frequency for s in plan.sequences if s.axis == axis and s.frequency is not None]
        check_plan_covers(frequencies, plan.extent(axis), f"{plan_file}: the fringes along {axis}")
    first = _load(groups[0][0])
    bits = recorded.bits or 8 * first.dtype.itemsize
    fmt = FrameFormat(first.shape[1], first.shape[0], bits)
    return RecordedFrames(
        folder,
        plan,
        fmt,
        groups,
        None if recorded.noise is None else NoiseModel(recorded.noise.read_dn, recorded.noise.dn_per_electron),
        None if recorded.rig is None else plan_file.parent / recorded.rig,
    )


def _sequence(recorded: RecordedSequence, phase: PhaseConvention) -> FringeSequence:
    steps = [phase.sign * 2 * math.pi * (i + phase.first_step) / recorded.steps for i in range(recorded.steps)]
    return FringeSequence(recorded.axis, tuple(Fringe(1 / recorded.period_px, step) for step in steps))


def _files(folder: Path, recorded: FramesPlan) -> list[Path]:
    if not folder.is_dir():
        raise ImagesError(f"{folder} is not a folder", "Name the folder that holds the images.")
    if isinstance(recorded.files, list):
        paths = [folder / name for name in recorded.files]
        missing = [p.name for p in paths if not p.is_file()]
        if missing:
            raise ImagesError(
                f"{folder}: {len(missing)} of {len(paths)} images are missing, first {missing[0]}",
                "Correct `files` in the plan file, or copy the images there.",
            )
        return paths
    paths = sorted(folder.glob(recorded.files), key=_natural)
    if not paths:
        raise ImagesError(
            f"{folder} holds no file {recorded.files}", 'Correct `files` in the plan file, such as "*.bmp".'
        )
    return paths


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Sort key by which frame2 comes before frame10."""
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", path.name)]


def _grouped(folder: Path, paths: list[Path], recorded: FramesPlan) -> tuple[tuple[Path, ...], ...]:
    groups, place = [], 0
    for sequence in recorded.sequences:
        place = place if sequence.first_file is None else sequence.first_file
        groups.append(tuple(paths[place : place + sequence.steps]))
        place += sequence.steps
    needed = sum(s.steps for s in recorded.sequences)
    explicit = any(s.first_file is not None for s in recorded.sequences)
    if any(len(g) != s.steps for g, s in zip(groups, recorded.sequences, strict=True)) or (
        not explicit and len(paths) != needed
    ):
        raise ImagesError(
            f"{folder} holds {len(paths)} images, the plan asks for {needed} "
            f"({' + '.join(str(s.steps) for s in recorded.sequences)})",
            "Correct `sequences` or `files` in the plan file, or find the missing images; with others in between, "
            "give each sequence its `first_file`.",
        )
    return tuple(groups)


def _load(path: Path) -> Pixels:
    import cv2

    frame = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if frame is None:
        raise ImagesError(f"{path} cannot be read as an image: truncated, empty or of another kind", "Copy it again.")
    if frame.ndim != 2:
        raise ImagesError(
            f"{path} is a colour image, {frame.shape[2]} channels", "Convert the images to grey, all in the same way."
        )
    if frame.dtype not in (np.uint8, np.uint16):
        raise ImagesError(f"{path} has pixels of type {frame.dtype}", "Save the images with 8 or 16 bits.")
    return np.asarray(frame)


def _read(path: Path, fmt: FrameFormat) -> Pixels:
    frame = _load(path)
    if frame.shape != fmt.shape or frame.dtype.itemsize * 8 < fmt.bits or (fmt.bits <= 8 and frame.dtype != np.uint8):
        raise ImagesError(
            f"{path} is {frame.shape[1]} × {frame.shape[0]} px of {frame.dtype}, the first image is "
            f"{fmt.width} × {fmt.height} px of {fmt.dtype}",
            "Keep only the images of one recording in the folder.",
        )
    return frame
