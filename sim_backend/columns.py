"""Arrays that belong together element by element."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class Columns:
    """Base of dataclasses whose fields are arrays of one length."""

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        """The chosen elements."""
        return type(self)(*(column[chosen] for column in _columns(self)))

    @classmethod
    def joined(cls, parts: Iterable[Self]) -> Self:
        """All parts in one, in their order."""
        return cls(*(np.concatenate(columns) for columns in zip(*map(_columns, parts), strict=True)))


def _columns(table: Any) -> list[NDArray[Any]]:
    return [getattr(table, f.name) for f in fields(table)]
