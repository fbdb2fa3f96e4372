"""Parts from mesh files: read right, placed right, and refused with a reason."""

import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.errors import OperatorError
from scanner.config import ConfigError, load_config
from sim_backend.bench import truth_of
from sim_backend.bracket import bracket, write
from sim_backend.cache import transport_of
from sim_backend.mesh_files import MeshFileError, read_mesh
from sim_backend.scenes import PartScene, scene_of
from sim_backend.settings import SimulatedSettings
from sim_backend.solids import box, prism
from sim_backend.twins import twins_of

CONFIGS = Path(__file__).parents[2] / "configs"

TINY = {
    "camera": {"width_px": 96, "height_px": 72},
    "projector": {"width_px": 320, "height_px": 200},
    "transport": {"photons": 10_000, "supersample": 1},
}


def _written(path, vertices, triangles):
    """A mesh file, by hand."""
    if path.suffix == ".stl":
        corners = np.asarray(vertices)[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        record = np.zeros(len(corners), np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("attribute", "<u2")]))
        record["n"], record["v"] = normals, corners
        path.write_bytes(b"binary STL".ljust(80) + np.uint32(len(corners)).tobytes() + record.tobytes())
    elif path.suffix == ".ply":
        head = f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        head += f"element face {len(triangles)}\nproperty list uchar int vertex_indices\n" if len(triangles) else ""
        lines = [" ".join(map(str, v)) for v in vertices] + [f"3 {a} {b} {c}" for a, b, c in triangles]
        path.write_text(f"ply\nformat ascii 1.0\n{head}end_header\n" + "\n".join(lines) + "\n", encoding="ascii")
    else:
        lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]
        path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".STL"])
def test_all_formats_give_the_same_closed_mesh(tmp_path, suffix):
    vertices, triangles = box(30, 20, 10)
    path = _written(tmp_path / f"box{suffix.lower()}", vertices, triangles).rename(tmp_path / f"box{suffix}")
    found, faces = read_mesh(path, closed=True)
    assert (len(found), len(faces)) == (8, 12)
    a, b, c = np.moveaxis(found[faces], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(6000)
    np.testing.assert_allclose(np.ptp(found, axis=0), (30, 20, 10))


def test_triangles_that_face_both_ways_are_turned_to_one_side(tmp_path):
    vertices, triangles = box(30, 20, 10)
    mixed = triangles.copy()
    mixed[::3] = mixed[::3, ::-1]
    found, faces = read_mesh(_written(tmp_path / "mixed.obj", vertices, mixed), closed=True)
    a, b, c = np.moveaxis(found[faces], 1, 0)
    assert abs(np.einsum("ij,ij->", a, np.cross(b, c)) / 6) == pytest.approx(6000)


def _broken(folder, kind):
    vertices, triangles = box(30, 20, 10)
    path = folder / "part.ply"
    if kind == "missing":
        return path
    if kind == "unknown":
        (folder / "part.step").write_text("ISO-10303-21;")
        return folder / "part.step"
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("not a mesh at all\n")
    elif kind == "cut":
        _written(folder / "part.stl", vertices, triangles)
        path = folder / "part.stl"
        path.write_bytes(path.read_bytes()[:200])
    elif kind == "points":
        _written(path, vertices, triangles[:0])
    elif kind == "no numbers":
        _written(path, np.where(vertices == 15, np.nan, vertices), triangles)
    elif kind == "flat":
        _written(path, vertices * 0, triangles)
    elif kind == "open":
        _written(path, vertices, triangles[2:])
    return path


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("missing", "no such file"),
        ("unknown", ".step is no mesh"),
        ("empty", "is empty"),
        ("text", "no triangles, or is broken"),
        ("cut", "no triangles, or is broken"),
        ("points", "8 points and no triangles"),
        ("no numbers", "broken"),
        ("flat", "all its triangles are empty"),
        ("open", "not closed: 6 of 18 edges"),
    ],
)
def test_files_that_are_no_part_are_refused_with_a_reason(tmp_path, kind, said, capfd):
    path = _broken(tmp_path, kind)
    with pytest.raises(MeshFileError, match=said) as raised:
        read_mesh(path, closed=True)
    assert isinstance(raised.value, OperatorError)
    assert raised.value.exit_code == 2
    assert str(path) in raised.value.message
    assert raised.value.remedy
    assert "Open3D" not in capfd.readouterr().err


def test_a_sheet_may_be_open(tmp_path):
    vertices, triangles = read_mesh(_broken(tmp_path, "open"), closed=False)
    assert (len(vertices), len(triangles)) == (8, 10)


def _scene(folder, **changes):
    path = _written(folder / "block.stl", *box(60, 40, 20))
    return {"name": "part", "pieces": [{"file": str(path)}], "distance_mm": 500, **changes}


@pytest.mark.parametrize(
    ("changes", "size"),
    [
        ({}, (60, 20, 40)),  # files have z up: it becomes the height
        ({"up": "-x"}, (40, 60, 20)),
        ({"up": "y", "turn_deg": 90.0}, (60, 40, 20)),
        ({"scale": 2.0, "yaw_deg": 0.0}, (120, 40, 80)),
    ],
)
def test_a_part_stands_upright_with_its_middle_at_the_pose(tmp_path, changes, size):
    (part,) = scene_of(_scene(tmp_path, offset_x_mm=7.0, **changes)).surfaces()
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), size, atol=1e-6)
    np.testing.assert_allclose((part.vertices.max(0) + part.vertices.min(0)) / 2, (7, 0, 500), atol=1e-6)
    a, b, c = np.moveaxis((part.vertices - (7, 0, 500))[part.triangles], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0  # not mirrored


def test_up_is_up(tmp_path):
    vertices, triangles = box(20, 20, 20)
    vertices[vertices[:, 2] > 0, :2] *= 0.2  # a pyramid's stump, narrow at z = 10
    path = _written(tmp_path / "stump.obj", vertices, triangles)
    (part,) = scene_of({"name": "part", "pieces": [{"file": path}]}).surfaces()
    top = part.vertices[part.vertices[:, 1] < -9]  # y points down
    assert np.ptp(top[:, 0]) == pytest.approx(4)


def test_parts_of_another_unit_or_behind_the_camera_are_refused(tmp_path):
    with pytest.raises(MeshFileError, match="mm large") as raised:
        scene_of(_scene(tmp_path, scale=1000.0)).surfaces()
    assert "scale" in raised.value.remedy
    with pytest.raises(MeshFileError, match="behind the camera"):
        scene_of(_scene(tmp_path, distance_mm=5.0)).surfaces()


def test_pieces_have_names_of_their_own(tmp_path):
    document = _scene(tmp_path)
    with pytest.raises(ValidationError, match="called the same"):
        PartScene(pieces=document["pieces"] * 2)
    two = PartScene(pieces=[document["pieces"][0], {**document["pieces"][0], "name": "lid"}], blackened=("lid",))
    assert two.part_names == ("block", "lid")
    assert [s.material.diffuse for s in two.surfaces()] == [0.35, 0.0]


def test_a_bench_file_names_meshes_relative_to_itself(tmp_path):
    _written(tmp_path / "block.stl", *box(60, 40, 20))
    text = "bench:\n  kind: simulated\n  scene:\n    name: part\n    pieces:\n"
    text += "      - file: {}\n        finish: {{reflectance: 0.3, gloss: 0.5}}\n"
    file = tmp_path / "bench.yaml"
    file.write_text(text.format("block.stl"))
    settings = load_config(file).bench_settings
    assert settings.scene.files() == (tmp_path / "block.stl",)
    assert settings.scene.pieces[0].finish.gloss == 0.5
    for wrong, said in (("blok.stl", "no file"), ("block.step", "must end in")):
        file.write_text(text.format(wrong))
        with pytest.raises(ConfigError, match=said) as raised:
            load_config(file)
        assert "line 6" in str(raised.value) or ":6:" in str(raised.value)


def test_another_file_of_the_same_name_is_traced_anew(tmp_path):
    settings = SimulatedSettings.model_validate({"scene": _scene(tmp_path), **TINY, "cache_dir": tmp_path / "cache"})
    first = transport_of(settings)
    assert len(list((tmp_path / "cache").iterdir())) == 1
    _written(tmp_path / "block.stl", *box(40, 40, 20))
    second = transport_of(settings)
    assert (second.view.surface >= 0).sum() < 0.8 * (first.view.surface >= 0).sum()
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_part_that_lights_itself_has_a_twin_that_does_not(tmp_path):
    """An angle of two plates, as one mesh: each face is lit by the other."""
    (a, s), (b, t) = box(80, 6, 60), box(80, 60, 6)
    path = _written(
        tmp_path / "angle.obj", np.concatenate((a, b + np.array([0, -33, -30]))), np.concatenate((s, t + 8))
    )
    scene = {
        "name": "part",
        "pieces": [{"file": str(path), "finish": {"reflectance": 0.4, "gloss": 0.4, "roughness": 0.05}}],
        "pitch_deg": 40.0,
        "distance_mm": 400.0,
    }
    bench = {**TINY, "transport": {"photons": 60_000, "supersample": 2}, "cache_dir": tmp_path / "cache"}
    settings = SimulatedSettings.model_validate({"scene": scene, **bench})
    truth = truth_of(settings)
    (twin,) = twins_of(settings)
    dark = truth_of(twin.settings)
    seen = twin.pixels(truth) & np.isfinite(truth.x_p) & ~truth.edge
    assert seen.sum() > 500
    assert (truth.alpha[seen] > 0.05).mean() > 0.2
    assert dark.alpha[seen].max() == 0
    np.testing.assert_array_equal(truth.x_p[seen], dark.x_p[seen])


def test_a_prism_has_the_volume_of_its_profile_and_faces_outwards():
    vertices, triangles = prism([(0, 0), (4, 0), (4, 3), (1, 3), (0, 1)], -2, 5)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    # The shoelace formula by hand: a rectangle 4 × 3 without the triangle (0, 1), (1, 3), (0, 3).
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(7 * (12 - 1))


def test_the_bracket_is_what_its_file_holds(tmp_path):
    write(tmp_path / "again.stl")
    assert (tmp_path / "again.stl").read_bytes() == (CONFIGS / "scenes" / "meshes" / "bracket.stl").read_bytes()
    vertices, triangles = bracket()
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    # A regular polygon of n sides and radius r has the area n r²/2 sin(2π/n).
    boss = 48 * math.sin(2 * math.pi / 96) * (17**2 * 30 - 9**2 * 26)
    gussets = 2 * 8 * (40.2 * 37.2 - 34 * 32 / 2)
    # A square less the quarter disc of 24 sides, and two slivers that reach 0.2 mm into plate and wall.
    fillet = 110 * (8 * 8 - 24 * 32 * math.sin(math.pi / 48) + 2 * 8 * 0.2 / 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(110 * (70 * 9 + 9 * 62) + boss + gussets + fillet)
