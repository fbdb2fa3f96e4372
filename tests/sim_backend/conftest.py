"""Small benches whose light is traced once per test session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sim_backend.bench import truth_of
from sim_backend.settings import SimulatedSettings
from sim_backend.truth import Truth

SMALL = {
    "camera": {"width_px": 256, "height_px": 192},
    "projector": {"width_px": 640, "height_px": 400},
    "transport": {"photons": 200_000},
}


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    return base | {
        key: _merged(base[key], value) if isinstance(value, dict) and key in base else value
        for key, value in changes.items()
    }


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., SimulatedSettings]:
    """Settings of a bench with a small camera and few photons: ``small(scene={...}, camera={...})``."""
    cache: Path = tmp_path_factory.mktemp("transport")

    def settings(**changes: Any) -> SimulatedSettings:
        return SimulatedSettings.model_validate(_merged({**SMALL, "cache_dir": cache}, changes))

    return settings


@pytest.fixture(scope="session")
def truth(small: Callable[..., SimulatedSettings]) -> Callable[..., Truth]:
    """Truth of such a bench."""
    return lambda **changes: truth_of(small(**changes))
