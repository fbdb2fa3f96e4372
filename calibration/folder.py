"""The folder of a calibration on disk: which steps are done, the raw captures as takes, the poses, the rig.

calibration/
steps.json      what each step has found, written anew as a whole after each; former findings stay as history
takes/          the raw captures; what was cut off is kept as <name>.cut-off, <name>.cut-off-2 …
poses/          one .npz for each board pose: what camera and projector see of the board's points
rig.json        the result of the geometry step; rig.opencv.yaml, the same for others
acceptance/     result folders of the artefacts' scans
certificate.html, certificate.json
What is made anew keeps its former version under another name: rig.former.json, acceptance.former …
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np

from calibration.observations import PoseObservation
from drivers.errors import OperatorError
from scanner.take import Take, TakeError

STEPS = "steps.json"
RIG, OPENCV_RIG = "rig.json", "rig.opencv.yaml"
CERTIFICATE, CERTIFICATE_DATA = "certificate.html", "certificate.json"
_FORMAT, _VERSION = "mfs-scanner calibration", 1


class CalibrationFolderError(OperatorError):
    """The folder of a calibration cannot be made, read or written, or belongs to somebody else."""


class CalibrationFolder:
    """A calibration on disk, used as a context manager; only one process works in it at a time.

    Parameters
    ----------
    path
        The folder; made where it is not there, continued where it is a calibration.
    board
        Definition of the board as JSON, which all poses of one calibration share.

    Raises
    ------
    CalibrationFolderError
        On entering: the folder is something else, another process works in it, or it holds poses of another board.
    """

    def __init__(self, path: str | os.PathLike[str], board: Mapping[str, Any]) -> None:
        self.path = Path(path).resolve()
        self._board = json.loads(json.dumps(board))
        self._document: dict[str, Any] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                self._enter(stack)
            except OSError as error:
                raise CalibrationFolderError(
                    f"{self.path} cannot be used: {error.strerror}",
                    "Choose another folder with --out, or change its permissions.",
                ) from None
            self._stack = stack.pop_all()
        return self

    def _enter(self, stack: ExitStack) -> None:
        if self.path.exists() and not (self.path / STEPS).is_file() and any(self.path.iterdir()):
            raise CalibrationFolderError(
                f"{self.path} holds something else than a calibration", "Choose another folder with --out."
            )
        for name in ("takes", "poses", "acceptance"):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        lock = stack.enter_context((self.path / ".lock").open("w"))
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CalibrationFolderError(
                f"another process calibrates in {self.path}", "Wait for it, or choose another folder with --out."
            ) from None
        if not (self.path / STEPS).exists():
            self._document = {
                "format": _FORMAT,
                "version": _VERSION,
                "begun": _now(),
                "board": self._board,
                "steps": {},
                "history": [],
            }
            self._write()
            return
        self._document = read_steps(self.path)
        if self._document["board"] != self._board:
            raise CalibrationFolderError(
                f"{self.path} was begun with another board: {self._document['board'].get('name')}",
                "Name that board in calibration.board again, or begin a new calibration with --out.",
            )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def finding(self, step: str) -> dict[str, Any] | None:
        """What step ``step`` has found; None where it is not done."""
        found: dict[str, Any] | None = self._document["steps"].get(step)
        return found

    def finish(self, step: str, document: Mapping[str, Any]) -> None:
        """Keep what a step has found; a former finding of it moves to the history."""
        self.forget(step)
        self._document["steps"][step] = {"at": _now(), **json.loads(json.dumps(dict(document)))}
        self._write()

    def forget(self, step: str) -> None:
        """Move what a step has found to the history: it is to be done again."""
        former = self._document["steps"].pop(step, None)
        if former is not None:
            self._document["history"].append({"step": step, **former})
            self._write()

    def _write(self) -> None:
        partial = self.path / f".{STEPS}.partial"
        with partial.open("w", encoding="utf-8") as file:
            json.dump(self._document, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(self.path / STEPS)

    def new_take(self, name: str) -> Path:
        """Place for the take ``name``; what is there of an earlier try is kept under another name."""
        place = self.path / "takes" / name
        if place.exists():
            place.rename(_free(place, "former" if _complete(place) else "cut-off"))
        return place

    def new_scan(self, name: str) -> Path:
        """Place for the result folder ``name`` of the acceptance; what is there is kept under another name."""
        place = self.path / "acceptance" / name
        if place.exists():
            place.rename(_free(place, "former"))
        return place

    def poses(self) -> list[PoseObservation]:
        """The poses that were taken, in order."""
        return [_read_pose(file) for file in sorted((self.path / "poses").glob("pose-*.npz"))]

    def next_pose(self) -> str:
        """Name of the next pose, ``pose-01`` …; a number is never used twice."""
        used = {int(p.name[5:7]) for where in ("poses", "takes") for p in (self.path / where).glob("pose-[0-9][0-9]*")}
        return f"pose-{max(used, default=0) + 1:02d}"

    def add_pose(self, name: str, observation: PoseObservation) -> None:
        """Keep a pose, named as its take."""
        place = self.path / "poses" / f"{name}.npz"
        partial = place.with_name(f".{name}.partial.npz")
        arrays = {f.name: getattr(observation, f.name) for f in fields(PoseObservation)}
        np.savez(partial, allow_pickle=False, **arrays)
        partial.replace(place)

    def drop_pose(self, name: str) -> None:
        """Leave a pose out; its file stays, as ``dropped-<name>.npz``, and its take."""
        place = self.path / "poses" / f"{name}.npz"
        place.rename(_free(place.with_name(f"dropped-{name}.npz"), "former"))

    def drop_all_poses(self) -> None:
        """Begin the geometry anew; nothing is deleted."""
        for file in sorted((self.path / "poses").glob("pose-*.npz")):
            self.drop_pose(file.stem)
        for name in (RIG, OPENCV_RIG):
            if (self.path / name).exists():
                (self.path / name).rename(_free(self.path / name, "former"))

    def drop_scans(self) -> None:
        """Begin the acceptance anew; the former scans stay, as ``acceptance.former``."""
        place = self.path / "acceptance"
        place.rename(_free(place, "former"))
        place.mkdir()


def read_steps(path: Path) -> dict[str, Any]:
    """Read ``steps.json`` of a calibration folder.

    Raises
    ------
    CalibrationFolderError
        It is none, damaged, or of a newer version.
    """
    try:
        document = json.loads((path / STEPS).read_bytes())
    except (OSError, ValueError):
        document = None
    if not isinstance(document, dict) or document.get("format") != _FORMAT or "steps" not in document:
        raise CalibrationFolderError(
            f"{path / STEPS} is not what a calibration has written", "Restore it from a copy, or begin a new one."
        )
    if document.get("version") != _VERSION:
        raise CalibrationFolderError(
            f"{path} was made by version {document.get('version')} of the format, this program reads {_VERSION}",
            "Use the program that made it, or begin a new calibration with --out.",
        )
    return document


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _complete(take: Path) -> bool:
    try:
        return Take.open(take).status == "completed"
    except TakeError:
        return False


def _free(place: Path, suffix: str) -> Path:
    """First of ``<place>``, ``<place>.<suffix>``, ``<place>.<suffix>-2`` … that is free; a file keeps its ending."""
    stem, ending = (place.name, "") if place.is_dir() else (place.stem, place.suffix)
    free, number = place, 0
    while free.exists():
        number += 1
        free = place.with_name(f"{stem}.{suffix}" + (f"-{number}" if number > 1 else "") + ending)
    return free


def _read_pose(file: Path) -> PoseObservation:
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {f.name: stored[f.name] for f in fields(PoseObservation)}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise CalibrationFolderError(
            f"{file} cannot be read: {error}", "Remove it and take the pose again, or restore it from a copy."
        ) from None
    return PoseObservation(**{**arrays, "name": str(arrays["name"])})
