"""Normals against a sphere's own, files against Open3D's readers, and what happens when writing fails."""

import ctypes
import resource
from pathlib import Path

import libusb_package
import numpy as np
import pytest

from scanner.cloud import Cloud, CloudError, grid_normals

ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
import open3d as o3d  # noqa: E402

SHAPE = (300, 400)
FOCAL_PX = 1000.0


def rays() -> np.ndarray:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.stack(((u - 200) / FOCAL_PX, (v - 150) / FOCAL_PX, np.ones(SHAPE)), -1)


def sphere(radius: float, centre=(0.0, 0.0, 500.0)) -> tuple[np.ndarray, np.ndarray]:
    """Points that the camera sees and their outward normals, float64."""
    d, c = rays(), np.array(centre)
    a, b = (d * d).sum(-1), d @ c
    with np.errstate(invalid="ignore"):
        points = d * ((b - np.sqrt(b * b - a * (c @ c - radius**2))) / a)[..., None]
    return points, (points - c) / radius


def angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.linalg.norm(one - other, axis=-1) / 2)


def noisy(points: np.ndarray, sigma: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    along = points / np.linalg.norm(points, axis=-1, keepdims=True)
    error = sigma * np.random.default_rng(seed).normal(size=SHAPE)
    return (points + along * error[..., None]).astype(np.float32), np.full(SHAPE, sigma, np.float32)


class TestNormals:
    def test_on_a_sphere(self) -> None:
        points, truth = sphere(50)
        found = grid_normals(points.astype(np.float32), np.full(SHAPE, 1e-4, np.float32))
        assert found.dtype == np.float32
        facing = (truth * points).sum(-1) / np.linalg.norm(points, axis=-1) < -0.5  # within 60° of the viewing ray
        facing &= np.roll(facing, (1, 1), (0, 1)) & np.roll(facing, (-1, -1), (0, 1))
        np.testing.assert_allclose(np.linalg.norm(found[facing], axis=-1), 1, atol=1e-6)
        # Central differences over h ≤ 2 · 0.5 mm · 2 on a sphere of 50 mm err by about (h/r)²/6, float32 by 6e-5.
        assert angle(found, truth)[facing].max() < 1.5e-3

    def test_look_to_the_camera(self) -> None:
        points, _ = sphere(50)
        found = grid_normals(points.astype(np.float32), np.full(SHAPE, 1e-4, np.float32))
        known = np.isfinite(found).all(-1)
        assert known.sum() > 0.9 * np.isfinite(points[..., 2]).sum()
        assert ((found * points).sum(-1)[known] < 0).all()

    @pytest.mark.parametrize("sigma", [0.01, 0.05, 0.1])
    def test_noise_widens_their_base(self, sigma: float) -> None:
        # A wall that fills the picture; pitch 0.5 mm. The noise of one slope is σ √2 / (2 · reach · pitch).
        points, sigmas = noisy(rays() * 500, sigma, 7)
        found = grid_normals(points, sigmas)[20:-20, 20:-20]
        tilt_x = np.arctan2(found[..., 0], -found[..., 2])
        reach = np.ceil(sigma / 0.5 / (np.sqrt(2) * 0.03))
        predicted = sigma * np.sqrt(2) / (2 * reach * 0.5)
        assert predicted <= 0.03
        # Some n/(2·reach)² independent normals; four standard errors and the few per mille of second order.
        independent = tilt_x.size / (2 * reach) ** 2
        assert tilt_x.std() == pytest.approx(predicted, rel=4 / np.sqrt(2 * independent) + 0.005)

    def test_do_not_reach_across_a_step(self) -> None:
        # Two walls, 20 mm apart; the noise makes the base 5 px wide.
        depth = np.where(np.arange(SHAPE[1]) < 200, 500.0, 520.0)
        points, sigmas = noisy(rays() * depth[None, :, None], 0.1, 8)
        found = grid_normals(points, sigmas)
        tilt = np.arccos(-found[..., 2])
        beside = tilt[20:-20, 190:210]
        # One-sided differences have twice the noise, σ √2 / (reach · pitch) = 0.057 rad; a bridge tilts by 1.3 rad.
        assert np.isfinite(beside).all()
        assert beside.max() < 0.057 * 6

    def test_a_lone_point_has_none(self) -> None:
        points = np.full((*SHAPE, 3), np.nan, np.float32)
        points[100, 100] = (0, 0, 500)
        points[200, 200:203] = [(0, 0, 500), (0.5, 0, 500), (1, 0, 500)]
        assert np.isnan(grid_normals(points, np.full(SHAPE, 0.01, np.float32))).all()

    def test_a_corner_of_three_pixels_has_one(self) -> None:
        points = np.full((*SHAPE, 3), np.nan, np.float32)
        for row, column in ((100, 100), (100, 101), (101, 100)):
            points[row, column] = (0.5 * column, 0.5 * row, 500)
        found = grid_normals(points, np.full(SHAPE, 0.01, np.float32))
        np.testing.assert_allclose(found[100, 100], (0, 0, -1), atol=1e-4)
        assert np.isfinite(found).all(-1).sum() == 1


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    points, _ = sphere(50)
    sigma = np.linspace(0.001, 0.2, points[..., 0].size, dtype=np.float32).reshape(SHAPE)
    brightness = np.linspace(0, 200, sigma.size, dtype=np.float32).reshape(SHAPE)
    return Cloud.from_grid(points.astype(np.float32), sigma, brightness, simulated=True)


class TestCloud:
    def test_holds_the_valid_pixels_in_order(self, cloud: Cloud) -> None:
        points, _ = sphere(50)
        valid = np.isfinite(points[..., 0])
        np.testing.assert_array_equal(cloud.points, points[valid].astype(np.float32))
        np.testing.assert_array_equal(
            cloud.sigma, np.linspace(0.001, 0.2, valid.size, dtype=np.float32).reshape(SHAPE)[valid]
        )
        assert cloud.grey.dtype == np.uint8
        assert (np.diff(cloud.grey.astype(int)) >= 0).all()
        assert (cloud.grey == 255).mean() == pytest.approx(0.01, abs=0.005)

    def test_brightness_keeps_its_proportions(self) -> None:
        brightness = np.full(SHAPE, 1000, np.float32)
        brightness[:150] = 250
        cloud = Cloud.from_grid(
            (rays() * 500).astype(np.float32), np.ones(SHAPE, np.float32), brightness, simulated=False
        )
        assert sorted(set(cloud.grey.tolist())) == [64, 255]

    @pytest.mark.parametrize("suffix", [".ply", ".pcd"])
    def test_comes_back_through_open3d(self, cloud: Cloud, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"cloud{suffix}"
        cloud.save(path)
        again = o3d.t.io.read_point_cloud(str(path)).point
        np.testing.assert_array_equal(again.positions.numpy(), cloud.points)
        np.testing.assert_array_equal(again.normals.numpy(), cloud.normals)
        np.testing.assert_array_equal(again.sigma.numpy()[:, 0], cloud.sigma)
        np.testing.assert_array_equal(again.colors.numpy(), np.repeat(cloud.grey[:, None], 3, 1))
        assert [p.name for p in tmp_path.iterdir()] == [path.name]

    def test_ply_header(self, cloud: Cloud, tmp_path: Path) -> None:
        cloud.save(tmp_path / "cloud.ply")
        header, _, data = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
        lines = header.decode("ascii").splitlines()
        assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
        comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
        assert comments[0] == "SIMULATED DATA"
        assert "unit: mm" in comments
        assert any(c.startswith("frame: camera (x right, y down, z forward") for c in comments)
        floats, bytes_ = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
        kinds = dict.fromkeys(floats, "f") | dict.fromkeys(bytes_, "u1") | {"sigma": "f"}
        words = {"f": "float", "u1": "uchar"}
        assert [line for line in lines if line.startswith("property")] == [
            f"property {words[kind]} {name}" for name, kind in kinds.items()
        ]
        # The data, read by nobody's library.
        records = np.frombuffer(data, [(name, "<f4" if kind == "f" else kind) for name, kind in kinds.items()])
        assert f"element vertex {len(records)}" in lines
        np.testing.assert_array_equal(records["z"], cloud.points[:, 2])
        np.testing.assert_array_equal(records["sigma"], cloud.sigma)

    def test_real_data_carry_no_stamp(self, cloud: Cloud, tmp_path: Path) -> None:
        real = Cloud(cloud.points, cloud.normals, cloud.sigma, cloud.grey, simulated=False)
        for suffix in (".ply", ".pcd"):
            for made, stamped in ((real, False), (cloud, True)):
                path = tmp_path / f"cloud{suffix}"
                made.save(path)
                assert (b"SIMULATED" in path.read_bytes()[:1000]) == stamped

    def test_another_kind_of_file_is_refused(self, cloud: Cloud, tmp_path: Path) -> None:
        with pytest.raises(CloudError, match="unknown kind") as caught:
            cloud.save(tmp_path / "cloud.stl")
        assert ".ply" in caught.value.remedy

    def test_a_cloud_without_points_is_refused(self, tmp_path: Path) -> None:
        nothing = np.full((*SHAPE, 3), np.nan, np.float32)
        cloud = Cloud.from_grid(nothing, nothing[..., 0], np.ones(SHAPE, np.float32), simulated=True)
        with pytest.raises(CloudError, match="no points"):
            cloud.save(tmp_path / "cloud.ply")

    def test_a_place_that_is_not_there(self, cloud: Cloud, tmp_path: Path) -> None:
        with pytest.raises(CloudError, match=r"cannot write.*No such file"):
            cloud.save(tmp_path / "nowhere" / "cloud.ply")

    @pytest.mark.parametrize("suffix", [".ply", ".pcd"])
    @pytest.mark.parametrize("room", [3_000, 100_000])
    def test_a_full_disk_leaves_the_old_file(self, cloud: Cloud, tmp_path: Path, suffix: str, room: int) -> None:
        path = tmp_path / f"cloud{suffix}"
        path.write_bytes(b"old")
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
        try:
            with pytest.raises(CloudError, match="cannot write"):
                cloud.save(path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert path.read_bytes() == b"old"
        assert len(list(tmp_path.iterdir())) == 1
