"""Environment maps: a panorama, the values derived from it for shading, and a procedural studio
panorama. Files are .hdr, .exr or NumPy.

Shading reads a panorama in three forms. Irradiance is nine coefficients of spherical harmonics.
Specular light is filtered samples of octahedral mip levels. Occlusion needs directions that shadow
maps can serve: a few disc lights, which hold the bright areas (:meth:`Panorama.lights`). Their
visible fractions also stand for the areas between them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, closest_name, quoted
from facerender.images.files import MAX_BYTES, check_pixels, png_bytes, read_image
from facerender.images.image import encode_srgb8
from facerender.scene.light import Light
from facerender.system.files import read_file, suffix_of
from facerender.terms.model import MAX_RADIUS
from facerender.values.fields import PATH, TEXT, Instance, Range, build, field, field_of, record
from facerender.values.vectors import AZIMUTHS, MAX_RADIANCE, direction_to, numbers_in, unit

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

SIDE = 256  # side of the octahedral map's first mip level, in texels; 4 texels in the last level
LEVELS = 7
_INSIDE = 4  # each texel of the octahedral map averages 4 x 4 samples of the panorama
_SUFFIXES = (".hdr", ".exr", ".npy", ".npz")
STUDIO = "studio"  # name of the procedural environment map
_CELLS = 64  # rows of the cells from which lights are made
_LEAST_RADIUS = 0.25  # of a light, in degrees; the sun has 0.27
_LLOYD_STEPS = 10  # further steps move areas by less than a degree
_DISC_STEPS = 5  # further steps change radii by less than a tenth


@dataclass(frozen=True, eq=False)
class Panorama:
    """Radiance from every direction, as a latitude-longitude image.

    Parameters
    ----------
    name : file or "studio", for messages and scene files
    radiance : (H, 2 H, 3), linear RGB. The top row is the direction straight up. The middle column
        is +z, the direction in which the face looks. Columns left of the middle have x > 0

    Raises InputError for an invalid shape, or a radiance that is not a number in [0, 1e9].
    """

    name: str
    radiance: Float32

    def __post_init__(self) -> None:
        TEXT.check("name of a panorama", self.name)  # scene files contain it
        radiance = np.asarray(self.radiance, dtype=np.float32)
        if radiance.ndim != 3 or radiance.shape[1:] != (2 * len(radiance), 3) or len(radiance) < 2:
            shape = " x ".join(map(str, radiance.shape[1::-1] + radiance.shape[2:]))
            remedy = "give an RGB image, twice as wide as high"
            raise InputError(f"environment {self.name} has {shape} values: {remedy}")
        inside = (radiance >= 0.0) & (radiance <= MAX_RADIANCE)
        if not inside.all():
            row, column, _ = np.unravel_index(int(inside.argmin()), radiance.shape)
            pixel = f"{radiance[row, column].tolist()} in column {column} of row {row}"
            remedy = f"give numbers in [0, {MAX_RADIANCE:g}]"
            raise InputError(f"environment {self.name} has radiance {pixel}: {remedy}")
        object.__setattr__(self, "radiance", radiance)

    def __repr__(self) -> str:
        height, width = self.radiance.shape[:2]
        return f"<Panorama {clipped(self.name)!r}, {width} x {height}>"

    def _repr_png_(self) -> bytes:
        return Environment(self)._repr_png_()

    @cached_property
    def coefficients(self) -> Float:
        """Irradiance for each normal, as nine RGB coefficients of spherical harmonics, (9, 3)."""
        radiance, directions, solid_angle = self._resampled
        return _coefficients(radiance * solid_angle[..., None], directions)

    def lights(self, count: int) -> PanoramaLights:
        """Return the panorama as `count` disc lights and a remainder; see :func:`_divided`."""
        if count not in self._lights:
            self._lights[count] = _divided(self, count)
        return self._lights[count]

    @cached_property
    def _lights(self) -> dict[int, PanoramaLights]:
        """The results of :meth:`lights` by their number."""
        return {}

    @cached_property
    def map(self) -> Float32:
        """Mip levels of the octahedral map side by side, (SIDE + 2, W, 3). Each level has half the
        side of the previous level, and a border of one texel for filtering at its edges."""
        level, solid_angle = self._octahedron()
        levels = []
        for _ in range(LEVELS):
            # On the sphere, the two halves of each edge of the map coincide. So the border is a
            # copy of the edges in reverse order.
            mip = np.concatenate([level[:, :1][::-1], level, level[:, -1:][::-1]], axis=1)
            mip = np.concatenate([mip[:1, ::-1], mip, mip[-1:, ::-1]])
            levels.append(np.pad(mip, ((0, SIDE + 2 - len(mip)), (0, 0), (0, 0))))
            half = len(level) // 2
            light, solid_angle = (
                texels.reshape(half, 2, half, 2, -1).sum(axis=(1, 3))
                for texels in (level * solid_angle, solid_angle)
            )
            level = light / solid_angle
        return np.concatenate(levels, axis=1, dtype=np.float32, casting="same_kind")

    @cached_property
    def _resampled(self) -> tuple[Float, Float, Float]:
        """Radiance reduced to at most 2 SIDE rows, with direction and solid angle of each pixel."""
        height, rows = len(self.radiance), min(len(self.radiance), 2 * SIDE)
        edges, target_edges = (-np.cos(np.pi * np.arange(n + 1) / n) for n in (height, rows))
        radiance = _means(self.radiance, edges, target_edges).swapaxes(0, 1)
        columns = np.arange(2 * height + 1.0), np.linspace(0.0, 2 * height, 2 * rows + 1)
        radiance = _means(radiance, *columns).swapaxes(0, 1)
        return radiance, _directions(rows), np.diff(target_edges)[:, None] * (np.pi / rows)

    def _octahedron(self) -> tuple[Float, Float]:
        """Return the first mip level (SIDE, SIDE, 3) of the map, and each texel's solid angle."""
        rows = len(self._resampled[0])
        radiance = np.pad(self._resampled[0], ((1, 1), (0, 0), (0, 0)), "edge")
        radiance = np.pad(radiance, ((0, 0), (1, 1), (0, 0)), "wrap")
        total, weights = np.zeros((SIDE, SIDE, 3)), np.zeros((SIDE, SIDE, 1))
        for i, j in np.ndindex(_INSIDE, _INSIDE):
            v, u = (2.0 * (np.arange(SIDE) + (k + 0.5) / _INSIDE) / SIDE - 1.0 for k in (i, j))
            v = v[:, None]
            # The centre of the map is the direction up. The corners, where y < 0, are folded down.
            y = 1.0 - np.abs(u) - np.abs(v)
            x, z = (
                np.where(y < 0.0, (1.0 - np.abs(across)) * np.where(along >= 0.0, 1.0, -1.0), along)
                for along, across in ((u, v), (v, u))
            )
            length = np.sqrt(x * x + y * y + z * z)
            row = np.arccos(y / length) / np.pi * rows + 0.5
            column = (0.5 - np.arctan2(x / length, z / length) / (2.0 * np.pi)) * 2 * rows + 0.5
            weight = length[..., None] ** -3
            total += weight * _bilinear(radiance, row, column)
            weights += weight
        return total / weights, weights * (2.0 / (SIDE * _INSIDE)) ** 2


@dataclass(frozen=True, eq=False)
class PanoramaLights:
    """A panorama as K disc lights and a remainder.

    directions : (K, 3) float64, unit vectors
    radii : (K,), angular radii in degrees, in [0.25, 20]
    irradiance : (K, 3), of a surface that faces the light
    around : (K, 3), integral of the remainder's radiance over the area of the light
    coefficients : (9, 3), of the remainder; see :attr:`Panorama.coefficients`
    """

    directions: Float
    radii: Float
    irradiance: Float
    around: Float
    coefficients: Float


def _divided(panorama: Panorama, count: int) -> PanoramaLights:
    """Divide a panorama into `count` lights (fewer if it has fewer pixels) and a remainder.

    The areas begin with equal energy (Debevec 2005, "A median cut algorithm for light probe
    sampling"), then each consists of the directions nearest to its mean (Lloyd 1982, "Least squares
    quantization in PCM"). The light of an area is the radiance within MAX_RADIUS of its brightest
    part, or within twice its radius: a sun is a small light apart from its sky, and a soft box is
    one disc or a few. Without lights, the remainder is the panorama.
    """
    if not count:
        none = np.zeros((0, 3))
        return PanoramaLights(none, np.zeros(0), none, none, panorama.coefficients)
    radiance, directions, solid_angle = panorama._resampled
    light = radiance * solid_angle[..., None]
    weight = light.mean(axis=-1) + solid_angle * max(1e-6 * float(light.mean()), 1e-30)
    rows, columns = (
        np.linspace(0, size, min(size, most) + 1)[:-1].astype(int)
        for size, most in zip(weight.shape, (_CELLS, 2 * _CELLS), strict=True)
    )
    values = np.concatenate([light, directions * weight[..., None], weight[..., None]], axis=-1)
    cells = np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1).reshape(-1, 7)
    energy, moments, weights = np.split(cells, (3, 6), axis=1)
    points = unit(moments)

    areas = [np.arange(len(cells))]
    while len(areas) < min(count, len(cells)):
        sums = [weights[area].sum() * (len(area) > 1) for area in areas]
        area = areas.pop(int(np.argmax(sums)))
        offsets = points[area] - moments[area].sum(axis=0) / weights[area].sum()
        # The factors decide between equal extents, which rounding would decide otherwise.
        extent = (weights[area] * offsets**2).sum(axis=0) * (1.0, 1.001, 1.002)
        area = area[np.argsort(offsets[:, int(np.argmax(extent))], kind="stable")]
        until = np.cumsum(weights[area])
        middle = min(int(np.searchsorted(until, 0.5 * until[-1])) + 1, len(area) - 1)
        areas += [area[:middle], area[middle:]]
    centres = unit(np.array([moments[area].sum(axis=0) for area in areas]))

    def sums_of(values: Float, chosen: NDArray[np.bool_] | bool = True) -> Float:
        inside = [chosen & (nearest == index) for index in range(len(centres))]
        return np.array([values[cells].sum(axis=0) for cells in inside])

    for _ in range(_LLOYD_STEPS):
        nearest = np.argmax(points @ centres.T, axis=1)
        means = unit(sums_of(moments))
        centres = np.where(means.any(axis=1, keepdims=True), means, centres)
    reach = np.full(len(centres), MAX_RADIUS)
    for _ in range(_DISC_STEPS):
        cosines = np.einsum("ij,ij->i", points, centres[nearest])
        inside = cosines > np.cos(np.radians(reach))[nearest]
        totals = sums_of(moments, inside)
        centres = np.where(totals.any(axis=1, keepdims=True), unit(totals), centres)
        # The mean of the directions within a disc of radius R is (1 + cos R)/2 long.
        length = np.linalg.norm(totals, axis=1) / np.maximum(sums_of(weights, inside)[:, 0], 1e-300)
        radii = np.degrees(np.arccos(np.clip(2.0 * length - 1.0, -1.0, 1.0)))
        radii = np.clip(radii, _LEAST_RADIUS, MAX_RADIUS)
        reach = np.clip(2.0 * radii, 180.0 / _CELLS, MAX_RADIUS)
    irradiance, around = sums_of(energy, inside), sums_of(energy, ~inside)
    coefficients = _coefficients(np.where(inside[:, None], 0.0, energy), points)
    return PanoramaLights(centres, radii, irradiance, around, coefficients)


@record("environment ")
class Environment:
    """An environment map with its rotation and scale.

    Parameters
    ----------
    panorama : image of the radiance
    """

    panorama: Panorama = field(Instance(Panorama, "facerender.load_environment(FILE).panorama"))
    rotation: float = field(
        AZIMUTHS, 0.0, "rotation about the vertical axis, added to the panorama's azimuths"
    )
    scale: float = field(
        Range(0.0, MAX_RADIANCE),
        1.0,
        "factor on the radiance; a uniform radiance of 1 shows a white diffuse surface as 1",
    )

    @property
    def turn(self) -> Float:
        """Rotation matrix (3, 3) from directions in mesh space to directions in the panorama."""
        cos, sin = np.cos(np.radians(self.rotation)), np.sin(np.radians(self.rotation))
        return np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])

    def lights(self, count: int) -> tuple[Light, ...]:
        """Return `count` disc lights, rotated and scaled; see :meth:`Panorama.lights`."""
        split = self.panorama.lights(count)
        x, y, z = np.clip(split.directions @ self.turn, -1.0, 1.0).T
        azimuths, elevations = np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(y))
        irradiance = np.minimum(self.scale * split.irradiance, MAX_RADIANCE)
        columns = azimuths, elevations, irradiance, split.radii
        return tuple(
            Light(float(azimuth), float(elevation), tuple(color.tolist()), radius=float(radius))
            for azimuth, elevation, color, radius in zip(*columns, strict=True)
        )

    def seen(self, directions: Float) -> Float32:
        """Return the radiance (H, W, 3) that pixels with these directions (H, W, 3) in mesh space
        show: bilinear interpolation of the panorama."""
        rows, image = len(self.panorama.radiance), np.empty(directions.shape, dtype=np.float32)
        for number, along in enumerate(directions):  # by row, so that arrays stay in the cache
            x, y, z = self.turn @ (along.T / np.linalg.norm(along, axis=-1))
            row = np.clip(np.arccos(np.clip(y, -1.0, 1.0)) / np.pi * rows - 0.5, 0, rows - 1.001)
            column = (0.5 - np.arctan2(x, z) / (2.0 * np.pi)) * 2 * rows - 0.5
            image[number] = self.scale * _bilinear(self.panorama.radiance, row, column)
        return image

    def _repr_png_(self) -> bytes:
        """Return the rotated and scaled panorama as PNG of about 512 columns, for notebooks. The
        middle column is +z, the direction in which the face looks."""
        radiance = self.panorama.radiance
        step = max(radiance.shape[1] // 512, 1)
        columns = round(self.rotation / 360.0 * radiance.shape[1])  # azimuths increase to the left
        turned = np.roll(radiance, -columns, axis=1)[::step, ::step]
        return png_bytes(encode_srgb8(turned * np.float32(self.scale)), {})


@lru_cache(maxsize=1)
def studio() -> Panorama:
    """Return the panorama of a dim room with three lights, as seen from in front of the face."""
    directions = _directions(128)
    room = np.array([0.060, 0.066, 0.072]) * (1.2 + 0.8 * directions[..., 1:2])
    for azimuth, elevation, width, height, color in (
        (-48.0, 38.0, 0.45, 0.6, (4.4, 4.2, 3.9)),  # a large soft box at the upper left
        (70.0, 8.0, 0.22, 0.9, (1.2, 1.3, 1.4)),  # a strip light at the right
        (145.0, 30.0, 0.2, 0.7, (3.2, 3.3, 3.6)),  # a rim light behind the face
    ):
        center = direction_to(azimuth, elevation)
        right = np.cross([0.0, 1.0, 0.0], center)
        right /= np.linalg.norm(right)
        depth = directions @ center
        box = (depth > 0.0).astype(np.float64)
        for axis, half in ((right, width), (np.cross(center, right), height)):
            offset = directions @ axis / np.maximum(depth, 1e-3)
            box *= np.clip((half - np.abs(offset)) / 0.08 + 0.5, 0.0, 1.0)
        room = room + box[..., None] * color
    return Panorama("studio", room.astype(np.float32))


def _coefficients(light: Float, directions: Float) -> Float:
    """Return nine RGB coefficients of spherical harmonics, (9, 3), from the integrals of the
    radiance over pixels and their directions, (..., 3) each."""
    from facerender.terms.environment import harmonics

    received = harmonics(directions).reshape(-1, 9).T @ light.reshape(-1, 3)
    factors = np.array([16, 32, 32, 32, 60, 60, 5, 60, 15]) / 64.0
    return np.asarray(factors[:, None] * received)


def _directions(rows: int) -> Float:
    """Return the directions of a panorama's pixels, (rows, 2 rows, 3)."""
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = np.pi * (1.0 - (np.arange(2 * rows) + 0.5) / rows)
    across, up = np.cos(elevation), np.sin(elevation) + 0.0 * azimuth
    return np.stack([across * np.sin(azimuth), up, across * np.cos(azimuth)], axis=-1)


def _means(values: NDArray[np.floating], edges: Float, target_edges: Float) -> Float:
    """Return, for each interval [target_edges[j], target_edges[j + 1]], the mean of the rows of
    ``values``. Row i spans the interval [edges[i], edges[i + 1]]."""
    if len(target_edges) == len(edges):
        return values.astype(np.float64)
    means = np.empty((len(target_edges) - 1, *values.shape[1:]))
    for i, (low, high) in enumerate(pairwise(target_edges)):
        first, last = np.searchsorted(edges, low, "right") - 1, np.searchsorted(edges, high)
        shares = np.diff(np.clip(edges[first : last + 1], low, high)) / (high - low)
        means[i] = np.tensordot(shares, values[first:last], 1)
    return means


def _bilinear(texels: NDArray[np.floating], row: Float, column: Float) -> Float:
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    down, right, k = (row - i)[..., None], (column - j)[..., None], (j + 1) % texels.shape[1]
    upper = (1.0 - right) * texels[i, j] + right * texels[i, k]
    lower = (1.0 - right) * texels[i + 1, j] + right * texels[i + 1, k]
    return np.asarray((1.0 - down) * upper + down * lower)


@record("environment ")
class EnvironmentFile:
    """Path, rotation and scale of an environment map."""

    TEXTS = f"a path, {STUDIO}"
    file: str = field(PATH, text=f'a .hdr, .exr, .npy or .npz, or "{STUDIO}"')
    rotation: float = field_of(Environment, "rotation")
    scale: float = field_of(Environment, "scale")

    @classmethod
    def parse(cls, text: str) -> dict[str, Any]:
        """Return the fields from the text ``FILE[,ROTATION[,SCALE]]``."""
        file, *words = text.split(",")
        numbers = numbers_in(words)
        if len(numbers) != len(words) or len(words) > 2:
            form = f"FILE[,ROTATION[,SCALE]], where FILE may be {STUDIO} and ROTATION is in degrees"
            raise InputError(f"environment {quoted(text)}: give {form}")
        return dict(zip(("file", "rotation", "scale"), [file, *numbers], strict=False))


def wanted(file: str) -> str:
    """Return the description of the expected file for messages, first a name like ``file``."""
    maps = f"an environment map ({', '.join(_SUFFIXES)})"
    return f"{STUDIO}, or {maps}" if closest_name(file, [STUDIO]) else f"{maps}, or {STUDIO}"


EnvironmentSource: TypeAlias = "Environment | EnvironmentFile | str | os.PathLike[str]"


def load_environment(file: EnvironmentFile | str | os.PathLike[str]) -> Environment:
    """Load an environment map. The panoramas of the two files used last are cached, with all data
    derived from these panoramas. All environments loaded from one file share its panorama.

    file : a path, "studio", a text such as "room.hdr,ROTATION,SCALE", or an
        :class:`EnvironmentFile`

    Raises InputError if the file is missing, damaged, or of an unknown format or shape; if a
    radiance is not a number in [0, 1e9]; if OpenImageIO (.hdr) or OpenEXR (.exr) is not installed.
    """
    source = build(EnvironmentFile, file, "environment")
    path, turn = source.file, (source.rotation, source.scale)
    if path == STUDIO:
        return Environment(studio(), *turn)
    suffix_of(path, _SUFFIXES, "environment", wanted(path), MAX_BYTES)
    status = os.stat(path)
    return Environment(_panorama(path, status.st_mtime_ns, status.st_size), *turn)


@lru_cache(2)
def _panorama(file: str, written: int, size: int) -> Panorama:
    path = Path(file)
    if path.suffix.lower() == ".hdr":
        return Panorama(file, _read_hdr(read_file(path, wanted(file), MAX_BYTES), path))
    picture = read_image(path)
    if picture.encoding != "linear":
        raise InputError(f"environment {path} holds 8-bit values: give linear radiance")
    return Panorama(file, picture.color)


def _read_hdr(content: bytes, path: Path) -> NDArray[np.float32]:
    try:
        import OpenImageIO as oiio
    except ImportError:
        package = "the package OpenImageIO; pip install 'facerender[hdr]'"
        raise InputError(f"{path}: .hdr needs {package}") from None
    file, why = None, "it does not start like a Radiance file"
    if content.startswith(b"#?"):  # otherwise OpenImageIO would try other formats
        file, why = oiio.ImageInput.open(str(path)), oiio.geterror()
    if file:
        spec = file.spec()
        check_pixels(str(path), spec.width, spec.height, 4 * spec.nchannels, len(content))
        if (pixels := file.read_image(oiio.FLOAT)) is not None:
            return np.asarray(pixels, dtype=np.float32)
        why = file.geterror()
    why = clipped(why) or "damaged"
    raise InputError(f"OpenImageIO cannot read {path} ({why}); write the file again")
