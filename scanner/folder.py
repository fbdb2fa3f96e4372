"""Result folders on disk: reserved before anything is projected, complete or under another name, and read back.

A folder is written beside its final place, as ``.<name>.partial-<uid>``, and renamed when it is complete. Whatever ends
the work before that, what was recorded is kept as ``<name>.incomplete``.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import uuid
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import numpy as np

from drivers.errors import OperatorError
from scanner.result import Maps, ScanResult
from scanner.rig import Rig
from scanner.take import FRAMES

RESULT = "result.json"
COMPARISON, DETECTION_STUDY, DESIGNED_PLAN = "comparison.json", "detection.json", "plan.json"
MAPS, CLOUD, REPORT, RIG, CONFIG, TAKE = "maps.npz", "cloud.ply", "report.html", "rig.json", "config.yaml", "take"

_FORMAT, _VERSION = "mfs-scanner result", 1
_OWN_KEYS = ("format", "version", "method", "simulated", "warnings")
_OPTIONAL_MAPS = {f.name for f in fields(Maps) if str(f.type).endswith("None")}
_FULL = (errno.ENOSPC, errno.EDQUOT)


class OutputError(OperatorError):
    """A result folder cannot be made, written or read."""


class OutputFolder:
    """A folder that appears under its name when it is complete; used as a context manager.

    Leaving without an error renames the folder to ``out``. Leaving with one, or being interrupted, renames it to
    ``<out>.incomplete`` (with a number where that exists) if it holds a recording, and removes it otherwise; the error
    then says where the recording is: in the remedy of an `OperatorError`, in a note of any other exception.

    Parameters
    ----------
    out
        Where the folder shall be.
    overwrite
        Replace a folder of this kind that is there. It stays in place until the new one is complete, and is kept as
        ``<out>.previous`` where it holds recordings that the new one does not.

    Attributes
    ----------
    path
        Where to write: the reserved folder, and after success `out`.
    notices
        Sentences for the operator: recordings that cut-off scans left here, and what was kept.

    Raises
    ------
    OutputError
        On entering: ``out`` exists and may not be replaced, or its place cannot be written.
    """

    marker: ClassVar[str]
    """The file that makes a folder one of this kind, and that may be overwritten."""

    def __init__(self, out: str | os.PathLike[str], overwrite: bool = False) -> None:
        self.out = Path(out).resolve()
        self.overwrite = overwrite
        self.path = self._beside("partial")
        self.notices: list[str] = []

    def __enter__(self) -> Self:
        self._check_place()
        try:
            self.path.mkdir()
        except OSError as error:
            raise OutputError(
                f"no folder can be made in {self.out.parent}: {error.strerror}",
                "Choose another place with --out, or change the folder's permissions.",
            ) from None
        self.notices += [
            f"{left} holds a recording of a scan that was cut off or still runs; `scan process` can use it"
            for left in sorted(self.out.parent.glob(".*.partial-*"))
            if _takes(left)
        ]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._publish()
            return
        if isinstance(error, OSError) and error.errno in _FULL:
            refused = OutputError(f"{self.path}: {error.strerror}", "Free some space on the disk.")
            self._set_aside(refused)
            raise refused from error
        self._set_aside(error)

    def _beside(self, role: str) -> Path:
        return self.out.with_name(f".{self.out.name}.{role}-{uuid.uuid4().hex[:8]}")

    def _numbered(self, suffix: str) -> Path:
        """First name ``<out>.<suffix>``, ``<out>.<suffix>-2`` … that is free."""
        number, free = 1, self.out.with_name(f"{self.out.name}.{suffix}")
        while free.exists():
            number += 1
            free = self.out.with_name(f"{self.out.name}.{suffix}-{number}")
        return free

    def _check_place(self) -> None:
        out = self.out
        if not out.parent.is_dir():
            raise OutputError(
                f"{out.parent} is not a folder, so {out.name} cannot be made in it",
                "Make the folder first, or choose another place with --out.",
            )
        if not out.exists():
            return
        if not out.is_dir():
            raise OutputError(f"{out} is a file", "Choose another place with --out.")
        if not self.overwrite:
            raise OutputError(f"{out} exists", "Choose another place with --out, or replace it with --overwrite.")
        if not (out / self.marker).is_file() and any(out.iterdir()):
            raise OutputError(
                f"{out} holds no {self.marker} but other files, so it is not overwritten",
                "Choose another place with --out, or empty the folder.",
            )

    def _publish(self) -> None:
        replaced = None
        try:
            _to_disk(self.path)
            if self.out.exists():
                self._check_place()
                replaced = self._beside("replaced")
                self.out.rename(replaced)
            self.path.rename(self.out)
        except BaseException as error:
            if replaced is not None and not self.out.exists():
                replaced.rename(self.out)
            refused: BaseException = error
            if isinstance(error, OSError):
                refused = OutputError(
                    f"{self.path} cannot be renamed to {self.out}: {error.strerror}", "Check the disk."
                )
            self._set_aside(refused, whole=True)
            raise refused from error
        self.path = self.out
        if replaced is not None:
            self._drop(replaced)

    def _drop(self, replaced: Path) -> None:
        """Remove the folder that was replaced, unless a recording would go with it."""
        if only_there := _takes(replaced) - _takes(self.out):
            kept = self._numbered("previous")
            replaced.rename(kept)
            names = ", ".join(sorted(str(kept / name) for name in only_there))
            self.notices.append(f"the folder that was replaced is kept for its recording: {names}")
        else:
            shutil.rmtree(replaced, ignore_errors=True)
            if replaced.exists():
                self.notices.append(f"the folder that was replaced could not be removed: {replaced}")

    def _set_aside(self, error: BaseException, *, whole: bool = False) -> None:
        """Keep the folder under a visible name if it holds a recording or is ``whole``, and tell ``error``."""
        if not whole and not _takes(self.path):
            shutil.rmtree(self.path, ignore_errors=True)
            return
        written = self.path
        with suppress(OSError):  # then it stays where it is
            self.path = written.rename(self._numbered("incomplete"))
        if whole:
            sentence = f"The complete folder is kept as {self.path}."
        else:
            sentence = f"The recording is kept in {self.path}; `scan process` makes a result from it."
        if isinstance(error, OperatorError):
            # What was said about the reserved name is true of the name it has now.
            error.message = error.message.replace(str(written), str(self.path))
            error.remedy = f"{error.remedy.replace(str(written), str(self.path))} {sentence}"
            error.args = (error.message,)
        else:
            error.add_note(sentence)
        self.notices.append(sentence)


class ResultFolder(OutputFolder):
    """The folder of one scan; `write_result` fills it, beside the recording in ``path / "take"``."""

    marker = RESULT

    def __init__(self, out: str | os.PathLike[str], overwrite: bool = False) -> None:
        super().__init__(out, overwrite)
        self._unwanted_take = False

    def discard_take(self) -> None:
        """Remove the recording once the result is complete."""
        self._unwanted_take = True

    def _publish(self) -> None:
        super()._publish()
        if self._unwanted_take:
            shutil.rmtree(self.path / TAKE, ignore_errors=True)


class DocumentFolder(OutputFolder):
    """A folder whose document says what was found."""

    def write_json(self, name: str, document: Mapping[str, Any]) -> None:
        """Write a JSON-ready document; NaN becomes null."""
        write_json(self.path / name, document)


class ComparisonFolder(DocumentFolder):
    """The folder of a comparison: a result folder for each method, and what was found."""

    marker = COMPARISON


class StudyFolder(DocumentFolder):
    """The folder of a study of detection."""

    marker = DETECTION_STUDY


class PlanFolder(DocumentFolder):
    """The folder of a designed plan."""

    marker = DESIGNED_PLAN


def write_result(
    path: str | os.PathLike[str],
    result: ScanResult,
    *,
    rig: Rig | None = None,
    config_yaml: str | None = None,
    plans: Sequence[Mapping[str, Any]] = (),
    ply: bool = True,
    report: bool = True,
) -> None:
    """Write all files of a result but the recording into ``path``.

    Parameters
    ----------
    path
        An existing folder.
    result
        The scan. ``created`` (ISO 8601) is put into its summary where it is missing.
    rig, config_yaml
        For rig.json, config.yaml and the report; not written where None.
    plans
        Documents of the plans that were projected (`Plan.to_json`), for result.json.
    ply, report
        Write cloud.ply (where there are points) and report.html.

    Raises
    ------
    OutputError
        The disk is full or refuses a file; it names what was written and what was not.
    """
    path = Path(path)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    result = replace(result, summary={"created": created, **result.summary})
    maps = result.maps

    def cloud(file: Path) -> None:
        from scanner.cloud import Cloud

        assert maps.points is not None
        assert maps.sigma_point is not None
        Cloud.from_grid(maps.points, maps.sigma_point, maps.brightness, simulated=result.simulated).save(file)

    def page(file: Path) -> None:
        from scanner.report import render

        _write_text(file, render(result, rig=rig))

    steps: dict[str, Callable[[Path], None]] = {}
    if rig is not None:
        steps[RIG] = lambda file: _write_text(file, _json(rig.to_json()))
    if config_yaml is not None:
        steps[CONFIG] = lambda file: _write_text(file, config_yaml)
    if ply and maps.points is not None and np.isfinite(maps.points[..., 2]).any():
        steps[CLOUD] = cloud
    if report:
        steps[REPORT] = page
    steps[MAPS] = lambda file: _write_maps(file, maps)
    steps[RESULT] = lambda file: _write_text(file, _json(_document(result, plans)))  # last: it makes a result folder

    for number, (name, write) in enumerate(steps.items()):
        try:
            write(path / name)
        except (OSError, OperatorError) as error:
            with suppress(OSError):
                (path / name).unlink(missing_ok=True)
            reason = error.message if isinstance(error, OperatorError) else error.strerror or str(error)
            done, missing = list(steps)[:number], list(steps)[number:]
            raise OutputError(
                f"{path / name} could not be written: {reason}; "
                f"written: {', '.join(done) or 'nothing'}; not written: {', '.join(missing)}",
                "Free some space or check the disk, then make the result again from the recording.",
            ) from error


def read_result(path: str | os.PathLike[str]) -> ScanResult:
    """Read a result folder.

    Parameters
    ----------
    path
        The folder. ``plans``, where present, are in the summary.

    Raises
    ------
    OutputError
        It is no result folder, one of a newer version, or damaged.
    """
    path = Path(path)
    if not (path / RESULT).is_file():
        raise OutputError(f"{path} is not a result folder: it has no {RESULT}", "Name a folder that `scan` wrote.")
    try:
        document = json.loads((path / RESULT).read_text("utf-8"))
        if document["format"] != _FORMAT or document["version"] != _VERSION:
            raise OutputError(
                f"{path / RESULT} is {document['format']!r} version {document['version']!r}, "
                f"not {_FORMAT!r} version {_VERSION}",
                "Read it with the version of this program that wrote it.",
            )
        with open(path / MAPS, "rb") as file, np.load(file) as arrays:
            known: dict[str, Any] = {
                f.name: arrays[f.name] if f.name in arrays or f.name not in _OPTIONAL_MAPS else None
                for f in fields(Maps)
            }
        maps = Maps(**{**known, "misfit_dof": int(known["misfit_dof"])})
        summary = {key: value for key, value in document.items() if key not in _OWN_KEYS}
        return ScanResult(document["method"], document["simulated"], maps, summary, list(document["warnings"]))
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise OutputError(
            f"{path} is damaged: {error}", "Make the result again from its recording with `scan process`."
        ) from error


def _document(result: ScanResult, plans: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    own = {"format": _FORMAT, "version": _VERSION, "method": result.method, "simulated": result.simulated}
    document = {**own, **result.summary, "warnings": result.warnings}
    return {**document, "plans": list(plans)} if plans else document


def _write_maps(file: Path, maps: Maps) -> None:
    """Write every map that there is under its name; not compressed, because noise hardly shrinks (to 86 %)."""
    arrays = {f.name: getattr(maps, f.name) for f in fields(maps)}
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})


def write_json(file: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON-ready document; NaN becomes null."""
    _write_text(file, _json(document))


def _write_text(file: Path, text: str) -> None:
    file.write_text(text, encoding="utf-8")


def _json(document: Any) -> str:
    return json.dumps(_plain(document), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """JSON-ready copy: NumPy's numbers become Python's, NaN and infinity null."""
    match value:
        case Mapping():
            return {str(k): _plain(v) for k, v in value.items()}
        case list() | tuple():
            return [_plain(v) for v in value]
        case np.generic() | np.ndarray():
            return _plain(value.tolist())
        case float() if not math.isfinite(value):
            return None
    return value


def _takes(folder: Path) -> set[str]:
    """Where recordings lie in ``folder``, itself a result or a folder of results; a take without frames is none."""
    found = (
        p.parent for pattern in (TAKE, f"*/{TAKE}") for p in folder.glob(f"{pattern}/{FRAMES}") if p.stat().st_size
    )
    return {str(take.relative_to(folder)) for take in found}


def _to_disk(folder: Path) -> None:
    """Have every file reach the disk before the rename that says it is complete. A take does so for itself."""
    for file in sorted(folder.iterdir()):
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
