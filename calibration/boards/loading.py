"""From a file to a board."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from calibration.boards.charuco import Charuco
from calibration.boards.chessboard import Chessboard
from calibration.boards.circles import AsymmetricCircles, Circles
from scanner.config.problems import ConfigError, Problem
from scanner.config.source import Source, read_source

AnyBoard = Annotated[Chessboard | Charuco | Circles | AsymmetricCircles, Field(discriminator="kind")]
"""A board of any kind, told apart by its field ``kind``."""

_boards: TypeAdapter[Chessboard | Charuco | Circles | AsymmetricCircles] = TypeAdapter(AnyBoard)


def load_board(path: str | Path) -> Chessboard | Charuco | Circles | AsymmetricCircles:
    """Read the definition of a board.

    Parameters
    ----------
    path
        YAML file in UTF-8, such as those in configs/boards.

    Raises
    ------
    scanner.config.ConfigError
        The file cannot be read or is wrong; all mistakes are told at once, with file, line and remedy.
    """
    source = read_source(Path(path), start="`kind: chessboard`, or begin with a copy of a file in configs/boards")
    return _validated(source)


def board_from(
    document: Mapping[str, Any], origin: str = "the board"
) -> Chessboard | Charuco | Circles | AsymmetricCircles:
    """Make a board of its definition, such as the one that a recording keeps.

    Parameters
    ----------
    document
        What a file would say, as nested dicts.
    origin
        Where it comes from, for messages.

    Raises
    ------
    scanner.config.ConfigError
        It is wrong.
    """
    return _validated(Source(origin, dict(document)))


def _validated(source: Source) -> Chessboard | Charuco | Circles | AsymmetricCircles:
    try:
        return _boards.validate_python(source.data)
    except ValidationError as error:
        from scanner.config.explain import explain

        raise _told(explain(error, source, _boards.json_schema())) from None


def _told(problems: list[Problem]) -> ConfigError:
    if len(problems) == 1:
        return ConfigError.of(problems)
    told = "\n".join(f"{problem.sentence}\n  → {problem.remedy}" for problem in problems)
    return ConfigError(told, f"correct these {len(problems)} places; see the files in configs/boards", problems)
