"""Every scene is what it says: its bounce by the image method, its twin without any, its windows on its faces."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from scanner.config import load_config
from scanner.rig import Rig
from sim_backend.bench import truth_of
from sim_backend.meshes import MeshSurface
from sim_backend.projector_paths import Photons, follow
from sim_backend.raycasting import RayCaster
from sim_backend.scenes import Scene, scene_of
from sim_backend.settings import SimulatedSettings
from sim_backend.solids import box
from sim_backend.surfaces import BLACK, Material, Rectangle, Sphere
from sim_backend.transport import trace
from sim_backend.twins import twins_of, without_bounces

CONFIGS = Path(__file__).parents[2] / "configs"
NAMES = (
    *("v_board_sphere", "objects", "mirror_epipolar", "mirror_textured", "mirror_edge", "mirror_translucent"),
    *("polished", "mirror_chain", "fins", "mirror", "sphere_mirror", "v_groove"),
)
TINY = {
    "camera": {"width_px": 128, "height_px": 96},
    "projector": {"width_px": 320, "height_px": 200},
    "transport": {"photons": 30_000, "supersample": 2},
}
WHITE = np.ones((400, 640), np.float32)


def _projected(rig: Rig, points):
    """Projector px (n, 2) of points in the camera frame, without distortion."""
    x, y, z = (points @ rig.rotation.T + rig.translation).T
    k = rig.projector.matrix
    return np.stack((k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]), -1)


def _reflected(points, plane):
    """Mirror images (n, 3) of points in a rectangle's plane."""
    return points - 2 * ((points - plane.centre) @ plane.normal)[..., None] * plane.normal


def _irradiance(rig, points, normal):
    """What a projector whose pixels send out 1 each gives: fx fy / cos³ φ · cos θ / r²."""
    in_projector = points @ rig.rotation.T + rig.translation
    r = np.linalg.norm(in_projector, axis=-1)
    k = rig.projector.matrix
    to_light = (rig.projector_centre_cam - points) / r[..., None]
    return k[0, 0] * k[1, 1] / (in_projector[..., 2] / r) ** 3 * np.abs((to_light * normal).sum(-1)) / r**2


def _part(settings, truth, name):
    """Pixels that see a part directly lit, away from edges."""
    first = 0
    for other, surfaces in settings.scene.parts().items():
        if other == name:
            seen = np.isin(truth.object_id, range(first, first + len(surfaces)))
            return seen & np.isfinite(truth.x_p) & ~truth.edge
        first += len(surfaces)
    raise KeyError(name)


def test_every_scene_names_its_parts_and_has_a_place_in_the_tests():
    union = TypeAdapter(Scene).json_schema()["discriminator"]["mapping"]
    plain = {"plane", "sphere", "steps", "mirror_removed", "ball_bar", "board", "part"}  # have tests of their own
    assert set(union) == set(NAMES) | plain
    for name in set(union) - {"part"}:
        scene = scene_of({"name": name})
        parts = scene.parts()
        assert tuple(parts) == scene.part_names
        assert set(scene.MEASURED or ()) <= set(scene.part_names)
        assert all(surface.blackened().material == BLACK for some in parts.values() for surface in some)


def test_only_what_there_is_can_be_blackened():
    assert scene_of({"name": "mirror", "blackened": ["mirror"]}).surfaces()[1].material == BLACK
    with pytest.raises(ValidationError, match="miror: this scene's parts are board, mirror"):
        scene_of({"name": "mirror", "blackened": ["miror"]})
    with pytest.raises(ValidationError, match="parts are ball"):
        scene_of({"name": "sphere_mirror", "with_mirror": False, "blackened": ["mirror"]})


def test_the_demos_comment_names_every_scene():
    text = (CONFIGS / "demo.yaml").read_text(encoding="utf-8")
    listed = text[text.index("name: mirror") : text.index("blackened:")]
    for name in TypeAdapter(Scene).json_schema()["discriminator"]["mapping"]:
        assert re.search(rf"\b{name}\b", listed), name


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("[ps][ac]*/*.yaml")), ids=lambda f: f.stem)
def test_bench_files_of_the_scenes_are_sound(file):
    settings = load_config(file).bench_settings
    assert settings.scene.surfaces()
    assert settings.projector.lens().size == (1280, 800)
    # The lines that are commented out are right as well.
    text = file.read_text(encoding="utf-8")
    if "#- width_px" in text:
        changes = dict(re.findall(r"#- (\w+): (\d+)", text))
        places = {"width_px": "camera", "height_px": "camera"}
        load_config(file, {f"bench.{places.get(name, 'transport')}.{name}": int(n) for name, n in changes.items()})
        assert changes == {"width_px": "4008", "height_px": "2688", "specular_bounces": "0", "diffuse_bounces": "0"}


@pytest.mark.parametrize("name", NAMES)
def test_twins_are_the_scene_without_its_bounces(small, name):
    settings = small(scene={"name": name}, **TINY)
    truth, single = truth_of(settings), truth_of(without_bounces(settings))
    twins = twins_of(settings)
    assert {twin.part for twin in twins} == set(settings.scene.MEASURED or settings.scene.part_names)
    bounced = np.zeros(truth.alpha.shape, bool)
    for twin in twins:
        dark = truth_of(twin.settings)
        measured = twin.pixels(truth)
        np.testing.assert_array_equal(measured, twin.pixels(dark))
        # The same pixels are lit by the same places.
        for seen in ("x_p", "y_p", "depth"):
            np.testing.assert_array_equal(getattr(truth, seen)[measured], getattr(dark, seen)[measured])
        clear = measured & np.isfinite(truth.x_p) & ~truth.edge
        bounced |= clear & (truth.alpha > 0.02)
        # Pixels beside a black surface aside, the twin is the picture without bounces.
        assert dark.alpha[clear].max(initial=0) == 0
        pictures = [t.optics.grey([(1.0, np.full((200, 320), 255, np.uint8))]) for t in (dark, single)]
        np.testing.assert_allclose(pictures[0][clear], pictures[1][clear], atol=1e-3 * 255)
    # And without the twin there is something to compare.
    assert bounced.sum() > 25


def test_bounce_in_the_epipolar_plane(truth):
    """A mirror at right angles to the baseline keeps the bounce on the epipolar line; the plain one does not."""
    for name, along, beside in (("mirror_epipolar", 20, 0.05), ("mirror", 20, None)):
        found = truth(scene={"name": name})
        region = np.isfinite(found.bounce_x) & np.isfinite(found.x_p) & (found.alpha > 0.1) & ~found.edge
        assert region.sum() > 1000
        # Epipolar line of a pixel: through the projections of two points of its ray.
        ray = found.rig.camera.pixel_rays()[region]
        a, b = _projected(found.rig, 500 * ray), _projected(found.rig, 700 * ray)
        direction = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        offset = np.stack((found.bounce_x, found.bounce_y), -1)[region] - a
        distance = offset[:, 0] * direction[:, 1] - offset[:, 1] * direction[:, 0]
        own = np.stack((found.x_p, found.y_p), -1)[region] - a
        assert np.median(np.abs(offset - own)[:, 0]) > along
        if beside is None:
            assert np.median(np.abs(distance)) > 3
        else:
            # The mean over photons 1/3 px apart; no bias.
            assert abs(distance.mean()) < 0.02
            assert np.abs(distance).mean() < beside


def test_chain_of_two_mirrors_is_light_of_the_projector_mirrored_twice(small):
    settings = small(scene={"name": "mirror_chain"})
    found = truth_of(settings)
    board, first, second = settings.scene.surfaces()
    region = _part(settings, found, "board") & (found.alpha > 0.1)
    assert region.mean() > 0.1
    points = found.points[region]
    images = _reflected(_reflected(points, second), first)
    px = _projected(found.rig, images)
    error = np.stack((found.bounce_x, found.bounce_y), -1)[region] - px
    inner = np.abs(error).max(1) < 3  # the region's border mixes
    assert inner.mean() > 0.93
    assert np.abs(error[inner].mean(0)).max() < 0.05
    normal = _reflected(_reflected(points + board.normal, second), first) - images
    expected = 0.85**2 * _irradiance(found.rig, images, normal) / _irradiance(found.rig, points, board.normal)
    transport = found.optics.transport
    white = transport.bounced_light(WHITE, diffuse=False)[region] / transport.direct_light(WHITE)[region]
    assert np.median(white[inner] / expected[inner]) == pytest.approx(1, abs=0.02)


def test_polished_part_shows_more_of_the_board_than_of_itself(small):
    """The camera sees in the part the board's radiance times the gloss, beside the part's own."""
    settings = small(scene={"name": "polished", "mirror_roughness": 0.0})
    found = truth_of(settings)
    board, part = settings.scene.surfaces()
    at = _part(settings, found, "part")
    assert at.sum() > 500
    assert 1 < np.median(found.alpha[at]) < 1.5
    points = found.points[at]
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    turned = ray - 2 * (ray @ part.normal)[:, None] * part.normal
    seen = points + turned * (((board.centre - points) @ board.normal) / (turned @ board.normal))[:, None]
    on_board = (np.abs((seen - board.centre) @ board.half_width) < board.half_width @ board.half_width).all()
    assert on_board
    shown = found.optics.transport.by_mirror
    white = (shown @ WHITE.ravel()).reshape(found.x_p.shape)[at]
    column = (shown @ (WHITE * np.arange(640, dtype=np.float32)).ravel()).reshape(found.x_p.shape)[at] / white
    np.testing.assert_allclose(_projected(found.rig, seen)[:, 0], column, atol=0.05)
    # The truth's bounce is the mean with what the board gets from the part, and shows it again.
    assert np.abs(found.bounce_x[at] - column).max() < 20
    expected = (
        0.3 * 0.8 * _irradiance(found.rig, seen, board.normal) / (0.3 * _irradiance(found.rig, points, part.normal))
    )
    np.testing.assert_allclose(white / found.optics.transport.direct_light(WHITE)[at], expected, rtol=0.02)


def test_print_darkens_direct_and_bounced_light_alike(small):
    """A dark check has α as a white one, and both lights in the ratio of the reflectances."""
    scene = {"name": "mirror_textured", "check_mm": 20.0}
    plain, printed = (truth_of(small(scene=s)) for s in ({"name": "mirror"}, scene))
    settings = small(scene=scene)
    region = _part(settings, printed, "board") & (plain.alpha > 0.1)
    factor = [
        light(printed.optics.transport)[region] / light(plain.optics.transport)[region]
        for light in (lambda t: t.direct_light(WHITE), lambda t: t.bounced_light(WHITE, diffuse=False))
    ]
    # Checks 7 px wide: most pixels see one of the two only.
    for ratio in factor:
        np.testing.assert_allclose(np.percentile(ratio, [10, 90]), [0.1, 1.0], atol=0.02)
    inside = (np.abs(factor[0] - 0.1) < 0.01) | (np.abs(factor[0] - 1) < 0.01)
    np.testing.assert_allclose(factor[1][inside], factor[0][inside], rtol=0.02)
    assert np.median(printed.direct_amplitude[region]) < 70


def test_a_dark_print_throws_less_light():
    """Photons that leave white and dark checks carry the reflectance of the very place."""
    scene = scene_of({"name": "mirror_textured", "offset_x_mm": 0.0, "check_mm": 20.0})
    board, _ = scene.surfaces()
    count = 2000
    rng = np.random.default_rng(4)
    # The check at the left top is dark, the next one white.
    for column, reflectance in ((0, 0.08), (1, 0.8)):
        x, y = rng.uniform(1, 19, (2, count))
        place = np.stack((x - 130 + 20 * column, y - 125, np.full(count, 600.0)), 1)
        photons = Photons(
            u=np.zeros(count),
            v=np.zeros(count),
            flux=np.full(count, 1 / count),
            point=place,
            normal=np.tile([0, 0, -1.0], (count, 1)),
            direction=np.tile([0, 0, 1.0], (count, 1)),
            surface=np.zeros(count, np.int16),
            lobe_mm=np.zeros(count),
            choice=rng.random((count, 2)),
        )
        around = Sphere(np.array([0, 0, 600.0]), 400.0, BLACK)  # catches all
        caster = RayCaster([board, around])
        (arrived,) = follow(caster, [board.material, BLACK], photons, rng, bounces=1, diffuse=True)
        assert arrived.flux.sum() == pytest.approx(reflectance, rel=1e-6)


def test_both_sides_of_a_depth_edge_get_the_mirrors_bounce(small):
    settings = small(scene={"name": "mirror_edge"})
    found = truth_of(settings)
    surfaces = dict(zip(settings.scene.part_names, settings.scene.surfaces(), strict=True))
    for name in ("board", "plate"):
        region = _part(settings, found, name) & (found.alpha > 0.1)
        assert region.sum() > 150
        image = _projected(found.rig, _reflected(found.points[region], surfaces["mirror"]))
        error = np.abs(np.stack((found.bounce_x, found.bounce_y), -1)[region] - image)
        assert np.median(error) < 0.1
    depth = {name: np.median(found.depth[_part(settings, found, name)]) for name in ("board", "plate")}
    assert depth["board"] - depth["plate"] == pytest.approx(25.0, abs=0.01)


def test_light_within_wax_dims_fringes_by_its_transfer_function(small):
    """Part s wanders by σ: a fringe of frequency f across the surface keeps 1 - s + s exp(-2π²σ²f²); no phase moves."""
    s, sigma = 0.6, 4.0
    wax = {"reflectance": 0.8, "subsurface": s, "spread_mm": sigma}
    pose = {"name": "plane", "yaw_deg": 0.0, "pitch_deg": 0.0, "width_mm": 500, "height_mm": 400}
    both = [truth_of(small(scene={**pose, "finish": f}, camera={"field_of_view_deg": 15})) for f in (wax, {})]
    rig = both[0].rig
    period = 32
    for axis, shape in (("x", (1, 640)), ("y", (400, 1))):
        turns = np.broadcast_to((2 * np.pi * np.arange(max(shape)) / period).reshape(shape), (400, 640))
        fringe = [
            sum(
                f * t.optics.transport.direct_light(part.astype(np.float32))
                for f, part in ((1, np.cos(turns)), (1j, np.sin(turns)))
            )
            for t in both
        ]
        inner = (slice(60, -60), slice(60, -60))
        ratio = (fringe[0] / fringe[1])[inner]
        # px per mm on the board, from where its middle and 1 mm beside it are projected.
        step = np.array([1.0, 0, 0] if axis == "x" else [0, 1.0, 0])
        middle = np.array([0, 0, 600.0])
        per_mm = np.abs(np.diff(_projected(rig, np.stack((middle, middle + step))), axis=0)).max()
        kept = 1 - s + s * math.exp(-2 * (math.pi * sigma * per_mm / period) ** 2)
        assert kept < 0.8
        assert np.median(ratio.real) == pytest.approx(kept, abs=0.005)
        assert np.abs(np.angle(ratio)).max() * period / (2 * np.pi) < 0.02
    white = [t.optics.transport.direct_light(WHITE)[60:-60, 60:-60].sum() for t in both]
    assert white[0] == pytest.approx(white[1], rel=1e-3)
    np.testing.assert_array_equal(both[0].x_p, both[1].x_p)


def test_fins_throw_strong_narrow_bounces(small):
    settings = small(scene={"name": "fins"}, camera={"width_px": 512, "height_px": 384})
    found = truth_of(settings)
    region = _part(settings, found, "board") & (found.alpha > 0.3)
    assert region.sum() > 500
    # The left side of a fin is a mirror at right angles to the board: the point's image is as far beyond it.
    points, places = found.points[region], (np.arange(6) - 2.5) * 34.0 - 1.5
    beyond = places[:, None] - points[:, 0]
    own = np.where(beyond > 0, beyond, np.inf).argmin(0)
    images = points.copy()
    images[:, 0] = 2 * places[own] - points[:, 0]
    error = found.bounce_x[region] - _projected(found.rig, images)[:, 0]
    assert np.median(np.abs(error)) < 0.3
    normal = np.array([0, 0, -1.0])
    expected = 0.6 * _irradiance(found.rig, images, normal) / _irradiance(found.rig, points, normal)
    assert np.median(found.alpha[region] / expected) == pytest.approx(1, abs=0.05)
    fins = np.isin(found.object_id, [1])
    assert 0.005 < fins.mean() < 0.08


def test_the_ball_lights_the_faces_as_a_convex_mirror_does(small):
    """Rays of the projector, mirrored at the ball by formula, land on the left face as densely as was traced."""
    scene = {"name": "v_board_sphere", "ball": {"reflectance": 0.0, "gloss": 0.8, "roughness": 0.0}}
    settings = small(scene=scene, transport={"photons": 400_000, "diffuse_bounces": 0})
    found = truth_of(settings)
    left, _, ball = settings.scene.surfaces()
    rig, start = found.rig, found.rig.projector_centre_cam

    def landed(px):
        k = rig.projector.matrix
        ray = (
            np.stack(((px[:, 0] - k[0, 2]) / k[0, 0], (px[:, 1] - k[1, 2]) / k[1, 1], np.ones(len(px))), -1)
            @ rig.rotation
        )
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        to = ball.centre - start
        along = ray @ to
        root = along**2 - to @ to + ball.radius**2
        with np.errstate(invalid="ignore"):
            point = start + (along - np.sqrt(root))[:, None] * ray
        normal = (point - ball.centre) / ball.radius
        out = ray - 2 * (ray * normal).sum(1)[:, None] * normal
        t = ((left.centre - point) @ left.normal) / (out @ left.normal)
        hit = point + t[:, None] * out
        return np.where((t > 0)[:, None], hit - left.centre, np.nan) @ np.stack(
            (left.half_width / np.linalg.norm(left.half_width), left.half_height / np.linalg.norm(left.half_height)), 1
        )

    px = np.stack(np.meshgrid(np.arange(0, 640, 2.0), np.arange(0, 400, 2.0)), -1).reshape(-1, 2)
    here, right, down = landed(px), landed(px + np.array([0.01, 0])), landed(px + np.array([0, 0.01]))
    a, b = (right - here) / 0.01, (down - here) / 0.01
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])  # mm² per projector px
    on_face = np.isfinite(area) & (np.abs(here) < [60, 90]).all(1)
    points = left.centre + here[on_face] @ np.stack(
        (left.half_width / np.linalg.norm(left.half_width), left.half_height / np.linalg.norm(left.half_height))
    )
    expected = 0.75 / math.pi * 0.8 / area[on_face]
    k = rig.camera.matrix
    column, row = (np.rint(k[0, 0] * points[:, :2] / points[:, 2:] + k[:2, 2]).astype(int)).T
    light = found.optics.transport.bounced_light(WHITE)
    good = (found.object_id == 0) & ~found.edge & np.isfinite(found.x_p)
    inside = (row > 5) & (row < 187) & (column > 5) & (column < 250)
    inside[inside] &= good[row[inside], column[inside]]
    ratio = light[row[inside], column[inside]] / expected[inside]
    assert inside.sum() > 300
    assert np.median(ratio) == pytest.approx(1, abs=0.03)
    assert np.abs(ratio - 1).mean() < 0.2


def test_windows_lie_on_the_faces_beside_the_ball(small):
    settings = small(scene={"name": "v_board_sphere", "yaw_deg": 4.0, "offset_x_mm": 5.0})
    found = truth_of(settings)
    assert set(found.windows) == {"W1", "W2"}
    for name, face, side in (("W1", 0, -1), ("W2", 1, 1)):
        seen = found.in_window(name)
        assert (found.object_id[seen] == face).all()
        assert np.isfinite(found.x_p[seen]).all()
        assert not found.edge[seen].any()
        # In the scene's own frame the window is 24 x 44 mm about 86 mm from the fold.
        local = (found.points[seen] - [5.0, 0, 640.0]) @ settings.scene.rotation
        from_fold = np.hypot(local[:, 0], local[:, 2])
        assert (np.sign(local[:, 0]) == side).all()
        assert np.abs(from_fold - 86).max() <= 12
        assert np.abs(local[:, 1]).max() <= 22
        assert np.ptp(from_fold) == pytest.approx(24, abs=2.5)
        assert np.ptp(local[:, 1]) == pytest.approx(44, abs=2.5)
    assert np.median(found.alpha[found.in_window("W1")]) > 0.1
    assert np.median(found.alpha[found.in_window("W2")]) > 0.03
    with pytest.raises(KeyError):
        found.in_window("W3")


def test_depth_edges_within_one_surface_are_edges(small):
    """Fins are one surface: where one hides the next, or its own side, the depth jumps."""
    settings = small(scene={"name": "fins", "yaw_deg": 60.0, "gap_mm": 5.0, "distance_mm": 700.0})
    found = truth_of(settings)
    one = (found.object_id[:, 1:] == 1) & (found.object_id[:, :-1] == 1)
    jump = one & (np.abs(np.diff(found.depth, axis=1)) > 15)
    assert jump.sum() > 10
    assert (found.edge[:, 1:] & found.edge[:, :-1])[jump].all()
    # A slanted plane is none.
    plane = truth_of(small(scene={"name": "plane", "yaw_deg": 70.0, "pitch_deg": 20.0}))
    assert plane.edge[plane.object_id == 0].mean() < 0.2


def test_swapping_camera_and_projector_gives_the_same_light():
    """Helmholtz: camera pixel c sees as much of projector pixel p as p, as a camera, sees of c, as a projector.

    With one lens for both, ∫∫ ρ cos θ_c cos θ_p / r_c² r_p² over the two pixels is the same either way. One way the
    bounce is traced from the projector (mirror, board, eye), the other from the camera (eye, mirror, board).
    """
    same = {"width_px": 256, "height_px": 192, "field_of_view_deg": 28.0}
    transport = {"photons": 200_000, "supersample": 2, "diffuse_bounces": 0}
    settings = SimulatedSettings.model_validate({"camera": same, "projector": same, "transport": transport})
    rig = settings.rig()
    swapped = Rig(rig.projector, rig.camera, rig.rotation.T, -rig.rotation.T @ rig.translation, {})

    def moved(s):
        place = rig.rotation @ s.centre + rig.translation
        return Rectangle(place, rig.rotation @ s.half_width, rig.rotation @ s.half_height, s.material)

    surfaces = settings.scene.surfaces()
    there = trace(surfaces, rig, settings.transport)
    back = trace([moved(s) for s in surfaces], swapped, settings.transport)
    region = (there.bounced_light(np.ones((192, 256), np.float32), diffuse=False) > 0) & (there.view.surface == 0)
    row, column = (int(np.median(i)) for i in np.nonzero(region))
    block = np.zeros((192, 256), np.float32)
    block[row - 10 : row + 10, column - 8 : column + 8] = 1
    seen = (back.by_mirror @ block.ravel()).reshape(192, 256)
    assert (seen > 0).sum() > 100
    lit = there.bounced_light((seen > 0).astype(np.float32), diffuse=False)
    assert lit[block > 0].sum() == pytest.approx(seen.sum(), rel=0.01)


@pytest.mark.parametrize("material", [Material(0.0, 0.9), Material(0.3, 0.4, 0.2)])
def test_no_scene_gives_back_more_than_it_gets(material):
    """In a box that nothing leaves, each reflection keeps just the surfaces' share of the light."""
    walls = MeshSurface.of(*box(80, 60, 100), material)
    count = 20_000
    rng = np.random.default_rng(8)
    place = np.stack((rng.uniform(-39, 39, count), rng.uniform(-29, 29, count), np.full(count, -50.0)), 1)
    aim = np.array([3.0, 5.0, 48.0]) - place
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    photons = Photons(
        u=np.zeros(count),
        v=np.zeros(count),
        flux=np.full(count, 1 / count),
        point=place,
        normal=np.tile([0, 0, 1.0], (count, 1)),
        direction=aim * [1, 1, -1],
        surface=np.zeros(count, np.int16),
        lobe_mm=np.zeros(count),
        choice=rng.random((count, 2)),
    )
    caster = RayCaster([walls])
    glossy = [p.flux.sum() for p in follow(caster, [material], photons, rng, bounces=3, diffuse=False)]
    assert glossy[0] <= material.specular * (1 + 1e-9)
    assert all(after <= material.specular * before * (1 + 1e-6) for before, after in itertools.pairwise(glossy))
    if material.roughness == 0:
        np.testing.assert_allclose(glossy, [0.9, 0.81, 0.729], rtol=2e-3)
    if material.diffuse:
        total = material.diffuse + material.specular
        every = [p.flux.sum() for p in follow(caster, [material], photons, rng, bounces=3, diffuse=True)]
        assert every[0] == pytest.approx(material.diffuse, rel=0.03)
        assert every[0] + glossy[0] <= total * 1.02
        assert every[1] + glossy[1] <= total**2 * 1.03
