"""What a test needs beside Python: skipped with a reason where it is not there, failed where everything must run."""

from __future__ import annotations

import os

import pytest


def require(there: object, reason: str) -> None:
    """Skip unless ``there``; with MFS_SCANNER_REQUIRE_ALL=1, as CI sets it, fail instead."""
    if there:
        return
    if os.environ.get("MFS_SCANNER_REQUIRE_ALL") == "1":
        pytest.fail(f"nothing may be skipped here: {reason}")
    pytest.skip(reason)
