"""What is wrong in a configuration, said so that an operator can correct it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from pydantic import BaseModel

from drivers.errors import OperatorError

FieldPath = tuple[str | int, ...]
"""Keys and list indices that lead from the top of a file to a field."""


@dataclass(frozen=True)
class Problem:
    """One mistake in a configuration.

    Parameters
    ----------
    file
        The file as the operator named it.
    line, column
        Counted from 1; None where the file as a whole, or an override of it, is meant.
    field
        Such as ``scan.periods_px[2]``; empty for the file as a whole.
    what
        What was found and what was expected.
    remedy
        What to do about it.
    """

    file: str
    line: int | None
    column: int | None
    field: str
    what: str
    remedy: str

    @property
    def sentence(self) -> str:
        """Where and what, on one line."""
        place = self.file if self.line is None else f"{self.file}, line {self.line}, column {self.column}"
        return ": ".join(part for part in (place, self.field, self.what) if part)


class ConfigError(OperatorError):
    """A configuration is wrong; exit code 2.

    Parameters
    ----------
    message, remedy
        See `drivers.errors.OperatorError`.
    problems
        The single mistakes in the order of the file.
    """

    def __init__(self, message: str, remedy: str, problems: Sequence[Problem] = ()) -> None:
        super().__init__(message, remedy)
        self.problems = tuple(problems)

    @classmethod
    def of(cls, problems: Sequence[Problem]) -> Self:
        """Tell all ``problems`` in one error."""
        if len(problems) == 1:
            return cls(problems[0].sentence, problems[0].remedy, problems)
        told = "\n".join(f"{problem.sentence}\n  → {problem.remedy}" for problem in problems)
        return cls(told, f"correct these {len(problems)} places; `scan schema` describes every field", problems)


def show(value: Any) -> str:
    """Write a value as an operator would, shortened."""
    if isinstance(value, Mapping | BaseModel):
        return "a section"
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        text = f"[{', '.join(show(item) for item in value)}]"
    elif isinstance(value, float):
        text = f"{value:.10g}"
    elif isinstance(value, str) and not re.fullmatch(r"[A-Za-z_][\w./-]*", value):
        text = json.dumps(value, ensure_ascii=False)
    else:
        text = str(value)
    return text if len(text) <= 100 else f"{text[:99]}…"


def dotted(path: FieldPath) -> str:
    """Write a path as ``scan.periods_px[2]``."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")
