import math

import numpy as np
import pytest

from sim_backend.kernels import reflected_radiance
from sim_backend.reflection import mirrored, scatter_diffuse, scatter_specular
from sim_backend.surfaces import Material


def _directions(rng, n):
    """Unit vectors of the upper hemisphere, evenly distributed over the solid angle."""
    cos, turn = rng.random(n), 2 * math.pi * rng.random(n)
    sin = np.sqrt(1 - cos**2)
    return np.stack((sin * np.cos(turn), sin * np.sin(turn), cos), 1)


def _brdf(material, to_light, to_eye):
    """Radiance per irradiance at the origin of the plane z = 0; the light stands 1 mm away."""
    materials = np.array([(material.diffuse, material.specular, material.concentration)])
    one = np.ones(1)
    return np.array(
        [
            reflected_radiance(
                materials,
                materials[:, 0],
                np.zeros(1, np.int16),
                i,
                np.zeros((1, 3)),
                np.array([[0.0, 0, 1]]),
                o[None],
                one,
            )[0]
            for i, o in zip(to_light, to_eye, strict=True)
        ]
    )


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_brdf_is_reciprocal(roughness):
    rng = np.random.default_rng(1)
    a, b = _directions(rng, 200), _directions(rng, 200)
    material = Material(0.3, 0.5, roughness)
    np.testing.assert_allclose(_brdf(material, a, b), _brdf(material, b, a), rtol=1e-9)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("incidence_deg", [0, 40, 80])
def test_brdf_gives_back_no_more_than_it_gets(roughness, incidence_deg):
    rng = np.random.default_rng(2)
    n = 40_000
    out = _directions(rng, n)
    angle = math.radians(incidence_deg)
    light = np.tile([math.sin(angle), 0.0, math.cos(angle)], (n, 1))
    # ∫ f cos θ dω by Monte Carlo over a hemisphere of 2π sr.
    value = 2 * math.pi * _brdf(Material(0.4, 0.6, roughness), light, out) * out[:, 2]
    assert value.mean() < 1 + 4 * value.std() / math.sqrt(n)
    assert value.mean() > 0.4


def test_brdf_of_a_matt_surface_is_lamberts():
    rng = np.random.default_rng(3)
    values = _brdf(Material(0.7), _directions(rng, 50), _directions(rng, 50))
    np.testing.assert_allclose(values, 0.7 / math.pi, rtol=1e-12)


@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.5])
def test_lobe_has_the_breadth_that_the_roughness_says(roughness):
    rng = np.random.default_rng(4)
    n = 50_000
    incoming = np.tile([[0.0, 0.0, -1.0]], (n, 1))
    normal = -incoming
    material = Material(0.0, 1.0, roughness)
    out, share = scatter_specular(material, incoming, normal, rng.random((n, 2)))
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, rtol=1e-12)
    # Mean resultant length of a von Mises-Fisher distribution: coth κ - 1/κ.
    k = material.concentration
    assert out[:, 2].mean() == pytest.approx(1 / math.tanh(k) - 1 / k, abs=5 * out[:, 2].std() / math.sqrt(n))
    if roughness < 0.3:  # narrow enough for the tangent plane
        assert out[:, 0].std() == pytest.approx(math.sqrt(2) * roughness**2, rel=0.02)
    assert (share <= 1 + 1e-12).all()
    assert (share[out[:, 2] <= 0] == 0).all()


def test_lobe_sampling_agrees_with_the_brdf():
    """The mean of a function over drawn directions is its integral against f cos θ."""
    rng = np.random.default_rng(5)
    n = 40_000
    incoming = np.tile([[math.sin(1.0), 0.0, -math.cos(1.0)]], (n, 1))
    normal = np.tile([[0.0, 0.0, 1.0]], (n, 1))
    material = Material(0.0, 0.8, 0.6)
    drawn, share = scatter_specular(material, incoming, normal, rng.random((n, 2)))
    sampled = share * drawn[:, 0]
    even = _directions(rng, n)
    integrated = 2 * math.pi * _brdf(material, -incoming, even) * even[:, 2] * even[:, 0]
    error = math.hypot(sampled.std(), integrated.std()) / math.sqrt(n)
    assert sampled.mean() == pytest.approx(integrated.mean(), abs=4 * error)


def test_perfect_mirror_reflects_by_the_law_of_reflection():
    rng = np.random.default_rng(6)
    normal, incoming = _directions(rng, 100), -_directions(rng, 100)
    out = mirrored(incoming, normal)
    along = lambda v: np.einsum("ij,ij->i", v, normal)  # noqa: E731
    np.testing.assert_allclose(along(out), -along(incoming), atol=1e-12)
    np.testing.assert_allclose(np.cross(out, normal), np.cross(incoming, normal), atol=1e-12)


def test_diffuse_directions_follow_the_cosine():
    rng = np.random.default_rng(7)
    n = 50_000
    axis = _directions(rng, 1)
    out = scatter_diffuse(np.repeat(axis, n, 0), rng.random((n, 2)))
    cos = out @ axis[0]
    # Density 2 cos θ sin θ: mean of cos θ is 2/3, of cos² θ 1/2.
    assert cos.min() >= 0
    assert cos.mean() == pytest.approx(2 / 3, abs=4 * cos.std() / math.sqrt(n))
    assert (cos**2).mean() == pytest.approx(1 / 2, abs=4 * (cos**2).std() / math.sqrt(n))
