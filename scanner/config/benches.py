"""Which benches are installed: discovery of bench kinds by name, and what an operator is told when one is no good."""

from __future__ import annotations

import difflib
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from pydantic import BaseModel

from scanner.config.problems import ConfigError, show

if TYPE_CHECKING:
    from drivers.bench import BenchKind

BENCH_GROUP = "scanner.benches"
"""The entry-point group in which packages register their bench kinds."""


def bench_kinds() -> dict[str, EntryPoint]:
    """Find the installed bench kinds by name; nothing of them is imported.

    Raises
    ------
    ConfigError
        Two installed packages register the same name.
    """
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=BENCH_GROUP):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise ConfigError(
                f"two packages register the bench kind {entry.name!r}: {_origin(other)} and {_origin(entry)}",
                "uninstall one of the two packages",
            )
    return found


def load_bench_kind(name: str) -> BenchKind:
    """Import the bench kind that is installed under ``name``.

    Raises
    ------
    ConfigError
        None has that name, its package cannot be imported, or it is no bench kind.
    """
    kinds = bench_kinds()
    if name not in kinds:
        near = difflib.get_close_matches(name, kinds, n=1)
        guess = f"did you mean `{near[0]}`? " if near else ""
        raise ConfigError(
            f"found {show(name)}, expected an installed bench: {', '.join(sorted(kinds)) or 'none is installed'}",
            f"{guess}More benches come as Python packages that register in the entry-point group {BENCH_GROUP}; "
            "install one with: python -m pip install PACKAGE",
        )
    origin, dist = _origin(kinds[name]), kinds[name].dist
    package = "its package" if dist is None else dist.name
    try:
        kind = kinds[name].load()
    except Exception as error:  # whatever a stranger's module raises, the operator needs to know whose it is
        raise ConfigError(
            f"the bench {name!r} of {origin} cannot be loaded: {type(error).__name__}: {error}",
            f"install what it asks for, or update it: python -m pip install --upgrade {package}",
        ) from error
    model = getattr(kind, "settings", None)
    lacks = []
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        lacks.append("`settings`, a pydantic model class")
    if not callable(getattr(kind, "open", None)):
        lacks.append("`open(settings)`, a context manager")
    if lacks:
        raise ConfigError(
            f"{name!r} of {origin} is no bench: it lacks {' and '.join(lacks)}",
            f"update {package}, or tell its author; the contract is drivers.bench.BenchKind",
        )
    return kind  # type: ignore[no-any-return]


def _origin(entry: EntryPoint) -> str:
    package = f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "an unnamed package"
    return f"{package} ({entry.value})"
