"""Cameras that orbit the mesh or have a given position, and their lens distortion.

Angles are in degrees, lengths in mesh units. The distortion is OpenCV's model in float64. Its
points are normalised camera coordinates: x / z and y / z in OpenCV's camera space. Coefficients are
(k1, k2, p1, p2[, k3[, k4, k5, k6]]); left-out ones are 0. No image and no OpenGL here. Source:
OpenCV 4, "Camera Calibration and 3D Reconstruction"."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_type, short_repr, shown
from facerender.values.ranges import IntegerRange, Range, SizeRange, check_fields, ranged
from facerender.values.vectors import (
    AZIMUTHS,
    ELEVATIONS,
    POSITIONS,
    Vector,
    numbers_in,
    pyrr_rotations,
)

Float = NDArray[np.float64]
Coefficients = tuple[float, ...]

_STEPS = 20  # Newton's steps; 4 suffice unless the distortion nearly folds
_PRECISE = 1e-12  # largest residual of a solution, relative to 1 + the length of the point
_TABLE = 1024  # entries of the table of radii that Newton's method starts from


def distort(points: Float, coefficients: Coefficients) -> Float:
    """Return distorted points (N, 2); NaN at and beyond the fold, where several points would have
    the same distorted point."""
    with np.errstate(all="ignore"):
        distorted, slopes = _distorted(points, coefficients)
        square = np.einsum("ni,ni->n", points, points)
    distorted[~((_determinant(slopes) > 0.0) & (square < fold(coefficients) ** 2))] = np.nan
    return distorted


def jacobian(points: Float, coefficients: Coefficients) -> Float:
    """Return the derivatives (N, 2, 2) of distorted points by undistorted points (N, 2)."""
    return _distorted(points, coefficients)[1]


def undistort(points: Float, coefficients: Coefficients) -> Float:
    """Return the points (N, 2) whose distorted points are given; NaN if there are none.

    The residual is at most 1e-12, relative to 1 + the length of the point.
    """
    if not len(points):
        return points
    with np.errstate(all="ignore"):
        radii = np.hypot(*points.T)
        table = _radii(coefficients, float(radii.max()))
        start = np.interp(radii, _radial(table, coefficients), table)
        solution = points * np.where(radii > 0.0, start / radii, 1.0)[:, None]
        for _ in range(_STEPS):
            distorted, slopes = _distorted(solution, coefficients)
            residual = distorted - points
            (x, y), ((a, b), (c, d)) = residual.T, np.moveaxis(slopes, 0, -1)
            steps = np.stack([d * x - b * y, a * y - c * x], axis=-1)
            solution = solution - steps / _determinant(slopes)[:, None]
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


def _radii(coefficients: Coefficients, largest: float) -> Float:
    """Return increasing radii up to one whose distorted radius is `largest`, but below the fold."""
    limit, end = fold(coefficients), max(largest, 1e-9)
    while end < limit and _radial(np.array(end), coefficients) < largest:
        end *= 2.0
    return np.linspace(0.0, min(end, limit), _TABLE, endpoint=end < limit)


def _distorted(points: Float, coefficients: Coefficients) -> tuple[Float, Float]:
    """Return distorted points (N, 2) and their derivatives by the given points, (N, 2, 2)."""
    _, _, p1, p2, *_ = coefficients
    upper, lower = _polynomials(coefficients)
    x, y = points.T
    square = x * x + y * y
    above, below = upper(square), lower(square)
    factor = above / below
    # Derivative of the factor by r^2, doubled.
    change = 2.0 * (upper.deriv()(square) - factor * lower.deriv()(square)) / below
    distorted = np.empty((len(points), 2))
    distorted[:, 0] = x * factor + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    distorted[:, 1] = y * factor + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    slopes = np.empty((len(points), 2, 2))
    slopes[:, 0, 0] = factor + x * x * change + 2.0 * p1 * y + 6.0 * p2 * x
    slopes[:, 0, 1] = slopes[:, 1, 0] = x * y * change + 2.0 * (p1 * x + p2 * y)
    slopes[:, 1, 1] = factor + y * y * change + 6.0 * p1 * y + 2.0 * p2 * x
    return distorted, slopes


def _determinant(slopes: Float) -> Float:
    return np.asarray(slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0])


Frame = Literal["auto", "all", "head", "face", "eyes"]
Pose = tuple[float, float, float, float]
Matrix = NDArray[np.float64]
Size = int | tuple[int, int]

FRAMES: tuple[Frame, ...] = get_args(Frame)
AZIMUTHS_BY_NAME = {"front": 0.0, "three-quarter": -35.0, "profile": 90.0}
# Texts that parse_camera accepts, for messages and help.
ORBITS = f"{', '.join(AZIMUTHS_BY_NAME)}, or AZIMUTH[,ELEVATION[,ZOOM]] in degrees"
CAMERA_FILES = (".toml", ".json", ".npz")
MOST_CAMERAS = 100_000
TURNS = IntegerRange(1, 3600)  # views of a turntable: steps of at least 0.1 degrees
DISTORTIONS = (4, 5, 8)  # possible numbers of distortion coefficients
_COEFFICIENTS, _ZERO = Range(-1e6, 1e6), Range(0.0, 0.0)
_CHECKED = 33  # points per side of the grid on which the distortion is checked
_NOT_ROTATED = 1e-3  # largest accepted element of |R R^T - I|; not 0, because users may round R
# Fields that must keep their defaults if extrinsics, or a position, are given. A camera with a
# position uses its azimuth only if it looks straight up or down; view_of() checks that.
_PLACED = ("azimuth", "elevation", "zoom", "target", "position", "frame")
_ORBITING = ("elevation", "zoom")
_SIZES = SizeRange(1, 1 << 30, "pixels")
# Last rows of matrices for column vectors, and last columns of matrices for row vectors.
_AFFINE, _PERSPECTIVE = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, -1.0, 0.0)
_FLIP = np.array([1.0, -1.0, -1.0])  # between the axes of OpenGL's and OpenCV's camera spaces


@dataclass(frozen=True)
class Camera:
    """A perspective camera that orbits and frames the mesh, or has a given position.

    Parameters
    ----------
    azimuth, elevation : direction from the target to the camera, in degrees. At azimuth 0 and
        elevation 0 the camera sees the face; at azimuth 90 it sees the side at +x. The azimuth may
        be a name: "front", "three-quarter" (-35) or "profile" (90)
    fov : vertical field of view, degrees in [1, 150]
    zoom : magnification; at 1, the framed region fits into the image at every azimuth
    target : point at the centre of the image; None for the centre of the framed region
    position : position of the camera; None to orbit the target. Excludes elevation and zoom, with a
        target also frame, and azimuth unless the camera looks straight up or down
    frame : region to frame: "all" (the whole mesh), "head", "face" (from hairline to chin) or
        "auto": the head if the mesh is clearly larger than the head that is found in it, otherwise
        the whole mesh; see ``facerender.mesh.framing``
    extrinsics : matrix [R|t], (3, 4), that maps mesh space to OpenCV's camera space: camera at 0, x
        to the right, y down, z forward, t in mesh units. Replaces azimuth, elevation, zoom, target,
        position and frame
    intrinsics : matrix K, (3, 3), that maps camera space to pixels of an image of ``size``;
        replaces fov. The image's top left corner is (0, 0); its first pixel's centre is (0.5, 0.5).
        Add 0.5 to cx and cy if a calibration, such as OpenCV's, has that centre at (0, 0)
    size : width and height of the image that intrinsics refer to; rendered images need the same
        aspect ratio
    distortion : lens distortion of OpenCV's model, (k1, k2, p1, p2[, k3[, k4, k5, k6]]), each in
        [-1e6, 1e6]; needs intrinsics. None (default) or only zeros: no distortion. The distortion
        must be invertible in the whole image
    name : name of the view, which the files of several views may contain; default ""
    """

    azimuth: float = ranged(AZIMUTHS, 0.0)
    elevation: float = ranged(ELEVATIONS, 0.0)
    fov: float = ranged(Range(1.0, 150.0, "degrees"), 25.0)
    zoom: float = ranged(Range(0.01, 1000.0), 1.0)
    target: Vector | None = ranged(POSITIONS, None)
    position: Vector | None = ranged(POSITIONS, None)
    frame: Frame = "auto"
    extrinsics: tuple[Pose, Pose, Pose] | None = None
    intrinsics: tuple[Vector, Vector, Vector] | None = None
    size: tuple[int, int] | None = ranged(_SIZES, None)
    distortion: tuple[float, ...] | None = None
    # Not part of the view: equal views have equal metadata.
    name: str = field(default="", repr=False, compare=False)

    __repr__ = short_repr

    if TYPE_CHECKING:

        def __init__(
            self,
            azimuth: float | str = ...,
            elevation: float = ...,
            fov: float = ...,
            zoom: float = ...,
            target: Vector | None = ...,
            position: Vector | None = ...,
            frame: Frame = ...,
            extrinsics: Sequence[Sequence[float]] | Matrix | None = ...,
            intrinsics: Sequence[Sequence[float]] | Matrix | None = ...,
            size: int | tuple[int, int] | None = ...,
            distortion: Sequence[float] | Matrix | None = ...,
            name: str = ...,
        ) -> None: ...

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
            place = _numbers("camera position", position, (3,))
            pose = np.column_stack([_rotation("camera matrix", matrix, (4,)), place])
        pose, lens = world_to_camera(pose), _lens(projection, size, row_vectors)
        return cls(extrinsics=pose, size=size, **lens, **fields)

    def __post_init__(self) -> None:
        azimuth: Any = self.azimuth
        if isinstance(azimuth, str):
            if azimuth not in AZIMUTHS_BY_NAME:
                bounds = f"[{AZIMUTHS.low:g}, {AZIMUTHS.high:g}]"
                remedy = f"give a number in {bounds}, or {', '.join(AZIMUTHS_BY_NAME)}"
                raise InputError(f"camera azimuth = {shown(azimuth)} is not a number: {remedy}")
            object.__setattr__(self, "azimuth", AZIMUTHS_BY_NAME[azimuth])
        check_fields(self, "camera ")
        check_type("camera name", self.name, str, "text")
        for name in ("azimuth", "elevation", "fov", "zoom"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if not (isinstance(self.frame, str) and self.frame in FRAMES):
            raise InputError(f"camera frame = {shown(self.frame)}: give {', '.join(FRAMES)}")
        for name, columns in (("extrinsics", 4), ("intrinsics", 3)):
            if (matrix := getattr(self, name)) is not None:
                rows = _numbers(f"camera {name}", matrix, (3, columns)).tolist()
                object.__setattr__(self, name, tuple(map(tuple, rows)))
        if self.extrinsics is not None:
            self._check_extrinsics()
        elif self.position is not None:
            unused = _ORBITING if self.target is None else (*_ORBITING, "frame")
            self._check_unused(unused, "position")
        if (self.intrinsics is None) != (self.size is None):
            raise InputError("camera intrinsics and camera size belong together: give both")
        if self.intrinsics is not None:
            self._check_intrinsics()
        if self.distortion is not None:
            self._check_distortion()

    def _check_extrinsics(self) -> None:
        turn = np.array(self.extrinsics)[:, :3]
        off = np.abs(turn @ turn.T - np.eye(3)).max()
        if off > _NOT_ROTATED or np.linalg.det(turn) < 0.0:
            raise InputError(
                f"camera extrinsics = {shown(self.extrinsics)}: give [R|t] with a rotation R, "
                "whose rows are orthogonal unit vectors: x to the right, y down, z forward"
            )
        self._check_unused(_PLACED, "extrinsics")

    def _check_unused(self, names: Sequence[str], placement: str) -> None:
        for name in names:
            if (value := getattr(self, name)) != getattr(Camera, name):
                pair = f"camera {name} = {shown(value)} and {placement}"
                raise InputError(f"{pair} exclude each other: leave one out")

    def _check_intrinsics(self) -> None:
        if self.extrinsics is None:
            raise InputError("camera intrinsics need extrinsics: give [R|t] as well")
        self._check_unused(("fov",), "intrinsics")
        assert self.size is not None
        width, height = self.size
        k = np.array(self.intrinsics)
        focal, middle = k[[0, 1], [0, 1]] / (width, height), k[:2, 2] / (width, height)
        if k[2].tolist() != [0.0, 0.0, 1.0] or k[0, 1] or k[1, 0]:
            raise InputError(
                f"camera intrinsics = {shown(self.intrinsics)}: give [[fx, 0, cx], [0, fy, cy], "
                "[0, 0, 1]], without skew"
            )
        if not ((focal >= 1e-3) & (focal <= 1e4)).all() or np.abs(middle).max() > 1e3:
            raise InputError(
                f"camera intrinsics = {shown(self.intrinsics)}: give fx and fy from 0.001 to 10000 "
                f"times and cx and cy up to 1000 times the image size of {width} x {height} pixels"
            )

    def _check_distortion(self) -> None:
        distortion: Any = self.distortion
        values = distortion.ravel().tolist() if isinstance(distortion, np.ndarray) else distortion
        numbers = [*values] if isinstance(values, tuple | list) else []
        while len(numbers) > max(DISTORTIONS) and numbers[-1] in _ZERO:
            numbers.pop()  # OpenCV appends zeros for thin prism and tilt
        if len(numbers) not in DISTORTIONS:
            raise InputError(
                f"camera distortion = {shown(distortion)}: give 4, 5 or 8 numbers, k1, k2, p1, p2, "
                "k3 to k6, without thin prism and tilt"
            )
        if not all(number in _COEFFICIENTS for number in numbers):
            raise InputError(
                f"camera distortion = {shown(distortion)}: give numbers in [{_COEFFICIENTS.low:g}, "
                f"{_COEFFICIENTS.high:g}]"
            )
        if self.intrinsics is None or self.size is None:
            raise InputError("camera distortion needs intrinsics: give K, [R|t] and size as well")
        coefficients = tuple(map(float, numbers))
        object.__setattr__(self, "distortion", coefficients if any(numbers) else None)
        if self.distortion is None:
            return
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics
        across, down = (np.linspace(0.0, side, _CHECKED) for side in self.size)
        grid = np.stack(np.meshgrid((across - cx) / fx, (down - cy) / fy), axis=-1).reshape(-1, 2)
        lost = np.isnan(undistort(grid, coefficients)).any(axis=-1)
        if lost.any():
            nearest = float(np.hypot(*(grid[lost] * (fx, fy)).T).min())
            raise InputError(
                f"camera distortion = {shown(coefficients)} is not invertible {nearest:.0f} "
                "pixels from the principal point, inside the image of "
                f"{self.size[0]} x {self.size[1]}: crop the image, or calibrate with points up "
                "to its corners"
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
        raise InputError(f"camera projection = {shown(projection)}: give it without translation")
    half = np.divide(_SIZES.check("camera size", size), 2.0)
    k = np.eye(3)
    k[:2, :2] = half[:, None] * matrix[:2, :2]
    k[:2, 2] = half * (1.0 + matrix[:2, 2] * (-1.0, 1.0))
    return {"intrinsics": k}


def _for_columns(name: str, value: Any, last: Pose, row_vectors: bool | None) -> Float:
    """Return a matrix (4, 4) for column vectors, whose last row is ``last``."""
    check_type("row_vectors", row_vectors, bool | None, "true or false")
    matrix = _numbers(name, value, (4, 4))
    several = {False: [matrix], True: [matrix.T], None: [matrix, matrix.T]}[row_vectors]
    fits = [columns for columns in several if np.allclose(columns[3], last)]
    if not fits or not np.array_equal(fits[0], fits[-1]):
        remedy = "row_vectors=True or False" if fits else f"a last row (or last column) {last}"
        raise InputError(f"{name} = {shown(value)}: give {remedy}")
    return fits[0]


def _rotation(name: str, value: Any, *shapes: tuple[int, ...]) -> Float:
    """Return a matrix (3, 3), or the one for column vectors of a quaternion x, y, z, w."""
    if (rotation := _numbers(name, value, *shapes)).ndim == 2:
        return rotation
    if abs(np.linalg.norm(rotation) - 1.0) > _NOT_ROTATED:
        raise InputError(f"{name} = {shown(value)}: give a quaternion of length 1")
    return np.asarray(pyrr_rotations().create_from_quaternion(rotation, dtype=np.float64))


def _numbers(name: str, value: Any, *shapes: tuple[int, ...]) -> Float:
    """Return an array of one of the shapes as float64."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError):  # rows of different lengths, a tensor on a GPU
        array = np.empty(0)
    numeric = array.shape in shapes and array.dtype.kind in "fiu"
    if not (numeric and (np.abs(array) <= POSITIONS.high).all()):
        expected = " or ".join(f"{' rows of '.join(map(str, shape))} numbers" for shape in shapes)
        raise InputError(f"{name} = {shown(value)}: give {expected}")
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


def orbit_of(text: str, known: str = ORBITS) -> dict[str, float]:
    """Parse a name of AZIMUTHS_BY_NAME, or ``AZIMUTH[,ELEVATION[,ZOOM]]``, where AZIMUTH may be
    such a name. Return the fields of an orbiting :class:`Camera`. Raises InputError, with the text
    ``known`` of the accepted values, if the name is unknown, or the text has another form."""
    if text in AZIMUTHS_BY_NAME:
        return {"azimuth": AZIMUTHS_BY_NAME[text], "elevation": 0.0}
    azimuth, *words = text.split(",")
    numbers = numbers_in([str(AZIMUTHS_BY_NAME.get(azimuth, azimuth)), *words])
    if not 1 <= len(numbers) <= 3:
        raise InputError(f"unknown camera {shown(text)}; give {known}")
    return dict(zip(("azimuth", "elevation", "zoom"), numbers, strict=False))


def camera_of(camera: Camera | str) -> Camera:
    """Return a camera, which may be a text that :func:`orbit_of` parses."""
    if isinstance(camera, str):
        return orbiting(Camera(), **orbit_of(camera))
    check_type("camera", camera, Camera, f"a facerender.Camera, or {ORBITS}")
    return camera


def cameras_of(cameras: Any) -> tuple[Camera, ...]:
    """Return several cameras or one, each given as in :func:`camera_of`."""
    several = [cameras] if isinstance(cameras, str | Camera) else cameras
    if isinstance(several, Iterable):
        return tuple(map(camera_of, several))
    raise InputError(f"cameras = {shown(cameras)}: give several facerender.Camera, or {ORBITS}")


def turntable(camera: Camera | str = Camera(), count: int = 8) -> tuple[Camera, ...]:
    """Return cameras at equal steps of azimuth around the mesh, at the given camera's elevation.

    The first camera has the azimuth of the given camera, which may be a name, as in
    :class:`Scene`. Its position, extrinsics, intrinsics and distortion are not used.

    Raises
    ------
    InputError : camera is not a Camera, or count is not a whole number in [1, 3600]
    """
    camera = camera_of(camera)
    count = TURNS.check("count", count)
    turns = (camera.azimuth + 360.0 * turn / count for turn in range(count))
    return tuple(orbiting(camera, azimuth=azimuth) for azimuth in turns)


def orbiting(camera: Camera, **orbit: Any) -> Camera:
    """Return the camera without position, extrinsics, intrinsics and distortion, so that it orbits
    its target, and with the fields ``orbit``, such as azimuth or zoom."""
    names = ("position", "extrinsics", "intrinsics", "size", "distortion")
    placed: dict[str, Any] = dict.fromkeys(names)
    return replace(camera, **placed, **orbit)
