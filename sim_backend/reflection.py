"""How light leaves a surface: Lambert's law and a lobe about the mirror direction.

The lobe is a von Mises–Fisher distribution, because it integrates to one and is drawn from in closed form:
f_s = ρ_s · vMF(angle between ω_o and the mirrored ω_i) / max(cos θ_i, cos θ_o). The divisor makes it reciprocal and
keeps ∫ f_s cos θ_o dω ≤ ρ_s (Neumann, Neumann & Szirmay-Kalos, Computer Graphics Forum 18(3), 1999).
"""

from __future__ import annotations

import math

import numpy as np

from sim_backend.surfaces import Array, Material

_TINY = 1e-12


def dot(a: Array, b: Array) -> Array:
    """(n,) scalar products of vectors (n, 3)."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


def unit(v: Array) -> Array:
    """Vectors (n, 3) at length one."""
    return np.asarray(v / np.sqrt(dot(v, v))[:, None])


def mirrored(direction: Array, normal: Array) -> Array:
    """Directions of travel (n, 3) after a perfect mirror."""
    return direction - 2 * dot(direction, normal)[:, None] * normal


def scatter_specular(material: Material, direction: Array, normal: Array, uniform: Array) -> tuple[Array, Array]:
    """Draw directions from the lobe.

    Parameters
    ----------
    material
        Of the surface.
    direction, normal
        (n, 3) unit direction of travel and unit normal on its side.
    uniform
        (n, 2) numbers in 0..1 that choose within the lobe.

    Returns
    -------
    (n, 3) directions, and (n,) the share of the arriving flux that each carries, 0 for those below the surface.
    """
    axis = mirrored(direction, normal)
    if material.roughness == 0:
        return axis, np.full(len(axis), material.specular)
    cos = 1 + np.log1p(uniform[:, 0] * math.expm1(-2 * material.concentration)) / material.concentration
    out = _about(axis, cos, uniform[:, 1])
    # Interpolated normals may turn from a ray that grazes its triangle: then nothing goes on below the surface.
    cos_in, cos_out = -dot(direction, normal), np.maximum(dot(out, normal), 0)
    return out, material.specular * cos_out / np.maximum(np.maximum(cos_in, cos_out), _TINY)


def scatter_diffuse(normal: Array, uniform: Array) -> Array:
    """(n, 3) directions drawn in proportion to the cosine with the normal; see `scatter_specular`."""
    return _about(normal, np.sqrt(1 - uniform[:, 0]), uniform[:, 1])


def _about(axis: Array, cos: Array, turn: Array) -> Array:
    """Directions at angle arccos(``cos``) from unit axes (n, 3), ``turn`` times round them.

    The tangents are those of Duff et al., Journal of Computer Graphics Techniques 6(1), 2017.
    """
    x, y, z = axis.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    sin = np.sqrt(np.maximum(1 - cos * cos, 0.0))
    s, t = sin * np.cos(2 * math.pi * turn), sin * np.sin(2 * math.pi * turn)
    return np.stack(
        (
            cos * x + s * (1 + sign * x * x * a) + t * b,
            cos * y + s * sign * b + t * (sign + y * y * a),
            cos * z - s * sign * x - t * y,
        ),
        axis=1,
    )
