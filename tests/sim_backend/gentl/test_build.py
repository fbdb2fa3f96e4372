"""The simulated producer is compiled when it is needed, once, and says what is missing."""

from __future__ import annotations

import os
import shutil

import pytest

from drivers.errors import MissingLibraryError
from sim_backend.gentl import build, producer_path


@pytest.mark.parametrize("compiler", [name for name in ("gcc", "clang") if shutil.which(name)] or ["cc"])
def test_compiles_without_a_warning(tmp_path, compiler):
    assert build.compile_producer(tmp_path, compiler, ("-O3", *build.WARNINGS)).exists()


def test_is_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setenv("MFS_SCANNER_CACHE", str(tmp_path))
    path = producer_path()
    assert path.suffix == ".cti"
    assert path.is_relative_to(tmp_path)
    made = path.stat().st_mtime_ns
    assert producer_path() == path
    assert path.stat().st_mtime_ns == made
    assert [entry.name for entry in path.parent.iterdir()] == ["mfs_sim.cti"]


def test_says_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("MFS_SCANNER_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(MissingLibraryError, match=r"no-such-compiler(.|\n)*apt install gcc"):
        producer_path()
    broken = tmp_path / "broken-cc"
    broken.write_text("#!/bin/sh\necho stdint.h is missing >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(MissingLibraryError, match="is missing"):
        producer_path()
    assert not list(tmp_path.glob("**/*.cti"))
    monkeypatch.delenv("CC")
    monkeypatch.setenv("MFS_SCANNER_CACHE", os.devnull)
    with pytest.raises(MissingLibraryError, match="MFS_SCANNER_CACHE"):
        producer_path()
