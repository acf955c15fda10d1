"""An integrator for nLights: the least-squares height as a sum of cosines."""

import numpy as np
from scipy.fft import dctn, idctn

from nlights import HeightMap, Integrator, NormalField, hookimpl


class CosineBasis(Integrator):
    """The surface of least-squares steps, as a sum of cosines; unknown slopes count as level."""

    name = "cosine-basis"

    def integrate(self, normals: NormalField) -> HeightMap:
        p, q = (np.nan_to_num(steps.astype(float)) for steps in normals.gradient())
        flux = np.diff((p[:, 1:] + p[:, :-1]) / 2, axis=1, prepend=0, append=0)
        flux += np.diff((q[1:] + q[:-1]) / 2, axis=0, prepend=0, append=0)
        rows, columns = (4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2 for n in flux.shape)
        scale = np.add.outer(rows, columns)
        height = idctn(-dctn(flux) / np.where(scale > 0, scale, np.inf))
        height[np.isnan(normals.normals[..., 2])] = np.nan
        return HeightMap(np.float32(height - np.nanmean(height)), normals.grid)


@hookimpl
def nlights_algorithms() -> list[type[Integrator]]:
    return [CosineBasis]
