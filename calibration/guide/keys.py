"""What keys mean, whether a window or a terminal reads them."""

from __future__ import annotations

from collections.abc import Iterable

_MEANS = {"escape": "q", "close": "q", "enter": "space", "num_enter": "space", "pagedown": "space", "pageup": "b"}


def meant(keys: Iterable[str]) -> list[str]:
    """Keys by what they mean: Enter is the space bar, Escape and closing the window are ``q``.

    Page down and page up, which a presenter in the operator's hand sends, are the space bar and ``b``.
    """
    return [_MEANS.get(key, key) for key in keys]
