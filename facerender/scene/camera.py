"""Cameras that orbit the mesh or have a given position, and their lens distortion.

Angles are in degrees, lengths in mesh units. The distortion is OpenCV's model in float64. Its
points are normalised camera coordinates: x / z and y / z in OpenCV's camera space. Coefficients are
(k1, k2, p1, p2[, k3[, k4, k5, k6]]); left-out ones are 0. No image and no OpenGL here. Source:
OpenCV 4, "Camera Calibration and 3D Reconstruction"."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, quoted
from facerender.values import vectors
from facerender.values.fields import (
    SWITCH,
    TEXT,
    Choice,
    IntegerRange,
    Limits,
    Range,
    build,
    field,
    record,
)
from facerender.values.vectors import AZIMUTHS, ELEVATIONS, IMAGE_SIZES, POSITIONS, Vector

Float = NDArray[np.float64]
Coefficients = tuple[float, ...]

_STEPS = 20  # Newton's steps; 4 suffice unless the distortion nearly folds
_PRECISE = 1e-12  # largest residual of a solution, relative to 1 + the length of the point
_TABLE = 1024  # entries of the table of radii that Newton's method starts from


def distort(points: Float, coefficients: Coefficients) -> Float:
    """Return distorted points (N, 2); NaN at and beyond the fold, where several points would have
    the same distorted point."""
    with np.errstate(all="ignore"):
        distorted, _, determinant = _distorted(points, coefficients)
        square = np.einsum("ni,ni->n", points, points)
    distorted[~((determinant > 0.0) & (square < fold(coefficients) ** 2))] = np.nan
    return distorted


def jacobian(points: Float, coefficients: Coefficients) -> Float:
    """Return the derivatives (N, 2, 2) of distorted points by undistorted points (N, 2)."""
    return _distorted(points, coefficients)[1]


def undistort(points: Float, coefficients: Coefficients) -> Float:
    """Return the points (N, 2) whose distorted points are given; NaN if there are none."""
    if not len(points):
        return points
    with np.errstate(all="ignore"):
        radii, limit = np.hypot(*points.T), fold(coefficients)
        end = max(float(radii.max()), 1e-9)
        # The table must contain all points, but end below the fold, where it would not increase.
        while end < limit and _radial(np.array(end), coefficients) < radii.max():
            end *= 2.0
        table = np.linspace(0.0, min(end, limit), _TABLE, endpoint=end < limit)
        start = np.interp(radii, _radial(table, coefficients), table)
        solution = points * np.where(radii > 0.0, start / radii, 1.0)[:, None]
        for _ in range(_STEPS):
            distorted, slopes, determinant = _distorted(solution, coefficients)
            residual = distorted - points
            (x, y), (a, b, _, d) = residual.T, slopes.reshape(-1, 4).T
            steps = np.stack([d * x - b * y, a * y - b * x], axis=-1)
            solution = solution - steps / determinant[:, None]
            if np.nanmax(np.abs(residual), initial=0.0) < 1e-15:
                break
        residual = np.abs(distort(solution, coefficients) - points).max(axis=-1)
        solution[~(residual <= _PRECISE * (1.0 + radii))] = np.nan
    return solution


def fold(coefficients: Coefficients) -> float:
    """Return the radius at which the radial function stops to increase; inf if there is none."""
    upper, lower = _polynomials(coefficients)
    q = Polynomial([0.0, 1.0])
    increase = upper * lower + 2.0 * q * (upper.deriv() * lower - upper * lower.deriv())
    roots = np.concatenate([increase.trim().roots(), lower.trim().roots()])
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return math.sqrt(squares.min()) if squares.size else math.inf


def _polynomials(coefficients: Coefficients) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator of the radial factor as polynomials in r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    return Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])


def _radial(radii: Float, coefficients: Coefficients) -> Float:
    upper, lower = _polynomials(coefficients)
    return np.asarray(radii * upper(radii**2) / lower(radii**2))


def _distorted(points: Float, coefficients: Coefficients) -> tuple[Float, Float, Float]:
    """Return distorted points (N, 2), their derivatives by the points, and the determinants."""
    _, _, p1, p2, *_ = coefficients
    upper, lower = _polynomials(coefficients)
    x, y = points.T
    square = x * x + y * y
    above, below = upper(square), lower(square)
    factor = above / below
    # Derivative of the factor by r^2, doubled.
    change = 2.0 * (upper.deriv()(square) - factor * lower.deriv()(square)) / below
    across = x * factor + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    down = y * factor + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    a = factor + x * x * change + 2.0 * p1 * y + 6.0 * p2 * x
    b = x * y * change + 2.0 * (p1 * x + p2 * y)
    d = factor + y * y * change + 6.0 * p1 * y + 2.0 * p2 * x
    slopes = np.stack([a, b, b, d], axis=-1).reshape(-1, 2, 2)
    return np.stack([across, down], axis=-1), slopes, a * d - b * b


RegionName = Literal["auto", "all", "head", "face", "eyes"]
Row = tuple[float, float, float, float]
Size = int | tuple[int, int]

FRAMES: tuple[RegionName, ...] = get_args(RegionName)
AZIMUTHS_BY_NAME = {"front": 0.0, "three-quarter": -35.0, "profile": -90.0}
# Azimuth and elevation of the standard views of clinical photography. Right and left are the sides
# of the subject.
STANDARD_ANGLES = {
    "frontal": (0.0, 0.0),
    "right-oblique": (-45.0, 0.0),
    "left-oblique": (45.0, 0.0),
    "right-lateral": (-90.0, 0.0),
    "left-lateral": (90.0, 0.0),
    "basal": (0.0, -60.0),
    "superior": (0.0, 60.0),
}
# Texts that Camera.parse accepts, for messages and help.
ORBITS = (
    f"{', '.join((*AZIMUTHS_BY_NAME, *STANDARD_ANGLES))}, or AZIMUTH[,ELEVATION[,ZOOM]] in degrees"
)
CAMERA_FILES = (".toml", ".json", ".npz")
MAX_CAMERAS = 100_000
_STANDARD_ZOOM = 1.2  # crops the neck in views from above and from below
TURNS = IntegerRange(1, 3600)  # views of a turntable: steps of at least 0.1 degrees
_CHECKED = 33  # points per side of the grid on which the distortion is checked
_NOT_ROTATED = 1e-3  # largest accepted element of |R R^T - I|; not 0, because users may round R
# Last rows of matrices for column vectors, and last columns of matrices for row vectors.
_AFFINE, _PERSPECTIVE = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, -1.0, 0.0)
_FLIP = np.array([1.0, -1.0, -1.0])  # between the axes of OpenGL's and OpenCV's camera spaces


class _Azimuths(Range):
    """The azimuths of cameras: a number, or a name."""

    def check(self, name: str, value: Any) -> Any:
        if isinstance(value, str):
            if value not in AZIMUTHS_BY_NAME:
                names = ", ".join(AZIMUTHS_BY_NAME)
                remedy = f"give a number in [{self.low:g}, {self.high:g}], or {names}"
                raise InputError(f"{name} = {quoted(value)} is not a number: {remedy}")
            value = AZIMUTHS_BY_NAME[value]
        return super().check(name, value)


@dataclass(frozen=True)
class _Rows(Limits):
    """A matrix with three rows."""

    columns: int

    def check(self, name: str, value: Any) -> Any:
        return tuple(map(tuple, _numbers(name, value, (3, self.columns)).tolist()))


class _Distortion(Range):
    """Coefficients of a lens distortion: 4, 5 or 8 numbers; only zeros stand for None."""

    def check(self, name: str, value: Any) -> Any:
        values = value.ravel().tolist() if isinstance(value, np.ndarray) else value
        numbers = [*values] if isinstance(values, tuple | list) else []
        while len(numbers) > 8 and numbers[-1] in Range(0.0, 0.0):
            numbers.pop()  # OpenCV appends zeros for thin prism and tilt
        if len(numbers) not in (4, 5, 8):
            form = "4, 5 or 8 numbers, k1, k2, p1, p2, k3 to k6, without thin prism and tilt"
            raise InputError(f"{name} = {quoted(value)}: give {form}")
        if not all(number in self for number in numbers):
            bounds = f"[{self.low:g}, {self.high:g}]"
            raise InputError(f"{name} = {quoted(value)}: give numbers in {bounds}")
        return tuple(map(float, numbers)) if any(numbers) else None


@record("camera ")
class Camera:
    """A perspective or orthographic camera that orbits and frames the mesh, or has a position."""

    TEXTS = ORBITS

    azimuth: float = field(
        _Azimuths(**vars(AZIMUTHS)),
        0.0,
        "direction from the target to the camera: at azimuth 0 and elevation 0 the camera sees the "
        'face, at azimuth 90 the side at +x. Also a name: "front", "three-quarter" (-35) or '
        '"profile" (-90)',
    )
    elevation: float = field(
        ELEVATIONS, 0.0, "direction from the target to the camera; at 90 it looks down"
    )
    fov: float = field(Range(1.0, 150.0, "degrees"), 25.0, "vertical angle of view")
    zoom: float = field(
        Range(0.01, 1000.0),
        1.0,
        "magnification; at 1, the framed region fits into the image at every azimuth",
    )
    target: Vector | None = field(
        POSITIONS, None, "point at the centre of the image", unset="the centre of the framed region"
    )
    position: Vector | None = field(
        POSITIONS,
        None,
        "position of the camera; None to orbit the target. Excludes elevation and zoom, with a "
        "target also frame, and azimuth unless the camera looks straight up or down",
    )
    frame: RegionName = field(
        Choice(FRAMES),
        "auto",
        "region of the mesh that an orbiting camera frames",
        "auto is the head if a face is found on a clearly larger mesh, otherwise all. Without a "
        "face on the surface, names of parts and joints, or else the outline, define the head",
    )
    extrinsics: tuple[Row, Row, Row] | None = field(
        _Rows(4),
        None,
        "matrix [R|t], (3, 4), that maps mesh space to OpenCV's camera space: camera at 0, x to "
        "the right, y down, z forward, t in mesh units. Replaces azimuth, elevation, zoom, target, "
        "position and frame",
    )
    intrinsics: tuple[Vector, Vector, Vector] | None = field(
        _Rows(3),
        None,
        "matrix K, (3, 3), that maps camera space to pixels of an image of ``size``; replaces fov. "
        "The image's top left corner is (0, 0); its first pixel's centre is (0.5, 0.5). Add 0.5 to "
        "cx and cy if a calibration, such as OpenCV's, has that centre at (0, 0)",
    )
    size: tuple[int, int] | None = field(
        IMAGE_SIZES,
        None,
        "width and height of the image that intrinsics or view_height refer to; rendered images "
        "need the same aspect ratio",
    )
    distortion: tuple[float, ...] | None = field(
        _Distortion(-1e6, 1e6),
        None,
        "lens distortion of OpenCV's model, (k1, k2, p1, p2[, k3[, k4, k5, k6]]); needs "
        "intrinsics. It must be invertible in the whole image",
    )
    # Not part of the view: equal views have equal metadata.
    name: str = field(
        TEXT,
        "",
        "name of the view, which the files of several views may contain",
        repr=False,
        compare=False,
    )

    orthographic: bool = field(
        SWITCH,
        False,
        "parallel projection, which shows lengths across the view in one scale at every depth; "
        "excludes fov",
    )
    view_height: float | None = field(
        Range(1e-9, 1e9, "mesh units"),
        None,
        "height of the view of an orthographic camera; excludes zoom",
        unset="the framed region fits",
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            azimuth: float | str = ...,
            elevation: float = ...,
            fov: float = ...,
            zoom: float = ...,
            target: Vector | None = ...,
            position: Vector | None = ...,
            frame: RegionName = ...,
            extrinsics: Sequence[Sequence[float]] | Float | None = ...,
            intrinsics: Sequence[Sequence[float]] | Float | None = ...,
            size: int | tuple[int, int] | None = ...,
            distortion: Sequence[float] | Float | None = ...,
            name: str = ...,
            orthographic: bool = ...,
            view_height: float | None = ...,
        ) -> None: ...

    @classmethod
    def parse(cls, text: str, texts: str = ORBITS) -> dict[str, Any]:
        """Return the fields of an orbiting camera from ``AZIMUTH[,ELEVATION[,ZOOM]]``; AZIMUTH may
        be a name. Raises InputError, which lists the accepted ``texts``, for another text."""
        if text in AZIMUTHS_BY_NAME:
            return {"azimuth": AZIMUTHS_BY_NAME[text], "elevation": 0.0}
        if text in STANDARD_ANGLES:
            angles = zip(("azimuth", "elevation"), STANDARD_ANGLES[text], strict=True)
            return {**dict(angles), "orthographic": True, "frame": "head", "zoom": _STANDARD_ZOOM}
        azimuth, *words = text.split(",")
        numbers = vectors.numbers_in([str(AZIMUTHS_BY_NAME.get(azimuth, azimuth)), *words])
        if not 1 <= len(numbers) <= 3:
            raise InputError(f"unknown camera {quoted(text)}; give {texts}")
        return dict(zip(("azimuth", "elevation", "zoom"), numbers, strict=False))

    @classmethod
    def from_opencv(
        cls, K: ArrayLike, R: ArrayLike, t: ArrayLike, size: Size, **fields: Any
    ) -> Camera:
        """Return a camera of OpenCV's K and [R|t]; see ``intrinsics`` and ``extrinsics``.

        R : (3, 3), or a quaternion x, y, z, w. Transpose R and K for row vectors
        t : (3,) or (3, 1)
        fields : ``distortion`` and ``name``
        """
        k, shift = _numbers("camera K", K, (3, 3)), _numbers("camera t", t, (3,), (3, 1))
        pose = np.column_stack([_rotation("camera R", R, (3, 3), (4,)), shift])
        return cls(extrinsics=pose, intrinsics=k, size=size, **fields)

    @classmethod
    def from_view_matrix(
        cls,
        matrix: ArrayLike,
        projection: ArrayLike | None = None,
        size: Size | None = None,
        row_vectors: bool | None = None,
        **fields: Any,
    ) -> Camera:
        """Return a camera of OpenGL's matrices, such as pyrr's, for row or column vectors.

        matrix : (4, 4), from mesh space to camera space: x to the right, y up, z backwards
        projection : (4, 4), perspective, for images of ``size``. Its near and far are not used
        row_vectors : whether the matrices are for row vectors. None: they are if the last column is
            0, 0, 0, 1 (of the projection 0, 0, -1, 0), and are not if the last row is. If both are,
            because there is no translation, an asymmetric matrix needs True or False
        fields : ``fov``, ``distortion`` and ``name``
        """
        pose = _for_columns("camera matrix", matrix, _AFFINE, row_vectors)[:3] * _FLIP[:, None]
        return cls(extrinsics=pose, size=size, **_lens(projection, size, row_vectors), **fields)

    @classmethod
    def from_camera_to_world(
        cls,
        matrix: ArrayLike,
        position: ArrayLike | None = None,
        projection: ArrayLike | None = None,
        size: Size | None = None,
        row_vectors: bool | None = None,
        **fields: Any,
    ) -> Camera:
        """Return a camera of the inverse of a view matrix, as in glTF, Blender and NeRF.

        matrix : (4, 4); or, with the camera's position (3,), a quaternion x, y, z, w. For the other
            parameters see :meth:`from_view_matrix`
        """
        if position is None:
            pose = _for_columns("camera matrix", matrix, _AFFINE, row_vectors)
        else:
            center = _numbers("camera position", position, (3,))
            pose = np.column_stack([_rotation("camera matrix", matrix, (4,)), center])
        pose, lens = world_to_camera(pose), _lens(projection, size, row_vectors)
        return cls(extrinsics=pose, size=size, **lens, **fields)

    def __post_init__(self) -> None:
        if self.extrinsics is not None:
            rotation = np.array(self.extrinsics)[:, :3]
            off = np.abs(rotation @ rotation.T - np.eye(3)).max()
            if off > _NOT_ROTATED or np.linalg.det(rotation) < 0.0:
                axes = "whose rows are orthogonal unit vectors: x to the right, y down, z forward"
                form = f"[R|t] with a rotation R, {axes}"
                raise InputError(f"camera extrinsics = {quoted(self.extrinsics)}: give {form}")
            orbit = "azimuth", "elevation", "zoom", "target", "position", "frame"
            self._check_unused(orbit, "extrinsics")
        elif self.position is not None:
            # The azimuth counts if the camera looks straight up or down; view_of() checks that.
            framing = ("elevation", "zoom") + ("frame",) * (self.target is not None)
            self._check_unused(framing, "position")
        if self.view_height is not None:
            object.__setattr__(self, "orthographic", True)
            self._check_unused(("zoom",), "view_height")
        if self.orthographic:
            self._check_unused(("fov", "intrinsics"), "orthographic")
            if self.view_height is None and (self.position or self.extrinsics):
                placement = "position" if self.position else "extrinsics"
                raise InputError(f"camera orthographic and {placement} need view_height: give it")
        if (self.intrinsics is None) != (self.size is None) and not self.orthographic:
            raise InputError("camera intrinsics and camera size belong together: give both")
        if self.intrinsics is not None and self.size is not None:
            self._check_intrinsics(self.size)
        if self.distortion is not None:
            self._check_distortion(self.distortion)

    def _check_unused(self, names: Sequence[str], placement: str) -> None:
        for name in names:
            if (value := getattr(self, name)) != getattr(Camera, name):
                pair = f"camera {name} = {quoted(value)} and {placement}"
                raise InputError(f"{pair} exclude each other: leave one out")

    def _check_intrinsics(self, size: tuple[int, int]) -> None:
        if self.extrinsics is None:
            raise InputError("camera intrinsics need extrinsics: give [R|t] as well")
        self._check_unused(("fov",), "intrinsics")
        k, start = np.array(self.intrinsics), f"camera intrinsics = {quoted(self.intrinsics)}: give"
        focal, middle = k[[0, 1], [0, 1]] / size, k[:2, 2] / size
        if k[2].tolist() != [0.0, 0.0, 1.0] or k[0, 1] or k[1, 0]:
            raise InputError(f"{start} [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew")
        if not ((focal >= 1e-3) & (focal <= 1e4)).all() or np.abs(middle).max() > 1e3:
            bounds = "fx and fy from 0.001 to 10000 times and cx and cy up to 1000 times"
            raise InputError(f"{start} {bounds} the image size of {size[0]} x {size[1]} pixels")

    def _check_distortion(self, coefficients: Coefficients) -> None:
        if self.intrinsics is None or self.size is None:
            raise InputError("camera distortion needs intrinsics: give K, [R|t] and size as well")
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics
        across, down = (np.linspace(0.0, side, _CHECKED) for side in self.size)
        grid = np.stack(np.meshgrid((across - cx) / fx, (down - cy) / fy), axis=-1).reshape(-1, 2)
        lost = np.isnan(undistort(grid, coefficients)).any(axis=-1)
        if lost.any():
            nearest = float(np.hypot(*(grid[lost] * (fx, fy)).T).min())
            raise InputError(
                f"camera distortion = {quoted(coefficients)} is not invertible {nearest:.0f} "
                "pixels from the principal point, inside the image of "
                f"{self.size[0]} x {self.size[1]}: crop the image, or calibrate with points up to "
                "its corners"
            )


def world_to_camera(to_world: Float) -> Any:
    """Return OpenCV's [R|t] of a camera whose axes are OpenGL's: x right, y up, z backwards."""
    turn = (to_world[:3, :3] * _FLIP).T
    return np.column_stack([turn, -turn @ to_world[:3, 3]]).tolist()


def _lens(projection: Any, size: Any, row_vectors: bool | None) -> dict[str, Any]:
    """Return the intrinsics of OpenGL's perspective projection, by their field, if it is given."""
    if projection is None:
        return {}
    matrix = _for_columns("camera projection", projection, _PERSPECTIVE, row_vectors)
    if matrix[:2, 3].any():
        raise InputError(f"camera projection = {quoted(projection)}: give it without translation")
    half = np.divide(IMAGE_SIZES.check("camera size", size), 2.0)
    k = np.eye(3)
    k[:2, :2] = half[:, None] * matrix[:2, :2]
    k[:2, 2] = half * (1.0 + matrix[:2, 2] * (-1.0, 1.0))
    return {"intrinsics": k}


def _for_columns(name: str, value: Any, last: Row, row_vectors: bool | None) -> Float:
    """Return a matrix (4, 4) for column vectors, whose last row is ``last``."""
    matrix = _numbers(name, value, (4, 4))
    several = {False: [matrix], True: [matrix.T], None: [matrix, matrix.T]}[row_vectors]
    fits = [columns for columns in several if np.allclose(columns[3], last)]
    if not fits or not np.array_equal(fits[0], fits[-1]):
        remedy = "row_vectors=True or False" if fits else f"a last row (or last column) {last}"
        raise InputError(f"{name} = {quoted(value)}: give {remedy}")
    return fits[0]


def _rotation(name: str, value: Any, *shapes: tuple[int, ...]) -> Float:
    """Return a matrix (3, 3), or the one for column vectors of a quaternion x, y, z, w."""
    if (rotation := _numbers(name, value, *shapes)).ndim == 2:
        return rotation
    if abs(np.linalg.norm(rotation) - 1.0) > _NOT_ROTATED:
        raise InputError(f"{name} = {quoted(value)}: give a quaternion of length 1")
    return np.asarray(vectors.pyrr_rotations().create_from_quaternion(rotation, dtype=np.float64))


def _numbers(name: str, value: Any, *shapes: tuple[int, ...]) -> Float:
    """Return an array of one of the shapes as float64."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError):  # rows of different lengths, a tensor on a GPU
        array = np.empty(0)
    numeric = array.shape in shapes and array.dtype.kind in "fiu"
    if not (numeric and (np.abs(array) <= POSITIONS.high).all()):
        expected = " or ".join(f"{' rows of '.join(map(str, shape))} numbers" for shape in shapes)
        raise InputError(f"{name} = {quoted(value)}: give {expected}")
    return array.astype(np.float64)


def named(cameras: Iterable[Camera], stem: str) -> dict[str, Camera]:
    """Return cameras keyed by unique names; a missing or repeated name is replaced."""
    keyed: dict[str, Camera] = {}
    for number, camera in enumerate(cameras):
        key = camera.name or f"{stem}_{number:03d}"
        while key in keyed:
            key += f"_{number:03d}"
        keyed[key] = camera
    return keyed


# The standard views, which share one orthographic scale, by name.
STANDARD_VIEWS: Mapping[str, Camera] = {
    name: Camera(**Camera.parse(name), name=name) for name in STANDARD_ANGLES
}


def turntable(
    camera: Camera | str = Camera(), count: int = 8, arc: Sequence[float] | None = None
) -> tuple[Camera, ...]:
    """Return cameras at equal steps of azimuth around the mesh, at the given camera's elevation.

    The first camera has the azimuth of the given camera, which may be a name, as in
    :class:`Scene`. Its position, extrinsics, intrinsics and distortion are not used.

    arc : azimuths of the first and of the last camera, in degrees; None for a full turn, from the
        azimuth of the given camera

    Raises InputError unless count is a whole number in [1, 3600], and arc a pair of azimuths.
    """
    first, count = build(Camera, camera, "camera"), TURNS.check("count", count)
    start, span, steps = first.azimuth, 360.0, count
    if arc is not None:
        if not isinstance(arc, tuple | list) or len(arc) != 2:
            raise InputError(f"arc = {quoted(arc)}: give two azimuths, such as (-60, 60)")
        start, end = (AZIMUTHS.check("arc", azimuth) for azimuth in arc)
        span, steps = end - start, max(count - 1, 1)
    turns = (start + span * turn / steps for turn in range(count))
    return tuple(orbiting(first, azimuth=azimuth) for azimuth in turns)


def orbiting(camera: Camera, **orbit: Any) -> Camera:
    """Return the camera without position, extrinsics, intrinsics and distortion, so that it orbits
    its target, and with the fields ``orbit``, such as azimuth or zoom."""
    orbit |= dict.fromkeys(("position", "extrinsics", "intrinsics", "size", "distortion"))
    return replace(camera, **orbit)
