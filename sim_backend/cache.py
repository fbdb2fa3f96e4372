"""Computed light transport kept on disk, by content: the same scene, rig and settings are traced once."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
import threading
import zipfile
import zlib
from collections import OrderedDict
from pathlib import Path

import numpy as np
import platformdirs

from sim_backend.edges import WIDEST_PX
from sim_backend.settings import SceneSettings
from sim_backend.transport import Transport, trace

_log = logging.getLogger(__name__)
_SOURCES = (
    "blur",
    "cache",
    "camera_paths",
    "columns",
    "edges",
    "kernels",
    "mesh_files",
    "meshes",
    "prints",
    "projector_paths",
    "raycasting",
    "reflection",
    "scenes/__init__",
    "scenes/artefacts",
    "scenes/beside_mirror",
    "scenes/boards",
    "scenes/glossy",
    "scenes/industrial",
    "scenes/matt_objects",
    "scenes/mirrors",
    "scenes/pose",
    "scenes/shapes",
    "scenes/windows",
    "sheets",
    "solids",
    "surfaces",
    "transport",
    "viewpoint",
)
"""The modules that decide what tracing gives; their text is part of the content: no old result outlives them."""


class RecentTransports:
    """Light transport of what was looked at last, in memory: another exposure or another seed needs no tracing.

    Parameters
    ----------
    count
        How many are kept.
    """

    def __init__(self, count: int = 2) -> None:
        self._count = count
        self._kept: OrderedDict[str, Transport] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, settings: SceneSettings) -> Transport:
        """The light transport of a bench, from memory if it is there, else as `transport_of`."""
        content = _content_hash(settings)
        with self._lock:
            transport = self._kept.get(content)
        if transport is None:
            transport = transport_of(settings)
        with self._lock:
            self._kept[content] = transport
            self._kept.move_to_end(content)
            while len(self._kept) > self._count:
                self._kept.popitem(last=False)
        return transport


def transport_of(settings: SceneSettings) -> Transport:
    """The light transport of a bench, from the cache or traced anew and cached, if the scene may be seen again.

    A cache that cannot be read or written costs time, never the scan.
    """
    if settings.scene.seen_once:
        return trace(settings.scene.surfaces(), settings.rig(), settings.transport, settings.camera.blur_px)
    path = _folder(settings) / f"transport-{_content_hash(settings)}.npz"
    if path.exists():
        try:
            # Reading a zip member checks its CRC-32: a damaged file does not pass.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                transport = Transport.from_arrays({name: stored[name] for name in stored.files})
            os.utime(path)
            return transport
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            _log.warning("cached light transport %s is damaged (%s) and is traced again", path, error)
    _log.info("tracing the light of scene %s, once", settings.scene.name)
    transport = trace(settings.scene.surfaces(), settings.rig(), settings.transport, settings.camera.blur_px)
    try:
        _store(transport, path, settings.cache_limit_mb * 1_000_000)
    except OSError as error:
        _log.warning("light transport cannot be cached in %s (%s) and is traced anew each time", path.parent, error)
    return transport


def _folder(settings: SceneSettings) -> Path:
    if settings.cache_dir is not None:
        return settings.cache_dir
    named = os.environ.get("MFS_SCANNER_CACHE")
    return Path(named) if named else Path(platformdirs.user_cache_dir("mfs-scanner", appauthor=False))


def _content_hash(settings: SceneSettings) -> str:
    here = Path(__file__).parent
    content = {
        "sources": [hashlib.sha256((here / f"{name}.py").read_bytes()).hexdigest() for name in _SOURCES],
        "scene": settings.scene.model_dump(mode="json"),
        "files": [hashlib.sha256(_content(path)).hexdigest() for path in settings.scene.files()],
        "rig": settings.rig().to_json(),
        "blur_px": min(settings.camera.blur_px, WIDEST_PX),
        "transport": settings.transport.model_dump(mode="json"),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def _content(path: Path) -> bytes:
    """What a file holds; nothing if it cannot be read, which the scene will say better."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _store(transport: Transport, path: Path, limit_bytes: int) -> None:
    """Write under a temporary name, rename when complete, then delete the longest unused until the limit is kept."""
    arrays = transport.to_arrays()
    if sum(a.nbytes for a in arrays.values()) > limit_bytes:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix="transport-", suffix=".part", delete=False) as file:
        try:
            np.savez(file, allow_pickle=False, **arrays)
            file.close()
            os.replace(file.name, path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise
    kept = sorted(path.parent.glob("transport-*"), key=lambda p: p.stat().st_mtime, reverse=True)
    total = 0
    for entry in kept:
        total += entry.stat().st_size
        if total > limit_bytes and entry != path:
            entry.unlink(missing_ok=True)
