"""What installed packages and benches know of their devices, asked in processes of their own.

A package registers ``examine(settings) -> Iterator[Finding]`` in the entry-point group ``scanner.examinations``; it is
given the settings of the bench that is looked at, or None. A bench kind that has a method of that name and form judges
its own bench file: whether its devices are there, and what keeps a scan from starting as a `Verdict.FAULT`. What it
needs of the rig it says with findings of the topic ``rig``; see `scanner.doctor.readiness.NEEDS_LATENCY`.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from drivers.errors import OperatorError
from drivers.examination import Finding, Verdict
from scanner.doctor.bounded import CutShortError, bounded

if TYPE_CHECKING:
    from scanner.config import LoadedConfig

EXAMINATION_GROUP = "scanner.examinations"
"""The entry-point group in which packages register what they examine."""

LIMIT_S = 120.0
"""How long one package may take, s; it is to keep shorter limits for what it looks at."""


def examine_devices(loaded: LoadedConfig | None) -> Iterator[Finding]:
    """Ask all installed packages what devices there are.

    Parameters
    ----------
    loaded
        The configuration that is looked at; packages are given its bench's settings.
    """
    settings = None if loaded is None else loaded.bench_settings
    for name in sorted({entry.name for entry in entry_points(group=EXAMINATION_GROUP)}):
        yield from _asked(Verdict.WARNING, f"examination {name}", _examination, name, settings)


def examine_bench(loaded: LoadedConfig) -> Iterator[Finding] | None:
    """Have the bench kind judge its bench file; None where it does not know how."""
    if not callable(getattr(loaded.bench_kind, "examine", None)):
        return None
    kind = loaded.config.bench.kind
    return _asked(Verdict.FAULT, f"bench {kind}", _bench_examination, kind, loaded.bench_settings)


def _asked(verdict: Verdict, item: str, function: Any, *args: Any) -> Iterator[Finding]:
    try:
        yield from bounded(LIMIT_S, function, *args)
    except OperatorError as error:
        yield Finding("devices", item, verdict, error.message, error.remedy)
    except CutShortError as error:
        remedy = "Unplug what was connected last, and try again; what was found before it hung or crashed is listed."
        yield Finding("devices", item, verdict, str(error), remedy)


def _examination(name: str, settings: Any) -> Iterator[Finding]:
    for entry in entry_points(group=EXAMINATION_GROUP, name=name):
        yield from entry.load()(settings)


def _bench_examination(kind: str, settings: Any) -> Iterator[Finding]:
    from scanner.config import load_bench_kind

    yield from load_bench_kind(kind).examine(settings)  # type: ignore[attr-defined]
