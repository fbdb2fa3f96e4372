"""Result folders: complete under their name or kept under another, never overwritten or lost."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import scanner.folder
from drivers import OperatorError
from scanner.folder import (
    ComparisonFolder,
    OutputError,
    OutputFolder,
    PlanFolder,
    ResultFolder,
    StudyFolder,
    read_result,
    write_result,
)
from scanner.patterns import Plan, phase_steps
from scanner.result import Flag, Maps, ScanResult
from scanner.rig import Lens, Rig

SHAPE = (30, 40)
FILES = {"result.json", "maps.npz", "cloud.ply", "report.html", "rig.json", "config.yaml"}


def result(**changes: object) -> ScanResult:
    """A flat board at 500 mm with a hole."""
    rng = np.random.default_rng(2)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    hole = (u > 30) & (v > 20)

    def measured(values: np.ndarray) -> np.ndarray:
        return np.where(hole, np.nan, values).astype(np.float32)

    points = np.dstack([measured((u - 20) * 2), measured((v - 15) * 2), measured(500 + 0 * u)])
    ones = np.ones(SHAPE, np.float32)
    maps = Maps(
        x_p=measured(u * 10),
        y_p=measured(v * 10),
        sigma_x=measured(0.01 * ones),
        sigma_y=measured(0.02 * ones),
        modulation=80 * ones,
        brightness=90 * ones,
        variation=ones,
        misfit=rng.chisquare(32, SHAPE).astype(np.float32) / 32,
        misfit_dof=32,
        interreflection=u < 5,
        flags=np.where(hole, Flag.LOW_MODULATION, 0).astype(np.uint16),
        depth=points[..., 2],
        points=points,
        sigma_point=measured(0.02 * ones),
        sigma_rig=measured(0.01 * ones),
        epipolar_px=measured(0 * u),
        x_p_round1=measured(u * 10),
        y_p_round1=measured(v * 10),
        misfit_round2=measured(ones),
        lit=rng.random((16, 24)) < 0.5,
        regional_pattern=rng.integers(0, 1024, SHAPE).astype(np.uint16),
    )
    summary = {
        "counts": {"valid": np.int64(1089)},
        "frames": {"round 1": 216, "round 2": 216},
        "timings_s": {"capture": 1.5},
        "quality": {"median misfit": np.float32(1.0), "never known": float("nan")},
        "gates": [{"name": "coverage", "value": 0.9, "limit": 0.5, "passed": True, "meaning": "share"}],
        "noise": {"read_dn": 1.5, "dn_per_electron": 0.0},
        "versions": {"mfs-scanner": "0.1.0"},
    }
    return replace(ScanResult("mfs", True, maps, summary, ["dim → slow"]), **changes)


def rig() -> Rig:
    lens = Lens(np.array([[250.0, 0, 20], [0, 250, 15], [0, 0, 1]]), np.zeros(5), (40, 30))
    return Rig(lens, lens, np.eye(3), np.array([-100.0, 0, 0]))


def record(folder: ResultFolder) -> None:
    """A recording, as far as a folder can tell."""
    (folder.path / "take").mkdir()
    (folder.path / "take" / "frames.bin").write_bytes(b"frames")


def work(folder: OutputFolder, *steps: Callable[[], object]) -> None:
    """Do ``steps`` inside ``folder``."""
    with folder:
        for step in steps:
            step()


def fail(error: BaseException) -> None:
    raise error


def tree(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*")}


# Writing and reading


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written")
    plan = Plan((1280, 800), (phase_steps("x", 1 / 16, 12),)).to_json()
    write_result(path, result(), rig=rig(), config_yaml="bench: {kind: simulated} # größer\n", plans=[plan])
    return path


def test_all_files_are_there(written: Path) -> None:
    assert {p.name for p in written.iterdir()} == FILES
    assert (written / "config.yaml").read_text("utf-8") == "bench: {kind: simulated} # größer\n"
    assert Rig.load(written / "rig.json").to_json() == rig().to_json()
    assert "SIMULATED DATA" in (written / "report.html").read_text("utf-8")
    header, body = (written / "cloud.ply").read_bytes().split(b"end_header\n", 1)
    points = int(np.isfinite(result().maps.depth).sum())
    assert f"element vertex {points}\n".encode() in header
    assert len(body) == points * (4 * 7 + 3)  # x y z nx ny nz σ in float32, three colours in a byte


def test_result_json_says_what_was_done(written: Path) -> None:
    document = json.loads((written / "result.json").read_text("utf-8"))
    assert document["method"] == "mfs"
    assert document["simulated"] is True
    assert document["created"].endswith("+00:00")
    assert document["counts"] == {"valid": 1089}
    assert document["quality"] == {"median misfit": 1.0, "never known": None}
    assert document["gates"][0]["passed"] is True
    assert document["warnings"] == ["dim → slow"]
    assert Plan.from_json(document["plans"][0]).frame_count == 12
    assert {"timings_s", "noise", "versions", "frames"} <= set(document)


def test_maps_have_the_names_and_types_that_others_rely_on(written: Path) -> None:
    types = dict.fromkeys(("x_p", "y_p", "sigma_x", "sigma_y", "modulation", "depth", "points"), "float32")
    types |= dict.fromkeys(("x_p_round1", "y_p_round1"), "float32")
    types |= {"interreflection": "bool", "flags": "uint16", "lit": "bool"}
    with np.load(written / "maps.npz", allow_pickle=False) as maps:
        assert {name: str(maps[name].dtype) for name in types} == types
        assert maps["points"].shape == (*SHAPE, 3)
        assert maps["lit"].shape == (16, 24)
        assert np.isnan(maps["x_p"][25, 35])
        assert maps["flags"][25, 35] == 1


def test_round_trip(written: Path) -> None:
    back, given = read_result(written), result()
    assert (back.method, back.simulated, back.warnings) == ("mfs", True, given.warnings)
    assert back.summary["timings_s"] == given.summary["timings_s"]
    for field in fields(Maps):
        found, expected = getattr(back.maps, field.name), getattr(given.maps, field.name)
        np.testing.assert_array_equal(found, expected, err_msg=field.name)
        assert getattr(found, "dtype", int) == getattr(expected, "dtype", int), field.name


def test_one_axis_without_rig(tmp_path: Path) -> None:
    absent = (
        "y_p",
        "sigma_y",
        "depth",
        "points",
        "sigma_point",
        "sigma_rig",
        "epipolar_px",
        "lit",
        "y_p_round1",
        "variation",
    )
    given = result()
    given = replace(given, maps=replace(given.maps, **dict.fromkeys(absent)))
    write_result(tmp_path, given, report=False)
    assert {p.name for p in tmp_path.iterdir()} == {"result.json", "maps.npz"}
    with np.load(tmp_path / "maps.npz") as maps:
        assert not set(absent) & set(maps.files)
    assert all(getattr(read_result(tmp_path).maps, name) is None for name in absent)


def test_nothing_measured_is_a_result_too(tmp_path: Path) -> None:
    given = result()
    maps = replace(given.maps, points=np.full((*SHAPE, 3), np.nan, np.float32))
    write_result(tmp_path, replace(given, maps=maps), ply=True, report=False)
    assert {p.name for p in tmp_path.iterdir()} == {"result.json", "maps.npz"}


def test_no_cloud_where_none_is_wanted(tmp_path: Path) -> None:
    write_result(tmp_path, result(), ply=False, report=False)
    assert {p.name for p in tmp_path.iterdir()} == {"result.json", "maps.npz"}


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda p: (p / "result.json").unlink(), "not a result folder"),
        (lambda p: (p / "result.json").write_text("{"), "damaged"),
        (lambda p: (p / "result.json").write_text('{"format": "mfs-scanner result", "version": 2}'), "version 2"),
        (lambda p: (p / "maps.npz").unlink(), "damaged"),
        (lambda p: os.truncate(p / "maps.npz", 5000), "damaged"),
        (lambda p: np.savez(p / "maps.npz", x_p=np.zeros(3)), "damaged"),
    ],
)
def test_what_is_no_result_is_refused(tmp_path: Path, spoil: object, says: str) -> None:
    write_result(tmp_path, result(), ply=False, report=False)
    spoil(tmp_path)  # type: ignore[operator]
    with pytest.raises(OutputError, match=says) as caught:
        read_result(tmp_path)
    assert str(tmp_path) in caught.value.message
    assert caught.value.remedy


# Reserving a place


def test_folder_appears_when_complete(tmp_path: Path) -> None:
    out = tmp_path / "scan"
    with ResultFolder(out) as folder:
        assert not out.exists()
        assert folder.path.parent == tmp_path
        assert folder.path.name.startswith(".scan.partial-")
        record(folder)
        write_result(folder.path, result(), ply=False, report=False)
    assert tree(tmp_path) == {"scan", *(f"scan/{n}" for n in ("result.json", "maps.npz", "take", "take/frames.bin"))}
    assert folder.path == folder.out == out
    assert folder.notices == []


def test_take_can_be_discarded_in_the_end(tmp_path: Path) -> None:
    with ResultFolder(tmp_path / "scan") as folder:
        record(folder)
        folder.discard_take()
        assert (folder.path / "take").exists()  # not before the result is there
        (folder.path / "result.json").touch()
    assert tree(tmp_path) == {"scan", "scan/result.json"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_places_that_cannot_be_used(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    before = tree(tmp_path)
    for out, says in (
        (tmp_path / "missing" / "scan", "not a folder"),
        (tmp_path / "file" / "scan", "not a folder"),
        (tmp_path / "file", "is a file"),
        (tmp_path / "other", "no result.json but other files" if overwrite else "exists"),
        (tmp_path / ("x" * 250), "File name too long"),
    ):
        with pytest.raises(OutputError, match=says) as caught, ResultFolder(out, overwrite):
            pytest.fail("nothing may be projected")
        assert caught.value.exit_code == 2
        assert "--out" in caught.value.remedy
    assert tree(tmp_path) == before


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that even root cannot write")
def test_place_that_may_not_be_written() -> None:
    with pytest.raises(OutputError, match="no folder can be made in /proc"), ResultFolder("/proc/scan"):
        pytest.fail("nothing may be projected")


def test_existing_result_is_refused_and_untouched(tmp_path: Path) -> None:
    out = tmp_path / "scan"
    out.mkdir()
    (out / "result.json").write_text("old")
    with pytest.raises(OutputError, match="exists") as caught, ResultFolder(out):
        pytest.fail("nothing may be projected")
    assert "--overwrite" in caught.value.remedy
    assert (out / "result.json").read_text() == "old"


# Replacing


def test_overwrite_replaces_at_the_end(tmp_path: Path) -> None:
    out = tmp_path / "scan"
    for content in ("old", "new"):
        with ResultFolder(out, overwrite=True) as folder:
            record(folder)
            (folder.path / "result.json").write_text(content)
            (folder.path / f"only {content}").touch()
            if content == "new":
                assert (out / "result.json").read_text() == "old"
    assert (out / "result.json").read_text() == "new"
    assert tree(tmp_path) == {"scan", "scan/result.json", "scan/only new", "scan/take", "scan/take/frames.bin"}


def test_failed_overwrite_keeps_the_old(tmp_path: Path) -> None:
    out = tmp_path / "scan"
    out.mkdir()
    (out / "result.json").write_text("old")
    with pytest.raises(ZeroDivisionError), ResultFolder(out, overwrite=True):
        raise ZeroDivisionError
    assert tree(tmp_path) == {"scan", "scan/result.json"}


def test_overwrite_keeps_a_recording_that_the_new_one_lacks(tmp_path: Path) -> None:
    """Processing a take into the very folder that holds it must not delete it."""
    out = tmp_path / "scan"
    with ResultFolder(out) as folder:
        record(folder)
        (folder.path / "result.json").touch()
    with ResultFolder(out, overwrite=True) as folder:
        (folder.path / "result.json").write_text("new")
    assert (out / "result.json").read_text() == "new"
    assert (tmp_path / "scan.previous" / "take" / "frames.bin").read_bytes() == b"frames"
    assert any(str(tmp_path / "scan.previous" / "take") in notice for notice in folder.notices)


def test_empty_folder_may_be_overwritten_and_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with ResultFolder(tmp_path / "link", overwrite=True) as folder:
        (folder.path / "result.json").touch()
    assert (tmp_path / "link").is_symlink()
    assert tree(tmp_path) == {"link", "real", "real/result.json"}


def test_folder_that_appears_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "scan"
    folder = ResultFolder(out)

    def both_write() -> None:
        (folder.path / "result.json").write_text("mine")
        out.mkdir()
        (out / "result.json").write_text("theirs")

    with pytest.raises(OutputError, match="exists") as caught:
        work(folder, both_write)
    assert (out / "result.json").read_text() == "theirs"
    assert (tmp_path / "scan.incomplete" / "result.json").read_text() == "mine"
    assert str(tmp_path / "scan.incomplete") in caught.value.remedy


def test_rename_that_fails_puts_the_old_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "scan"
    out.mkdir()
    (out / "result.json").write_text("old")
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if ".partial-" in self.name and target == out:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OutputError, match="cannot be renamed") as caught, ResultFolder(out, overwrite=True) as folder:
        (folder.path / "result.json").write_text("new")
    assert (out / "result.json").read_text() == "old"
    assert (tmp_path / "scan.incomplete" / "result.json").read_text() == "new"
    assert str(tmp_path / "scan.incomplete") in caught.value.remedy
    assert tree(tmp_path) == {"scan", "scan/result.json", "scan.incomplete", "scan.incomplete/result.json"}


# Failing


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(1), RuntimeError("bug")])
def test_interruption_keeps_the_recording(tmp_path: Path, error: BaseException) -> None:
    folder = ResultFolder(tmp_path / "scan")
    with pytest.raises(type(error)) as caught:
        work(folder, lambda: record(folder), lambda: fail(error))
    kept = tmp_path / "scan.incomplete"
    assert (kept / "take" / "frames.bin").read_bytes() == b"frames"
    assert tree(tmp_path) == {"scan.incomplete", "scan.incomplete/take", "scan.incomplete/take/frames.bin"}
    assert str(kept) in caught.value.__notes__[0]
    assert folder.notices == caught.value.__notes__


def test_each_interruption_gets_a_name_of_its_own(tmp_path: Path) -> None:
    for _ in range(3):
        folder = ResultFolder(tmp_path / "scan")
        with pytest.raises(KeyboardInterrupt):
            work(folder, partial(record, folder), lambda: fail(KeyboardInterrupt()))
    assert {p.name for p in tmp_path.iterdir()} == {"scan.incomplete", "scan.incomplete-2", "scan.incomplete-3"}


def test_error_for_the_operator_names_where_the_recording_is_now(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "scan")
    take = folder.path / "take"
    with pytest.raises(OperatorError) as caught:
        work(
            folder,
            lambda: record(folder),
            lambda: fail(OperatorError(f"{take}: 24 frames are safe", f"Resume {take}.")),
        )
    said = str(caught.value)
    assert ".partial-" not in said
    assert said.startswith(f"{tmp_path / 'scan.incomplete' / 'take'}: 24 frames are safe")
    assert f"Resume {tmp_path / 'scan.incomplete' / 'take'}." in said
    assert f"kept in {tmp_path / 'scan.incomplete'}" in caught.value.remedy


def test_nothing_is_left_where_nothing_was_recorded(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "scan")

    def begin_a_take() -> None:
        (folder.path / "take").mkdir()
        (folder.path / "take" / "manifest.json").write_text("{}")
        (folder.path / "take" / "frames.bin").touch()

    with pytest.raises(KeyboardInterrupt):
        work(folder, begin_a_take, lambda: (folder.path / "cloud.ply").touch(), lambda: fail(KeyboardInterrupt()))
    assert tree(tmp_path) == set()
    assert folder.notices == []


def test_recordings_of_killed_scans_are_pointed_at(tmp_path: Path) -> None:
    """A process that is killed renames nothing."""
    killed = ResultFolder(tmp_path / "first")
    killed.__enter__()
    record(killed)
    with ResultFolder(tmp_path / "second") as folder:
        (folder.path / "result.json").touch()
    assert len(folder.notices) == 1
    assert str(killed.path) in folder.notices[0]
    assert (killed.path / "take" / "frames.bin").exists()


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("at", "written", "missing"),
    [
        ("_write_text", "nothing", "rig.json, config.yaml, cloud.ply, report.html, maps.npz, result.json"),
        ("_write_maps", "rig.json, config.yaml, cloud.ply, report.html", "maps.npz, result.json"),
    ],
)
def test_full_disk_says_what_is_there_and_keeps_the_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, written: str, missing: str
) -> None:
    def full(file: Path, _: object) -> None:
        file.write_bytes(b"half of it")
        raise FULL

    monkeypatch.setattr(scanner.folder, at, full)
    folder = ResultFolder(tmp_path / "scan")
    with pytest.raises(OutputError) as caught:
        work(
            folder,
            lambda: record(folder),
            lambda: write_result(folder.path, result(), rig=rig(), config_yaml=""),
        )
    kept = tmp_path / "scan.incomplete"
    name = missing.split(", ")[0]
    assert caught.value.message == (
        f"{kept / name} could not be written: No space left on device; written: {written}; not written: {missing}"
    )
    assert str(kept) in caught.value.remedy
    assert (kept / "take" / "frames.bin").exists()
    assert not (kept / name).exists()  # no half file
    assert not (tmp_path / "scan").exists()


def test_full_disk_in_the_middle_of_the_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills up under NumPy's own writing."""
    before = np.lib.format.write_array
    calls: list[int] = []

    def filling(*given: object, **options: object) -> None:
        calls.append(1)
        if len(calls) > 4:
            raise FULL
        before(*given, **options)

    monkeypatch.setattr(np.lib.format, "write_array", filling)
    with pytest.raises(OutputError, match="No space left") as caught:
        write_result(tmp_path, result(), ply=False, report=False)
    assert "not written: maps.npz, result.json" in caught.value.message
    assert len(calls) == 5
    assert list(tmp_path.iterdir()) == []


def test_cloud_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scanner.cloud import Cloud, CloudError

    def refuse(self: Cloud, path: Path) -> None:
        raise CloudError("cannot write it: No space left on device", "Make room.")

    monkeypatch.setattr(Cloud, "save", refuse)
    with pytest.raises(OutputError, match=r"cloud.ply could not be written.*No space left"):
        write_result(tmp_path, result(), report=False)


def test_full_disk_while_recording(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "scan")
    with pytest.raises(OutputError, match="No space left") as caught:
        work(folder, lambda: record(folder), lambda: fail(FULL))
    assert str(tmp_path / "scan.incomplete") in caught.value.remedy
    assert (tmp_path / "scan.incomplete" / "take" / "frames.bin").exists()


# Comparisons


def test_comparison_holds_results(tmp_path: Path) -> None:
    out = tmp_path / "compared"
    with ComparisonFolder(out) as folder:
        with ResultFolder(folder.path / "mfs") as inner:
            record(inner)
            (inner.path / "result.json").touch()
        folder.write_json("comparison.json", {"rows": [{"std_mm": np.float64("nan"), "frames": np.int64(3)}]})
    assert json.loads((out / "comparison.json").read_text()) == {"rows": [{"std_mm": None, "frames": 3}]}
    assert (out / "mfs" / "take" / "frames.bin").exists()
    with pytest.raises(OutputError, match=r"holds no result\.json"), ResultFolder(out, overwrite=True):
        pytest.fail("a comparison is no result")
    with ComparisonFolder(out, overwrite=True) as folder:
        folder.write_json("comparison.json", {})
    assert (tmp_path / "compared.previous" / "mfs" / "take").is_dir()


@pytest.mark.parametrize("kind", [StudyFolder, PlanFolder])
def test_documents_replace_their_own_kind_only(tmp_path: Path, kind: type[OutputFolder]) -> None:
    out = tmp_path / "found"
    for number in range(2):
        with kind(out, overwrite=number > 0) as folder:
            folder.write_json(kind.marker, {"number": number})
    assert json.loads((out / kind.marker).read_text()) == {"number": 1}
    with pytest.raises(OutputError, match="but other files"), ComparisonFolder(out, overwrite=True):
        pytest.fail("it is no comparison")


def test_interrupted_comparison_keeps_every_recording(tmp_path: Path) -> None:
    folder = ComparisonFolder(tmp_path / "compared")

    def one_of_two() -> None:
        with ResultFolder(folder.path / "mfs") as inner:
            record(inner)
            (inner.path / "result.json").touch()
        with ResultFolder(folder.path / "tps") as inner:
            record(inner)
            raise OperatorError("lost the camera", "Plug it in.")

    with pytest.raises(OperatorError) as caught:
        work(folder, one_of_two)
    kept = tmp_path / "compared.incomplete"
    assert (kept / "mfs" / "take" / "frames.bin").exists()
    assert (kept / "tps.incomplete" / "take" / "frames.bin").exists()
    assert ".partial-" not in str(caught.value)
    assert str(kept / "tps.incomplete") in caught.value.remedy
