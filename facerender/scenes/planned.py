"""For which images the shading of a scene was planned, and how finely they are drawn then: what a
scene file says of that."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import index

from facerender.errors import InputError, shown
from facerender.images.decode import MAX_SIDE
from facerender.scenes.lod import simplified
from facerender.scenes.scene import Scene

_SAME_SHAPE = 1.01  # width over height, of rounded sizes


@dataclass(frozen=True)
class LevelOfDetail:
    """How finely a frame is drawn.

    Attributes
    ----------
    samples : per pixel
    triangles : of the mesh, at most; None for all
    backs : whether backs of triangles are drawn
    once : whether one triangle of a pixel is shaded, see :meth:`facerender.Renderer.render`
    """

    samples: int
    triangles: int | None
    backs: bool = True
    once: bool = False

    def of(self, scene: Scene) -> Scene:
        """Return a scene whose mesh has no more triangles; errors as of :func:`simplified`."""
        if self.triangles is None:
            return scene
        return replace(scene, mesh=simplified(scene.mesh, self.triangles))


@dataclass(frozen=True)
class Planned:
    """The images at which the error of a shading was measured.

    Parameters
    ----------
    sizes : width and height of each, in pixels
    samples : of each pixel
    drawn_samples, triangles : with how many samples and at most how many triangles the frame is
        drawn that stands for such an image; None for all
    backs : whether that has backs of triangles
    once : whether one triangle of its pixels is shaded

    Raises
    ------
    InputError : no such sizes or samples
    """

    sizes: tuple[tuple[int, int], ...]
    samples: int
    drawn_samples: int | None = None
    triangles: int | None = None
    backs: bool = True
    once: bool = False

    def __post_init__(self) -> None:
        try:
            sizes = tuple((index(width), index(height)) for width, height in self.sizes)
            numbers = [index(self.samples), *(number for size in sizes for number in size)]
        except (TypeError, ValueError):
            numbers = []
        if len(numbers) < 3 or not 1 <= min(numbers) <= max(numbers) <= MAX_SIDE:
            raise InputError(
                f"planned sizes = {shown(self.sizes)}, samples = {shown(self.samples)}: give "
                f"widths and heights up to {MAX_SIDE}, such as [[512, 512], [1024, 1024]], and a "
                "number"
            )
        for name in ("drawn_samples", "triangles"):
            value = getattr(self, name)
            if value is not None and (type(value) is not int or not 1 <= value < 2**63):
                raise InputError(
                    f"planned {name} = {shown(value)}: give a whole number of at least 1"
                )
        for name in ("backs", "once"):
            if not isinstance(value := getattr(self, name), bool):
                raise InputError(f"planned {name} = {shown(value)}: give true or false")
        object.__setattr__(self, "sizes", sizes)

    def holds(self, size: tuple[int, int], samples: int) -> bool:
        """Tell whether an image is of the planned samples, and neither smaller nor larger nor of
        another shape than the planned ones. One sample is, with all triangles and
        their backs: it is the pixel's centre, where every plan is measured."""
        centres = self.triangles is None and self.backs
        widths, heights = zip(*self.sizes, strict=True)
        shapes = [width / height for width, height in self.sizes]
        return (
            samples in (self.samples, 1 if centres else self.samples)
            and min(widths) <= size[0] <= max(widths)
            and min(heights) <= size[1] <= max(heights)
            and min(shapes) / _SAME_SHAPE <= size[0] / size[1] <= max(shapes) * _SAME_SHAPE
        )

    @property
    def detail(self) -> LevelOfDetail:
        """How finely the frame is drawn that stands for a planned one."""
        samples = self.drawn_samples or self.samples
        return LevelOfDetail(samples, self.triangles, self.backs, self.once)

    def __str__(self) -> str:
        ends = dict.fromkeys((min(self.sizes), max(self.sizes)))
        sizes = " to ".join(f"{width} x {height}" for width, height in ends)
        return f"{sizes} pixels with {self.samples} sample{'s' if self.samples > 1 else ''}"
