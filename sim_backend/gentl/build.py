"""Compile the simulated GenTL producer when it is first needed, and keep it in the user's cache."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import platformdirs

from drivers.errors import MissingLibraryError

_HERE = Path(__file__).parent
FLAGS = ("-std=c11", "-D_GNU_SOURCE", "-D_DARWIN_C_SOURCE", "-fPIC", "-fvisibility=hidden", "-pthread")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Werror")


def producer_path() -> Path:
    """The compiled producer (``.cti``); compiled now where it is not in the cache.

    The cache is the one of the light transport: the folder that MFS_SCANNER_CACHE names, or the user's cache folder.

    Raises
    ------
    MissingLibraryError
        There is no C compiler, it failed, or this is neither Linux nor macOS; says what to do.
    """
    if sys.platform not in ("linux", "darwin"):
        raise MissingLibraryError(
            f"the simulated camera cannot be built on {sys.platform}", "Run the virtual bench on Linux or macOS."
        )
    compiler = _compiler()
    named = os.environ.get("MFS_SCANNER_CACHE")
    folder = Path(named).absolute() if named else Path(platformdirs.user_cache_dir("mfs-scanner", appauthor=False))
    path = folder / f"gentl-{_content_hash(compiler)}" / "mfs_sim.cti"
    if path.exists():
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as draft:
            built = compile_producer(Path(draft), compiler, ("-O3",))
            os.replace(built, path)
    except OSError as error:
        raise MissingLibraryError(
            f"the simulated camera cannot be built in {path.parent}: {error}",
            "Let MFS_SCANNER_CACHE name a folder that can be written and has some megabytes free.",
        ) from error
    return path


def compile_producer(folder: Path, compiler: str, options: Sequence[str] = ()) -> Path:
    """Compile ``mfs_sim.cti`` into ``folder``, with further ``options`` of the compiler.

    Raises
    ------
    MissingLibraryError
        The compiler failed; the message holds what it said.
    """
    (folder / "description.c").write_text(_description_source(), encoding="ascii")
    result = folder / "mfs_sim.cti"
    shared = ("-bundle",) if sys.platform == "darwin" else ("-shared",)
    libraries = () if sys.platform == "darwin" else ("-lm", "-ldl")
    sources = [*sorted(str(p) for p in _HERE.glob("*.c")), str(folder / "description.c")]
    command = [*shlex.split(compiler), *FLAGS, *options, *shared, f"-I{_HERE}", *sources, "-o", str(result), *libraries]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise MissingLibraryError(
            f"the simulated camera cannot be compiled with {compiler}:\n{done.stderr.strip()[:2000]}",
            "Install a C compiler and its headers (apt install gcc libc6-dev; macOS: xcode-select --install).",
        )
    return result


def _compiler() -> str:
    wanted = os.environ.get("CC")
    for command in (wanted,) if wanted else ("cc", "gcc", "clang"):
        if shutil.which(shlex.split(command)[0]):
            return command
    raise MissingLibraryError(
        f"the simulated camera needs a C compiler and {wanted or 'none'} is found",
        "Install one (apt install gcc libc6-dev; macOS: xcode-select --install), or let CC name it.",
    )


def _content_hash(compiler: str) -> str:
    digest = hashlib.sha256(repr((compiler, FLAGS, sys.platform)).encode())
    for path in [Path(__file__), *sorted(p for p in _HERE.iterdir() if p.suffix in (".c", ".h", ".xml"))]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:24]


def _description_source() -> str:
    """C source with the two descriptions of `device.xml`, the modern and the legacy one, as bytes."""
    xml = (_HERE / "device.xml").read_text(encoding="utf-8")
    lines = ['#include "description.h"']
    for name, other in (("description", "legacy"), ("legacy_description", "modern")):
        text = re.sub(rf"[ ]*<!-- if {other} -->.*?<!-- end -->\n", "", xml, flags=re.DOTALL)
        text = re.sub(r"[ ]*<!--.*?-->\n", "", text, flags=re.DOTALL)
        content = text.encode()
        lines.append(f"const uint8_t {name}[] = {{{','.join(map(str, content))}}};")
        lines.append(f"const size_t {name}_size = sizeof {name};")
    return "\n".join(lines) + "\n"
