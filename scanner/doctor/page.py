"""How findings are told: a page for the operator, a document for programs."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from drivers.examination import Finding, Verdict

SCHEMA = 1
"""Version of the JSON document; it changes when a key changes its meaning or goes."""

_MARKS = {
    Verdict.OK: ("✓", "green"),
    Verdict.NOTE: ("·", "cyan"),
    Verdict.WARNING: ("!", "yellow"),
    Verdict.FAULT: ("✗", "bold red"),
}
_SEVERITY = list(Verdict)


def worst(findings: Sequence[Finding]) -> Verdict:
    """The gravest verdict."""
    return max((f.verdict for f in findings), key=_SEVERITY.index, default=Verdict.OK)


def to_json(findings: Sequence[Finding], config: str | None) -> dict[str, Any]:
    """The document of ``scan doctor --json``.

    Keys: ``schema`` (1), ``scanner`` and ``python`` (versions), ``config`` (path or null), ``ready`` (whether a scan
    with it could start; null without a configuration), ``worst`` (a verdict), ``findings`` (each with ``topic``,
    ``item``, ``verdict`` of ok, note, warning, fault, ``text``, ``remedy``).
    """
    gravest = worst(findings)
    return {
        "schema": SCHEMA,
        "scanner": version("mfs-scanner"),
        "python": platform.python_version(),
        "config": config,
        "ready": None if config is None else gravest is not Verdict.FAULT,
        "worst": gravest.value,
        "findings": [
            {"topic": f.topic, "item": f.item, "verdict": f.verdict.value, "text": f.text, "remedy": f.remedy}
            for f in findings
        ],
    }


def show(console: Console, findings: Sequence[Finding], config: str | None) -> None:
    """Print findings by topic, with the remedies of each below it, and the verdict at the end."""
    for topic in dict.fromkeys(f.topic for f in findings):
        of_topic = [f for f in findings if f.topic == topic]
        console.print()
        console.print(Text(topic, "bold"))
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column(width=1)
        table.add_column(style="dim", max_width=30)
        table.add_column()
        for finding in of_topic:
            mark, style = _MARKS[finding.verdict]
            text = Text(finding.text, style if finding.verdict is Verdict.FAULT else "")
            table.add_row(Text(mark, style), Text(finding.item), text)
        console.print(Padding(table, (0, 0, 0, 1)))
        for remedy, items in _remedies(of_topic).items():
            # Never wrapped nor indented beyond the first line: what is to be pasted must stay what it is.
            of_what = ", ".join(filter(None, items))
            console.print(Text(f" → {of_what}{': ' if of_what else ''}{remedy}", "yellow"), soft_wrap=True)
    console.print()
    console.print(Rule(style="dim"))
    console.print(_verdict(findings, config))


def _remedies(findings: Sequence[Finding]) -> dict[str, list[str]]:
    """Each remedy once, with the items it is for."""
    found: dict[str, list[str]] = {}
    for finding in findings:
        if finding.remedy:
            items = found.setdefault(finding.remedy, [])
            if finding.item not in items:
                items.append(finding.item)
    return found


def _verdict(findings: Sequence[Finding], config: str | None) -> Text:
    faults, warnings = (sum(f.verdict is v for f in findings) for v in (Verdict.FAULT, Verdict.WARNING))
    told = ", ".join(f"{n} {word}{'s' * (n != 1)}" for n, word in ((faults, "fault"), (warnings, "warning")) if n)
    if faults:
        what = "no scan could start on this machine" if config is None else f"a scan with {config} cannot start"
        return Text(f"✗ {what}: {told}", "bold red")
    what = "nothing stands in the way of a scan" if config is None else f"a scan with {config} can start"
    return Text(f"✓ {what}" + (f"; {told}" if warnings else ""), "bold green")
