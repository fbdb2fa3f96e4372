"""What the tests of the simulated GenTL producer need, and say when it is missing."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from requirements import require
from stock_harvesters import Harvester

from drivers.errors import MissingLibraryError
from sim_backend.gentl import producer_path


@pytest.fixture(autouse=True)
def producer_here():
    require(Harvester, "needs harvesters: pip install mfs-scanner[genicam]")
    why_not = ""
    try:
        producer_path()
    except MissingLibraryError as error:
        why_not = str(error)
    require(not why_not, f"needs the simulated producer: {why_not}")


@pytest.fixture
def folder():
    """Not tmp_path: the path of a unix socket has to be short."""
    with tempfile.TemporaryDirectory(prefix="mfs") as name:
        yield Path(name)
