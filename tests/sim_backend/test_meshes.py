"""Meshes against the shapes that they stand for."""

import math

import numpy as np
import pytest

from sim_backend.meshes import MeshSurface, smooth_normals
from sim_backend.projector_paths import Photons, follow
from sim_backend.raycasting import RayCaster
from sim_backend.settings import TransportSettings
from sim_backend.solids import box, joined, turned_solid
from sim_backend.surfaces import Material, Rectangle, Sphere
from sim_backend.transport import trace

CENTRE, RADIUS = np.array([10.0, -6.0, 600.0]), 55.0
WHITE = np.ones((400, 640), np.float32)


def _ball(radius, rings=120, sides=240):
    polar = np.linspace(0, math.pi, rings + 1)
    profile = [(float(radius * math.sin(t)) if 0 < t < math.pi else 0.0, float(radius * math.cos(t))) for t in polar]
    return turned_solid(profile, sides)


def _mesh_sphere(material):
    vertices, triangles = _ball(RADIUS)
    return MeshSurface.of(vertices + CENTRE, triangles, material)


def _volume(vertices, triangles):
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def test_solids_are_closed_and_face_outwards():
    cup = turned_solid([(0, 0), (20, 0), (20, -30), (15, -30), (15, -5), (0, -5)], sides=400)
    assert _volume(*cup) == pytest.approx(math.pi * (20**2 * 30 - 15**2 * 25), rel=1e-3)
    assert _volume(*box(3, 5, 7)) == pytest.approx(105)
    assert _volume(*joined([box(3, 5, 7), cup])) == pytest.approx(105 + _volume(*cup))
    for _, triangles in (cup, box(3, 5, 7)):
        edges = np.sort(np.concatenate((triangles[:, :2], triangles[:, 1:], triangles[:, ::2])), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_normals_are_smooth_where_the_shape_is_and_broken_at_creases():
    vertices, triangles = _ball(1.0)
    normals = smooth_normals(vertices, triangles, 30.0)
    # A vertex normal is the mean of facets 1.5° wide.
    assert np.abs(normals - vertices[triangles]).max() < 2e-3
    vertices, triangles = box(2, 3, 4)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    facet = np.cross(b - a, c - a)
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    np.testing.assert_allclose(smooth_normals(vertices, triangles, 30.0), np.repeat(facet[:, None], 3, 1), atol=1e-12)
    # Smoothed all over, a box's corner normal is the mean of the three faces, weighted by their right angles.
    corner = np.sign(vertices) / math.sqrt(3)
    np.testing.assert_allclose(smooth_normals(vertices, triangles, 180.0), corner[triangles], atol=1e-12)


def test_a_mesh_of_a_sphere_is_seen_and_lit_as_the_sphere(small):
    settings = small()
    transport = TransportSettings(photons=1000, supersample=2, specular_bounces=0, diffuse_bounces=0)
    matt = Material(0.6, 0.2, 0.3)
    sphere, mesh = (trace([s], settings.rig(), transport) for s in (Sphere(CENTRE, RADIUS, matt), _mesh_sphere(matt)))
    both = np.isfinite(sphere.view.x_p) & np.isfinite(mesh.view.x_p)
    assert both.sum() > 0.98 * np.isfinite(sphere.view.x_p).sum()
    # The facets' sagitta is r (1 - cos(0.75°)) = 0.005 mm, along rays that meet them up to 80° from the normal.
    facing = both & ~sphere.view.mixed & ~mesh.view.mixed
    assert np.abs(sphere.view.x_p - mesh.view.x_p)[facing].max() < 0.03
    assert np.median(np.abs(sphere.view.x_p - mesh.view.x_p)[facing]) < 0.005
    light, same = sphere.direct_light(WHITE)[facing], mesh.direct_light(WHITE)[facing]
    assert np.abs(same - light).max() < 0.01 * light.max()


def test_a_glossy_mesh_throws_the_bounce_of_the_sphere(small):
    settings = small(transport={"photons": 300_000, "diffuse_bounces": 0, "supersample": 1})
    wall = Rectangle(np.array([0, 0, 690.0]), np.array([200.0, 0, 0]), np.array([0, 140.0, 0]), Material(0.8))
    chrome = Material(0.0, 0.8, 0.1)
    light = [
        trace([wall, s], settings.rig(), settings.transport).bounced_light(WHITE)
        for s in (Sphere(CENTRE, RADIUS, chrome), _mesh_sphere(chrome))
    ]
    # Means over squares of 16 px, so that the photons' noise is 1 % or so.
    sphere, mesh = (x[:, :240].reshape(12, 16, 15, 16).mean((1, 3)) for x in light)
    bright = sphere > 0.2 * sphere.max()
    assert bright.sum() > 10
    np.testing.assert_allclose(mesh[bright] / sphere[bright], 1, atol=0.06)
    assert mesh[bright].sum() == pytest.approx(sphere[bright].sum(), rel=0.01)


def test_inside_a_sphere_diffuse_light_is_everywhere_the_same():
    """The form factor from any place to any part of a sphere is that part's share of its area (integrating sphere)."""
    vertices, triangles = _ball(50.0)
    shell = MeshSurface.of(vertices, triangles, Material(0.7))
    count = 100_000
    rng = np.random.default_rng(3)
    at = np.array([0.0, 0.0, 49.9])
    photons = Photons(
        u=np.zeros(count),
        v=np.zeros(count),
        flux=np.full(count, 1 / count),
        point=np.tile(at, (count, 1)),
        normal=np.tile([0, 0, -1.0], (count, 1)),
        direction=np.tile([0, 0, 1.0], (count, 1)),
        surface=np.zeros(count, np.int16),
        lobe_mm=np.zeros(count),
        choice=rng.random((count, 2)),
    )
    first, second = follow(RayCaster([shell]), [shell.material], photons, rng, bounces=2, diffuse=True)
    assert first.flux.sum() == pytest.approx(0.7, rel=1e-3)
    assert second.flux.sum() == pytest.approx(0.7**2, rel=2e-3)
    # By Archimedes, heights are evenly spread: ten zones of equal height, each with 1/10 of the photons.
    for arrived in (first, second):
        for axis in range(3):
            zones = np.histogram(arrived.point[:, axis], 10, (-50, 50))[0] / len(arrived.u)
            np.testing.assert_allclose(zones, 0.1, atol=5 * math.sqrt(0.09 / count) + 1e-3)
