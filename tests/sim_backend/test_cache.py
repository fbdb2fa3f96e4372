import ast
import os
from pathlib import Path

import numpy as np
import pytest

from sim_backend import cache
from sim_backend.cache import RecentTransports, transport_of
from sim_backend.settings import SimulatedSettings


@pytest.fixture
def settings(tmp_path):
    def make(scene="sphere", **changes):
        return SimulatedSettings.model_validate(
            {
                "scene": {"name": scene},
                "camera": {"width_px": 64, "height_px": 48},
                "projector": {"width_px": 160, "height_px": 100},
                "transport": {"photons": 10_000, "supersample": 1},
                "cache_dir": tmp_path / "cache",
                **changes,
            }
        )

    return make


@pytest.fixture
def traced(monkeypatch):
    """How often light has been traced."""
    calls = []
    original = cache.trace
    monkeypatch.setattr(cache, "trace", lambda *a: calls.append(1) or original(*a))
    return calls


def _same(a, b):
    left, right = a.to_arrays(), b.to_arrays()
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)
        assert left[name].dtype == right[name].dtype


@pytest.mark.parametrize("scene", ["sphere", "mirror", "v_groove"])
def test_a_hit_gives_the_very_same_matrices(settings, traced, scene):
    first, second = transport_of(settings(scene)), transport_of(settings(scene))
    assert len(traced) == 1
    _same(first, second)
    light = np.random.default_rng(0).random((100, 160), np.float32)
    np.testing.assert_array_equal(first.direct_light(light), second.direct_light(light))
    np.testing.assert_array_equal(first.bounced_light(light), second.bounced_light(light))


@pytest.mark.parametrize("scene", ["v_groove", "fins", "mirror_textured", "mirror_translucent"])
def test_tracing_is_deterministic(settings, tmp_path, scene):
    _same(transport_of(settings(scene)), transport_of(settings(scene, cache_dir=tmp_path / "other")))


def test_the_cache_keeps_all_of_it(settings):
    traced, kept = transport_of(settings("mirror_translucent")), transport_of(settings("mirror_translucent"))
    _same(traced, kept)
    assert kept.spreads == traced.spreads != ()


def _entry(folder):
    (path,) = folder.glob("transport-*.npz")
    return path


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "text"])
def test_a_damaged_entry_is_traced_again(settings, traced, tmp_path, damage, caplog):
    first = transport_of(settings())
    path = _entry(tmp_path / "cache")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(
        {"flip": bytes(content), "cut": bytes(content[:-500]), "empty": b"", "text": b"not a cache"}[damage]
    )
    _same(first, transport_of(settings()))
    assert len(traced) == 2
    assert "damaged" in caplog.text
    _same(first, transport_of(settings()))
    assert len(traced) == 2


def test_only_what_changes_the_light_is_traced_again(settings, traced):
    transport_of(settings())
    transport_of(settings(seed=7, settle_s=0.1, faults={"drop_at": [3]}))
    transport_of(settings(camera={"width_px": 64, "height_px": 48, "exposure_us": 5000.0}))
    assert len(traced) == 1
    transport_of(settings(baseline_mm=150.0))
    transport_of(settings(scene="plane"))
    assert len(traced) == 3


def test_the_lens_is_part_of_the_light_as_far_as_it_blurs_before_sampling(settings, traced):
    for blur_px in (0.5, 0.4, 1.0, 3.0):
        transport_of(settings(camera={"width_px": 64, "height_px": 48, "blur_px": blur_px}))
    assert len(traced) == 3


def test_cache_keeps_its_size(settings, tmp_path):
    transport_of(settings())
    size = _entry(tmp_path / "cache").stat().st_size
    limit_mb = 1 + size // 1_000_000
    for age, baseline in enumerate(range(100, 160, 10)):
        transport_of(settings(baseline_mm=float(baseline), cache_limit_mb=limit_mb))
        for path in (tmp_path / "cache").glob("transport-*.npz"):
            os.utime(path, (path.stat().st_atime, path.stat().st_mtime - 10 * age))
    entries = list((tmp_path / "cache").iterdir())
    assert len(entries) >= 1
    assert sum(path.stat().st_size for path in entries) <= limit_mb * 1_000_000


def test_no_room_no_cache(settings, traced, tmp_path):
    transport_of(settings(cache_limit_mb=0))
    transport_of(settings(cache_limit_mb=0))
    assert len(traced) == 2
    assert not (tmp_path / "cache").exists()


def test_a_folder_that_cannot_be_written_costs_time_only(settings, traced, tmp_path, caplog):
    (tmp_path / "file").write_text("in the way")
    transport_of(settings(cache_dir=tmp_path / "file" / "cache"))
    assert len(traced) == 1
    assert "cannot be cached" in caplog.text


def test_environment_names_the_folder_unless_the_settings_do(settings, tmp_path, monkeypatch):
    monkeypatch.setenv("MFS_SCANNER_CACHE", str(tmp_path / "by-environment"))
    transport_of(settings(cache_dir=None))
    assert _entry(tmp_path / "by-environment").exists()
    transport_of(settings())
    assert _entry(tmp_path / "cache").exists()


def test_memory_keeps_what_was_looked_at_last(settings, traced):
    recent = RecentTransports(count=2)
    board, sphere, plane = (settings(scene, cache_limit_mb=0) for scene in ("board", "sphere", "plane"))
    first = recent.of(board)
    recent.of(sphere)
    assert recent.of(board) is first
    assert recent.of(board.model_copy(update={"seed": 4})) is first
    recent.of(plane)  # forgets the sphere
    assert recent.of(board) is first
    assert len(traced) == 3
    recent.of(sphere)
    assert len(traced) == 4


def test_every_module_that_decides_the_light_is_part_of_the_content():
    """Those that tracing and scenes import, and their imports; of the settings, the values are in the content."""
    folder = Path(cache.__file__).parent
    scenes = {f"scenes/{path.stem}" for path in (folder / "scenes").glob("*.py")}
    found, todo = set(), ["cache", *scenes]
    while todo:
        name = todo.pop()
        found.add(name)
        for node in ast.walk(ast.parse((folder / f"{name}.py").read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sim_backend."):
                imported = node.module.removeprefix("sim_backend.").replace(".", "/")
                imported = f"{imported}/__init__" if (folder / imported).is_dir() else imported
                if imported not in found and imported != "settings":
                    todo.append(imported)
    assert set(cache._SOURCES) == found
