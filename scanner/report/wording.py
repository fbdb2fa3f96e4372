"""How the report writes: numbers for people, and the pieces of HTML that sections are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np


def number(value: object) -> str:
    """Write a value for a table: whole numbers in groups of three, others to four figures, None and NaN as a dash."""
    match value:
        case None:
            return "–"
        case bool() | np.bool_():
            return "yes" if value else "no"
        case int() | np.integer():
            return f"{value:,}".replace(",", "\u202f")
        case float() | np.floating():
            real = float(value)
            if not math.isfinite(real):
                return "–"
            text = f"{real:,.0f}".replace(",", "\u202f") if abs(real) >= 1e4 else f"{real:.4g}"
            return text.replace("-", "−")
        case _:
            return str(value)


def length(mm: float) -> str:
    """Write a length in the unit that suits it."""
    if not math.isfinite(mm):
        return "–"
    return f"{1000 * mm:.3g} µm" if abs(mm) < 0.1 else f"{mm:.3g} mm"


def per_cent(share: float) -> str:
    """Write a share 0..1, with the figures that tell 99.99 % from 100 %."""
    if not math.isfinite(share):
        return "–"
    return f"{100 * share:.{4 if 0.999 <= share < 1 else 3}g} %"


def words(key: str) -> str:
    """Write a key of the summary as words."""
    return escape(key.replace("_", " "))


def section(title: str, content: str) -> str:
    """Make a section with its heading; nothing where there is no content."""
    return f"<section><h2>{title}</h2>{content}</section>" if content else ""


def grid(title: str, figures: Iterable[str]) -> str:
    """Make a section of figures side by side; nothing where there are none."""
    inside = "".join(figures)
    return section(title, f'<div class="grid">{inside}</div>' if inside else "")


def figure(key: str, title: str, content: str, caption: str) -> str:
    """Make a figure; ``title`` and ``caption`` are HTML."""
    return f'<figure id="{key}">{content}<figcaption><b>{title}</b> {caption}</figcaption></figure>'


def table(key: str, head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Make a table; a row is its class and its cells, all HTML."""
    top = "".join(f"<th>{h}</th>" for h in head)
    body = "".join(f'<tr class="{kind}">{"".join(f"<td>{c}</td>" for c in cells)}</tr>' for kind, cells in rows)
    return f'<table id="{key}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>'


def listing(key: str, title: str, values: Mapping[str, Any], unit: str = "") -> str:
    """Make a two-column table of names and values; nothing where there are none."""
    if not values:
        return ""
    rows = "".join(
        f"<tr><th>{words(str(k))}</th><td>{escape(number(v))}{' ' + unit if unit else ''}</td></tr>"
        for k, v in values.items()
    )
    return f'<div><h3>{title}</h3><table id="{key}"><tbody>{rows}</tbody></table></div>'
