"""Random patterns in space, and random points on a mesh; both are determined by the seed."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from .fields import Floats
from .surface import Mesh, face_normals

VOLUME_SIZE = 64  # cells along each edge of the periodic volume of random numbers
VOLUME_BLUR = 0.8  # standard deviation of the blur, in cells

# Rotation from each layer of noise to the next finer one; it hides the lattice.
LAYER_TURN = np.array([[0.36, 0.48, -0.80], [-0.80, 0.60, 0.00], [0.48, 0.64, 0.60]])


class Noise:
    """Smooth noise in space, with mean 0 and a standard deviation of about 1."""

    def __init__(self, seed: int) -> None:
        volume = np.random.default_rng(seed).standard_normal((VOLUME_SIZE,) * 3)
        volume = gaussian_filter(volume, VOLUME_BLUR, mode="wrap")
        self._volume = (volume / volume.std()).astype(np.float32)

    def __call__(
        self,
        points: Floats,
        frequency: float,
        channel: int,
        *,
        layers: int = 1,
        stretch: tuple[float, float, float] = (1, 1, 1),
    ) -> Floats:
        """Return the sum of layers, each twice as fine and half as strong as the one before.

        ``frequency`` is in cells per cm. Each ``channel`` gives another pattern. A ``stretch``
        below 1 lengthens the pattern along that axis.
        """
        place = points * np.multiply(stretch, frequency) + 17.3 * channel
        total = np.zeros(len(points), np.float32)
        power = 0.0
        for layer in range(layers):
            place = place @ LAYER_TURN
            cell = np.floor(place)
            share = place - cell
            eased = cell + share * share * (3 - 2 * share)  # continuous slopes for the normal map
            total += 0.5**layer * map_coordinates(
                self._volume, eased.T, order=1, mode="grid-wrap", prefilter=False
            )
            power += 0.25**layer
            place = 2 * place
        return np.asarray(total / np.sqrt(power), np.float32)


def scatter(
    mesh: Mesh,
    count: int,
    random: np.random.Generator,
    weight: Callable[[Floats], Floats],
) -> Floats:
    """Return random points on the mesh; ``weight`` gives the relative density at points (N, 3)."""
    area = np.linalg.norm(face_normals(mesh.positions, mesh.faces), axis=1)
    likely = area.astype(np.float64) * weight(mesh.positions[mesh.faces].mean(1))
    face = random.choice(len(area), count, p=likely / likely.sum())
    shares = random.random((count, 2))
    beyond = shares.sum(1) > 1
    shares[beyond] = 1 - shares[beyond]
    corner, second, third = np.moveaxis(mesh.positions[mesh.faces[face]], 1, 0)
    points = corner + shares[:, :1] * (second - corner) + shares[:, 1:] * (third - corner)
    return np.asarray(points, np.float32)


def nearest(points: Floats, seeds: Floats, reach: float) -> tuple[Floats, np.ndarray]:
    """Return the distance to the nearest seed and its index; infinity and 0 beyond ``reach``."""
    distance, index = cKDTree(seeds).query(points, distance_upper_bound=reach, workers=-1)
    return distance.astype(np.float32), np.where(index == len(seeds), 0, index)
