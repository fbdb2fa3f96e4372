"""The lens model against OpenCV's own functions, epipolar geometry against the fundamental matrix, files and errors."""

import json

import cv2
import numpy as np
import pytest

from scanner import optics
from scanner.rig import Lens, Rig, RigError

MATRIX = np.array([[2010.0, 0, 633.25], [0, 2000.0, 481.5], [0, 0, 1]])
SIZE = (1280, 960)
FULL = [-0.12, 0.08, 0.0012, -0.0021, 0.03, 0.05, -0.02, 0.01, 0.0011, 0.0017, -0.0013, 0.0008, 0.021, -0.034]
DISTORTIONS = {terms: np.array(FULL[:terms]) for terms in (0, 4, 5, 8, 12, 14)}
ROTATION = cv2.Rodrigues(np.array([0.03, -0.31, 0.02]))[0]
TRANSLATION = np.array([152.5, -4.0, 31.0])


@pytest.fixture(params=DISTORTIONS, ids="{} terms".format)
def lens(request) -> Lens:
    return Lens(MATRIX, DISTORTIONS[request.param], SIZE)


@pytest.fixture
def rig() -> Rig:
    projector = Lens(np.array([[1900.0, 0, 640], [0, 1905.0, 790], [0, 0, 1]]), DISTORTIONS[5], (1280, 800))
    return Rig(Lens(MATRIX, DISTORTIONS[8], SIZE), projector, ROTATION, TRANSLATION, {"stereo_error_px": 0.11})


def points_in_view(count: int = 5000) -> np.ndarray:
    return np.random.default_rng(3).uniform([-110, -90, 300], [110, 90, 600], (count, 3))


class TestLens:
    def test_projects_as_opencv(self, lens: Lens) -> None:
        X = points_in_view()
        expected, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
        # Some ten roundings of coordinates below 2000 px.
        np.testing.assert_allclose(lens.project(X), expected[:, 0], rtol=0, atol=1e-11)

    def test_its_derivatives_are_those_of_opencv(self, lens: Lens) -> None:
        x, y = 0.21, -0.17
        _, jacobian = cv2.projectPoints(np.array([[x, y, 1.0]]), np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
        # Columns 3 and 4 of OpenCV's Jacobian are the derivatives after a shift in x and in y, here at z = 1.
        np.testing.assert_allclose(
            np.reshape(optics._image.py_func(lens.vector, x, y)[2:], (2, 2)), jacobian[:, 3:5], rtol=1e-12
        )

    def test_ray_and_pixel_are_inverse(self, lens: Lens) -> None:
        px = np.random.default_rng(5).uniform([-0.5, -0.5], np.array(SIZE) - 0.5, (40, 50, 2))
        rays = lens.rays(px)
        assert rays.shape == (40, 50, 3)
        assert (rays[..., 2] == 1).all()
        np.testing.assert_allclose(lens.project(rays * 431.0), px, rtol=0, atol=1e-7)

    def test_rays_are_the_directions_that_were_projected(self, lens: Lens) -> None:
        X = points_in_view()
        px, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
        np.testing.assert_allclose(lens.rays(px[:, 0]), X / X[:, 2:], rtol=0, atol=1e-7 / 2000)

    def test_rays_are_those_of_the_plain_twin(self, lens: Lens) -> None:
        px = np.random.default_rng(6).uniform([-400, -400], [1700, 1400], (3000, 2))
        plain = optics.directions_plain(lens.vector, px)
        np.testing.assert_allclose(lens.rays(px)[:, :2], plain, rtol=0, atol=1e-7 / 2000)

    def test_the_rays_of_all_pixels(self, lens: Lens) -> None:
        every = lens.pixel_rays()
        assert every.dtype == np.float32
        v, u = np.mgrid[: SIZE[1], : SIZE[0]]
        # One float32 rounding of directions below 0.5.
        np.testing.assert_allclose(every, lens.rays(np.stack((u, v), -1)), rtol=0, atol=4e-8)

    def test_nothing_is_seen_behind_the_lens(self, lens: Lens) -> None:
        assert np.isnan(lens.project([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [np.nan, 0.0, 1.0]])).all()

    def test_where_the_distortion_folds_back_there_is_no_image(self) -> None:
        # r (1 + k1 r²) turns at r² = -1/(3 k1): for k1 = -0.3 at 1.054, where the image radius is 0.703.
        barrel = Lens(np.diag([1000.0, 1000.0, 1.0]), np.array([-0.3, 0, 0, 0]), (2000, 2000))
        turn = np.sqrt(1 / 0.9)
        inside, outside = barrel.project([[turn - 1e-3, 0, 1], [turn + 1e-3, 0, 1]])
        assert inside[0] == pytest.approx(1000 * turn * 2 / 3, abs=0.01)
        assert np.isnan(outside).all()
        assert np.isfinite(barrel.rays([1000 * turn * 2 / 3 - 0.1, 0])).all()
        assert np.isnan(barrel.rays([1000 * turn * 2 / 3 + 0.1, 0])).all()

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"matrix": np.eye(2)}, "matrix has shape"),
            ({"matrix": np.diag([-2000.0, 2000, 1])}, "focal lengths must be positive"),
            ({"matrix": MATRIX.T}, "matrix is not of the form"),
            ({"matrix": np.full((3, 3), np.nan)}, "not finite"),
            ({"matrix": [["a"] * 3] * 3}, "matrix is not an array of numbers"),
            ({"matrix": [[1, 2], [3]]}, "matrix is not an array of numbers"),
            ({"distortion": np.zeros(6)}, "distortion has 6 terms"),
            ({"size": (1280, 0)}, "size .* is not"),
            ({"size": (1280.5, 960)}, "size .* is not"),
            ({"size": 1280}, "size has shape"),
        ],
    )
    def test_refuses(self, changed: dict, message: str) -> None:
        with pytest.raises(RigError, match=message) as caught:
            Lens(**({"matrix": MATRIX, "distortion": DISTORTIONS[5], "size": SIZE} | changed))
        assert caught.value.remedy


class TestGeometry:
    def test_points_lie_on_their_epipolar_lines(self, rig: Rig) -> None:
        X = points_in_view(500)
        px, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), rig.camera.matrix, rig.camera.distortion)
        ideal, _ = cv2.projectPoints(X, cv2.Rodrigues(rig.rotation)[0], rig.translation, rig.projector.matrix, None)
        lines = rig.epipolar_line(px[:, 0])
        np.testing.assert_allclose(np.hypot(lines[:, 0], lines[:, 1]), 1, rtol=1e-14)
        distance = (lines[:, :2] * ideal[:, 0]).sum(1) + lines[:, 2]
        np.testing.assert_allclose(distance, 0, atol=1e-6)
        assert np.abs((lines[:, :2] * (ideal[:, 0] + 5)).sum(1) + lines[:, 2]).min() > 1

    def test_points_lie_on_their_epipolar_curves(self, rig: Rig) -> None:
        X = points_in_view(500)
        px, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), rig.camera.matrix, rig.camera.distortion)
        real, _ = cv2.projectPoints(
            X, cv2.Rodrigues(rig.rotation)[0], rig.translation, rig.projector.matrix, rig.projector.distortion
        )
        np.testing.assert_allclose(rig.epipolar_curve(px[:, 0], X[:, 2]), real[:, 0], rtol=0, atol=1e-6)

    def test_all_epipolar_lines_meet_in_the_epipole(self, rig: Rig) -> None:
        in_camera, in_projector = rig.epipoles()
        lines = rig.epipolar_line(np.random.default_rng(1).uniform(0, 900, (50, 2)))
        reach = np.linalg.norm(in_projector)
        np.testing.assert_allclose(lines[:, :2] @ in_projector + lines[:, 2], 0, atol=1e-12 * reach)
        # The camera's epipole is where the projector's centre, X_proj = 0, is seen.
        centre = np.linalg.solve(rig.rotation, -rig.translation)
        np.testing.assert_allclose(rig.projector_centre_cam, centre, atol=1e-12)
        np.testing.assert_allclose(in_camera, (MATRIX @ centre)[:2] / centre[2], rtol=1e-12)

    def test_an_epipole_at_infinity(self, rig: Rig) -> None:
        sideways = Rig(rig.camera, rig.projector, np.eye(3), np.array([-100.0, 0, 0]))
        assert np.isinf(sideways.epipoles()[1][0])

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"rotation": np.diag([1.0, 1, -1])}, "rotation is not a rotation.*det R = -1"),
            ({"rotation": ROTATION * 1.001}, "rotation is not a rotation"),
            ({"rotation": np.zeros(3)}, "rotation has shape"),
            ({"translation": np.zeros(3)}, "stand at one place"),
            ({"translation": np.ones(2)}, "translation has shape"),
            ({"translation": [1, [2, 3], 4]}, "translation is not an array"),
            ({"metadata": "yesterday"}, "metadata"),
        ],
    )
    def test_refuses(self, rig: Rig, changed: dict, message: str) -> None:
        sound = {"rotation": ROTATION, "translation": TRANSLATION}
        with pytest.raises(RigError, match=message):
            Rig(rig.camera, rig.projector, **(sound | changed))


SLSTUDIO = ("Kc", "kc", "Kp", "kp", "Rp", "Tp")
STEREO = ("K1", "D1", "K2", "D2", "R", "T")
VENDORS = [SLSTUDIO, STEREO, ("M1", "D1", "M2", "D2", "R", "T"), ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T")]


def write_opencv(path, rig: Rig, names=SLSTUDIO, sizes=True, leave_out=(), **more) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    camera, projector = rig.camera, rig.projector
    matrices = (camera.matrix, camera.distortion, projector.matrix, projector.distortion, rig.rotation, rig.translation)
    for name, matrix in zip(names, matrices, strict=True):
        if name not in leave_out:
            storage.write(name, np.array(matrix))
    if sizes:
        for name, value in zip(
            ("frameWidth", "frameHeight", "screenResX", "screenResY"), camera.size + projector.size, strict=True
        ):
            storage.write(name, value)
    for name, value in more.items():
        storage.write(name, value)
    storage.release()


def same(one: Rig, other: Rig) -> bool:
    mine, others = one.to_json(), other.to_json()
    del mine["metadata"], others["metadata"]
    return mine == others


class TestFiles:
    def test_own_json_comes_back_to_the_bit(self, rig: Rig, tmp_path) -> None:
        rig.save(tmp_path / "rig.json")
        again = Rig.load(tmp_path / "rig.json")
        assert same(again, rig)
        assert again.metadata == {"stereo_error_px": 0.11}

    @pytest.mark.parametrize("suffix", [".xml", ".yml", ".yaml", ".json", ".yml.gz", ".xml.gz"])
    def test_reads_every_kind_of_file_storage(self, rig: Rig, tmp_path, suffix: str) -> None:
        path = tmp_path / f"stereo{suffix}"
        write_opencv(path, rig, stereo_error=0.42, made="today")
        again = Rig.load(path)
        assert same(again, rig)
        assert again.metadata == {"source": path.name, "stereo_error": 0.42, "made": "today"}

    @pytest.mark.parametrize("names", VENDORS, ids=lambda names: names[0])
    def test_knows_the_names_others_use(self, rig: Rig, tmp_path, names) -> None:
        write_opencv(tmp_path / "rig.yml", rig, names, sizes=False)
        again = Rig.load(tmp_path / "rig.yml", camera_size=rig.camera.size, projector_size=rig.projector.size)
        assert same(again, rig)

    def test_sizes_that_no_one_states(self, rig: Rig, tmp_path) -> None:
        write_opencv(tmp_path / "rig.yml", rig, STEREO, sizes=False)
        with pytest.raises(RigError, match=r"rig\.yml.*does not say the size of the projector") as caught:
            Rig.load(tmp_path / "rig.yml", camera_size=SIZE)
        assert "screenResX" in caught.value.remedy

    @pytest.mark.parametrize("name", ["rig.json", "rig.yml"])
    def test_sizes_that_contradict_the_file(self, rig: Rig, tmp_path, name: str) -> None:
        rig.save(tmp_path / "rig.json")
        write_opencv(tmp_path / "rig.yml", rig)
        with pytest.raises(RigError, match=r"camera is \[1280, 960\] px, but \[640, 480\] px"):
            Rig.load(tmp_path / name, camera_size=(640, 480))

    def test_two_names_for_one_thing_are_ambiguous(self, rig: Rig, tmp_path) -> None:
        write_opencv(tmp_path / "rig.yml", rig, M1=np.eye(3))
        with pytest.raises(RigError, match=r"more than one camera matrix.*found Kc, M1"):
            Rig.load(tmp_path / "rig.yml")

    def test_a_part_that_is_missing(self, rig: Rig, tmp_path) -> None:
        write_opencv(tmp_path / "rig.yml", rig, leave_out=("kp",))
        with pytest.raises(RigError, match="no projector distortion: looked for kp"):
            Rig.load(tmp_path / "rig.yml")

    @pytest.mark.parametrize("name", ["rig.xml", "rig.yml", "rig.json", "rig.yml.gz", "rig.txt"])
    @pytest.mark.parametrize("content", [b"", b"hello", b"\x00\xff\x01", b"<html></html>", b'{"a": ', b"[1, 2]"])
    def test_files_that_are_no_rig(self, tmp_path, name: str, content: bytes) -> None:
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(RigError) as caught:
            Rig.load(path)
        assert str(path) in caught.value.message
        assert caught.value.remedy

    def test_a_file_storage_cut_short(self, rig: Rig, tmp_path) -> None:
        whole, cut = tmp_path / "whole.xml", tmp_path / "cut.xml"
        write_opencv(whole, rig)
        content = whole.read_bytes()
        for length in range(0, len(content) - len(b"</opencv_storage>\n"), 97):
            cut.write_bytes(content[:length])
            with pytest.raises(RigError):
                Rig.load(cut)

    def test_a_file_that_is_not_there(self, tmp_path) -> None:
        for path in (tmp_path / "rig.json", tmp_path):
            with pytest.raises(RigError, match="does not exist"):
                Rig.load(path)

    @pytest.mark.parametrize(
        ("place", "value", "message"),
        [
            (("camera", "matrix", 0, 0), -5.0, "camera: focal lengths"),
            (("projector", "distortion"), [0.1], "projector: distortion has 1 terms"),
            (("projector",), {"matrix": 1}, "projector: missing distortion, size"),
            (("projector",), [], "projector: not a JSON object"),
            (("camera", "distorsion"), [], "camera: unknown distorsion"),
            (("rotation", 0, 0), 7, "not a rotation"),
            (("version",), 2, "version 2 is not"),
            (("format",), "else", "'else' version 1 is not"),
            (("baseline",), 2, "unknown baseline"),
            (("metadata",), "text", "metadata"),
        ],
    )
    def test_json_that_is_wrong_somewhere(self, rig: Rig, tmp_path, place, value, message: str) -> None:
        document = rig.to_json()
        inner = document
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = value
        path = tmp_path / "rig.json"
        path.write_text(json.dumps(document))
        with pytest.raises(RigError, match=message) as caught:
            Rig.load(path)
        assert str(path) in caught.value.message

    def test_a_place_that_cannot_be_written(self, rig: Rig, tmp_path) -> None:
        with pytest.raises(RigError, match="cannot write rig"):
            rig.save(tmp_path / "no such folder" / "rig.json")
