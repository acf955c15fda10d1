"""Paint that is not plain matt: four published shapes of a highlight, and rough body colour, on simulated artworks.

The simulator's own varnish is one shape, Blinn's.  A calibration that is judged on the shape that it was written for
proves little, so the benchmarks bring others.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import erf

from nlights_core.frames import Array
from nlights_core.simulation.illumination import LampGroup

LEAST_COSINE = 1e-4
"""Cosines of grazing rays are taken as this, so that nothing is divided by zero."""


class Cosines(NamedTuple):
    """Cosines between the directions that a shading depends on; arrays of one shape.

    Attributes
    ----------
    lamp, view, half : array
        Normal with the way to the lamp, with that to the camera, with the half vector; 0 where beyond 90 degrees.
    lamp_half, lamp_view : array
        Way to the lamp with the half vector, and with the way to the camera.
    """

    lamp: Array
    view: Array
    half: Array
    lamp_half: Array
    lamp_view: Array


def cosines(normals: Array, light: Array, view: Array) -> Cosines:
    """Cosines of unit vectors, each (3, h, w)."""
    half = unit(light + view)

    def facing(first: Array, second: Array) -> Array:
        return np.asarray((first * second).sum(axis=0))

    over = [np.maximum(facing(normals, way), 0) for way in (light, view, half)]
    return Cosines(*over, facing(light, half), facing(light, view))


def unit(vectors: Array) -> Array:
    """Vectors along the first axis, made unit."""
    return np.asarray(vectors / np.sqrt((vectors * vectors).sum(axis=0)))


def _squared_tangent(cosine: Array) -> Array:
    squared = np.clip(cosine, 1e-6, 1) ** 2
    return np.asarray((1 - squared) / squared)


def ggx_facets(half: Array, roughness: float) -> Array:
    """Density of mirror facets along the half vector, per steradian, of Trowbridge and Reitz (GGX)."""
    squared = roughness**2
    return np.asarray(squared / (np.pi * (half**2 * (squared - 1) + 1) ** 2))


def ggx_unmasked(cosine: Array, roughness: float) -> Array:
    """Share of those facets that is not hidden in a direction at a cosine to the normal (Smith)."""
    return np.asarray(2 / (1 + np.sqrt(1 + roughness**2 * _squared_tangent(cosine))))


def beckmann_facets(half: Array, roughness: float) -> Array:
    """Density of mirror facets along the half vector, per steradian, of Beckmann."""
    squared = roughness**2
    falloff = np.exp(-_squared_tangent(half) / squared)
    return np.asarray(falloff / (np.pi * squared * np.clip(half, 1e-6, 1) ** 4))


def beckmann_unmasked(cosine: Array, roughness: float) -> Array:
    """Share of those facets that is not hidden (Smith), exact."""
    s = 1 / np.maximum(roughness * np.sqrt(_squared_tangent(cosine)), 1e-9)
    hidden = (erf(s) - 1) / 2 + np.exp(-(s**2)) / (2 * s * np.sqrt(np.pi))
    return np.asarray(1 / (1 + hidden))


def _facetted(facets: Callable[..., Array], unmasked: Callable[..., Array]) -> Callable[..., Array]:
    """The lobe of mirror facets, as Torrance and Sparrow have it."""

    def lobe(angles: Cosines, roughness: float) -> Array:
        lamp, view = (np.maximum(c, LEAST_COSINE) for c in (angles.lamp, angles.view))
        seen = unmasked(lamp, roughness) * unmasked(view, roughness)
        return np.asarray(np.pi * facets(angles.half, roughness) * seen / (4 * lamp * view))

    return lobe


def ward(angles: Cosines, roughness: float) -> Array:
    """Lobe of Ward, alike in all directions."""
    lamp, view = (np.maximum(c, LEAST_COSINE) for c in (angles.lamp, angles.view))
    falloff = np.exp(-_squared_tangent(angles.half) / roughness**2)
    return np.asarray(falloff / (4 * roughness**2 * np.sqrt(lamp * view)))


def blinn(angles: Cosines, roughness: float) -> Array:
    """Lobe of the simulator's varnish, its exponent as wide as a roughness."""
    exponent = 2 / roughness**2 - 2
    return np.asarray((exponent + 8) / 8 * angles.half**exponent)


LOBES: dict[str, Callable[[Cosines, float], Array]] = {
    "ggx": _facetted(ggx_facets, ggx_unmasked),
    "beckmann": _facetted(beckmann_facets, beckmann_unmasked),
    "ward": ward,
    "blinn": blinn,
}
"""Shapes of a highlight by name: pi times the BRDF where facets reflect all light [1]_ [2]_ [3]_.

Times pi, for then a matt surface of albedo a has the value a.

References
----------
.. [1] B. Walter et al., Microfacet models for refraction through rough surfaces, EGSR 2007.
.. [2] G. Ward, Measuring and modeling anisotropic reflection, SIGGRAPH 1992.
.. [3] T. Akenine-Moller, E. Haines, N. Hoffman, Real-Time Rendering, 3rd ed., 2008, ch. 7.
"""


class Gloss(NamedTuple):
    """Highlights of a surface.

    Attributes
    ----------
    lobe : str
        One of `LOBES`.
    reflectance : float or tuple of 3 floats
        Of a mirror seen straight on, white or linear RGB.
    roughness : float
        0 is a mirror; the alpha of the formulas.
    """

    lobe: str
    reflectance: float | tuple[float, float, float]
    roughness: float

    def radiance(self, angles: Cosines) -> Array:
        """Highlights under an irradiance of 1 on the surface, (h, w, 1) or (h, w, 3)."""
        shape = LOBES[self.lobe](angles, self.roughness)[..., None]
        straight = np.atleast_1d(np.asarray(self.reflectance, float))
        if self.lobe == "ward":  # has no Fresnel term
            return np.asarray(shape * straight)
        grazing = (1 - np.clip(angles.lamp_half, 0, 1))[..., None] ** 5
        return np.asarray(shape * (straight + (1 - straight) * grazing))


def rough_body(angles: Cosines, spread_rad: float) -> Array:
    """Factor on Lambert's law of a body colour with matt facets, by Oren and Nayar [1]_.

    Parameters
    ----------
    angles : Cosines
        (h, w) each.
    spread_rad : float
        Standard deviation of the facets' tilts, radians; 0 is Lambert.

    Returns
    -------
    (h, w) array

    References
    ----------
    .. [1] M. Oren, S. Nayar, Generalization of Lambert's reflectance model, SIGGRAPH 1994, the qualitative model.
    """
    squared = spread_rad**2
    steady, varying = 1 - 0.5 * squared / (squared + 0.33), 0.45 * squared / (squared + 0.09)
    together = np.maximum(0, angles.lamp_view - angles.lamp * angles.view)
    return np.asarray(
        steady + varying * together / np.maximum(np.maximum(angles.lamp, angles.view), LEAST_COSINE)
    )


class Paint(NamedTuple):
    """How a surface answers light, beside its albedo.

    Attributes
    ----------
    gloss : Gloss, optional
        None: matt.
    spread_rad : float
        Of the body colour's facets; see `rough_body`.
    """

    gloss: Gloss | None = None
    spread_rad: float = 0.0


MATT = Paint()


def reflected(
    paint: Paint,
    group: LampGroup,
    points: Array,
    normals: Array,
    camera: Array,
    skyline: Array | None = None,
) -> tuple[Array, Array]:
    """Light of one lamp group on a paint, in the units of `nlights_core.simulation.illumination.shine`.

    Parameters
    ----------
    paint : Paint
        Of the whole surface.
    group : LampGroup
        Four lamps.
    points, normals : (3, h, w) float64 arrays
        mm; unit.
    camera : (3,) array
        Where it is, mm.
    skyline : (h, w) array, optional
        Tangent of the horizon towards the group; None where nothing stands in the way.

    Returns
    -------
    matt : (h, w, 1) float64 array
        Radiance of the body colour for an albedo of 1.
    gloss : (h, w, 1) or (h, w, 3) float64 array
        Radiance of the highlights.
    """
    view = unit(camera[:, None, None] - points)
    matt, gloss = np.zeros((2, *points.shape[1:], 1))
    for position, axis, power in zip(group.positions, group.axes, group.powers, strict=True):
        ray = position[:, None, None] - points
        squared = (ray * ray).sum(axis=0)
        light = ray / np.sqrt(squared)
        angles = cosines(normals, light, view)
        emitted = np.maximum(-np.tensordot(axis, light, 1), 0) ** group.exponent
        incident = power * (group.centre @ group.centre) * emitted / squared * angles.lamp
        if skyline is not None:
            incident = incident * (ray[2] > skyline * np.hypot(ray[0], ray[1]))
        matt = matt + (incident * rough_body(angles, paint.spread_rad))[..., None]
        if paint.gloss is not None:
            gloss = gloss + incident[..., None] * paint.gloss.radiance(angles)
    return matt, gloss
