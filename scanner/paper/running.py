"""Make the paper's experiments, one after the other, and write the report."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanner.comparison.running import Planned, compare_scans, described, document_of, plan_scans
from scanner.config import ConfigError, LoadedConfig, load_config
from scanner.folder import REPORT, write_json
from scanner.paper.claims import STATEMENTS, Experiment
from scanner.paper.noise import NoiseStudy, study_noise
from scanner.paper.page import Chapter, chapter, render
from scanner.paper.shelf import PAPER, Shelf, open_shelf
from scanner.result import ScanResult


@dataclass(frozen=True)
class Wanted:
    """How large the experiments are.

    Parameters
    ----------
    seeds
        Scans of every method in every experiment, and pictures of every pair of the noise study.
    width_px
        Columns of the camera's picture; the rows follow the file's. None: the file's own.
    noise_shape
        Rows and columns of the pictures of the noise study.
    """

    seeds: int = 3
    width_px: int | None = None
    noise_shape: tuple[int, int] = (384, 512)


@dataclass(frozen=True)
class _Prepared:
    """One experiment before it is scanned."""

    name: str
    loaded: LoadedConfig
    scans: list[Planned]


def run_paper(
    configs: Path,
    out: Path,
    wanted: Wanted,
    scan: Callable[[Planned, Path], ScanResult],
    report: Callable[[str], None],
    overwrite: bool = False,
    command: Sequence[str] = (),
) -> dict[str, Any]:
    """Make all experiments whose files lie in ``configs``, then the noise study, and write all of it to ``out``.

    What ``out`` holds of an earlier run with the same settings is taken over. After every experiment the report is
    written as far as it goes.

    Parameters
    ----------
    configs
        Folder of bench files with a ``compare:`` section, in the order of their names.
    out
        Folder to write, or to go on in.
    wanted
        How large.
    scan
        Makes one scan and leaves a result folder at the path.
    report
        Is told what is being done.
    overwrite
        Begin anew.
    command
        The words of the command that makes it all again.

    Returns
    -------
    dict
        JSON-ready: of every experiment the rows and the statements, and the noise study.

    Raises
    ------
    ConfigError
        ``configs`` holds no such files, or one of them is wrong.
    OutputError
        ``out`` is something else.
    """
    prepared = [_prepare(path, wanted) for path in _files(configs)]
    folder = open_shelf(out, overwrite)
    chapters: list[Chapter] = []
    found: dict[str, Any] = {}
    noise: NoiseStudy | None = None

    def write(complete: bool) -> dict[str, Any]:
        document: dict[str, Any] = {
            "complete": complete,
            "command": shlex.join(command),
            "experiments": found,
            "noise": None if noise is None else noise.document,
        }
        (folder / REPORT).write_text(render(chapters, noise, shlex.join(command)), encoding="utf-8")
        write_json(folder / PAPER, document)
        return document

    for number, one in enumerate(prepared, 1):
        shelf = Shelf(folder / one.name)

        def make(planned: Planned, one: _Prepared = one, number: int = number, shelf: Shelf = shelf) -> ScanResult:
            def told(p: Planned, place: Path) -> ScanResult:
                at = 1 + one.scans.index(p)
                report(f"experiment {number} of {len(prepared)}, scan {at} of {len(one.scans)}: {one.name}, {p.name}")
                return scan(p, place)

            return shelf.scan(planned, told)

        section = one.loaded.config.compare
        compared = compare_scans(one.scans, make, section, shelf)
        comparison = described(compared, one.scans, section, _title(one.loaded), f"{one.name}-")
        experiment = Experiment(one.name, comparison, STATEMENTS.get(one.name, ()))
        chapters.append(chapter(experiment, number))
        found[one.name] = experiment.to_json()
        write_json(folder / one.name / "comparison.json", document_of(compared))
        write(complete=False)
    noise = study_noise(folder / "noise", wanted.seeds, wanted.noise_shape, report)
    return write(complete=True)


def _files(configs: Path) -> list[Path]:
    found = sorted(configs.glob("*.yaml")) if configs.is_dir() else []
    if not found:
        raise ConfigError(
            f"{configs} holds no bench files of the paper's experiments",
            "name the folder configs/paper of the source with --configs",
        )
    return found


def _prepare(path: Path, wanted: Wanted) -> _Prepared:
    own = load_config(path)
    changes: dict[str, object] = {"output.keep_take": False, "output.report": False, "output.ply": False}
    if wanted.width_px is not None:
        changes |= _resized(own, wanted.width_px)
    section = own.config.compare
    scans = plan_scans(
        lambda more: load_config(path, {**changes, **more}), section.methods, wanted.seeds, section.reference
    )
    return _Prepared(path.stem, own, scans)


def _resized(loaded: LoadedConfig, width: int) -> Mapping[str, object]:
    """The camera's picture in another size and the same shape."""
    camera = getattr(loaded.bench_settings, "camera", None)
    size = getattr(camera, "width_px", None), getattr(camera, "height_px", None)
    if not isinstance(size[0], int) or not isinstance(size[1], int):
        raise ConfigError(f"{loaded.path}: the size of this bench's camera cannot be chosen", "leave --width-px out")
    return {"bench.camera.width_px": width, "bench.camera.height_px": round(width * size[1] / size[0])}


def _title(loaded: LoadedConfig) -> str:
    return loaded.path.stem.lstrip("0123456789").replace("_", " ").strip()
