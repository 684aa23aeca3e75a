"""The result of comparing two images: metrics, their limits, and the reasons of a difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from html import escape
from typing import Any

from facerender.comparison.sources import HIGHEST
from facerender.comparison.windows import MOVED
from facerender.errors import check_range
from facerender.images.image import DRIVER_KEYS, Encoding

FOREIGN = 6.0  # factor on the limits of trend, grain and texture if another driver drew image B
SURE = 6.0  # a trend counts if it exceeds this number of standard errors
BLUR = 1.5  # factor on the limits of grain and texture if B has less of these than A
# At most _SLIGHT + _SLIGHT_FRACTION * (number of pixels) pixels may be slivers.
_SLIGHT = 50
_SLIGHT_FRACTION = 1e-4
HOLES = 2  # largest number of holes that passes, since cracks and hairs cause some
_MAX_CHANGES = 3  # of the metadata in a text


@dataclass(frozen=True)
class Limits:
    """Largest differences between two images that still count as the same. :data:`CHECKS` has the
    quantities, and the units for linear and for 8-bit sRGB images."""

    point: float
    block: float  # without the effect of a shift; a fraction of the mean, or of 0.01 if larger
    # A wider block limit reduces the measured trend, so the trend check passes more blocks too.
    trend: float = 0.15
    grain: float = 9e-4  # of an increase; BLUR widens it for a decrease
    texture: float = 0.01  # as grain
    coverage: float = 0.005
    shift: float = MOVED

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(f"limit {name}", value, 0.0, HIGHEST)


NAMES = tuple(limit.name for limit in fields(Limits))
LIMITS: dict[Encoding, Limits] = {
    "linear": Limits(0.005, 5e-3),
    "srgb8": Limits(3.0, 1.0, grain=0.35),
}


@dataclass(frozen=True)
class Comparison:
    """Metrics of two images, and the reasons of a difference. ``bool(comparison)`` is
    ``comparison.same``. Positions are (x, y) from the top left."""

    reasons: tuple[str, ...]  # as text that starts with the name of the failed check
    encoding: Encoding  # determines the units, see :class:`Limits`
    size: tuple[int, int]
    limits: Limits
    # Whether another driver drew the image, or may have drawn it. Drivers filter 8-bit textures
    # differently, so the limits of trend, grain and texture are then wider.
    foreign: bool
    # Unexplained difference of the worst pixel, negative if the image is darker; reduced by the
    # effect of a sliver if no pixel exceeds the limit.
    point: float
    point_at: tuple[int, int]
    points: int  # number of pixels that exceed the point limit by more than a sliver may cause
    slight: int  # number of all pixels that exceed the point limit, including slivers
    holes: int  # number of pixels, see :data:`CHECKS`
    block: float  # change of the worst block's mean
    block_at: tuple[int, int]  # top left pixel of the worst block
    blocks: int  # number of blocks over the block limit
    blocks_judged: int  # number of all blocks with enough pixels
    trend: float  # of the blocks' changes
    z_score: float  # the trend divided by its standard error
    grain: float  # RMS of differences between adjacent pixels in flat areas, image minus reference
    texture: float  # variance between adjacent pixels, image minus reference, divided by their sum
    # Brightness that the changed blocks gained, weighted towards smooth areas. Linear: fraction of
    # the reference; sRGB: 8-bit levels.
    gain: float
    shift: tuple[float, float]  # displacement of the image to the right and down, in pixels
    coverage: float  # fraction of the pixels whose coverage changed; 0 without an alpha channel
    largest: float  # absolute difference of any channel, for information only, as is the mean
    mean: float
    largest_at: tuple[int, int] = (0, 0)
    cause: str = ""  # the likely cause; "metadata" if the scene's metadata changed
    # Reference's and image's text of all metadata that changed, keyed by name.
    metadata: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    # The two images, which stay in memory as long as the result: notebooks display them.
    images: Sequence[Any] = field(default=(), repr=False, compare=False)

    @property
    def same(self) -> bool:
        """Whether every check passed."""
        return not self.reasons

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the checks that the reasons report."""
        return tuple(reason.split()[0].rstrip(":") for reason in self.reasons)

    @property
    def scene_changed(self) -> bool:
        """Whether metadata of the scene or of the settings changed."""
        return not self.metadata.keys() <= {*DRIVER_KEYS}

    @property
    def metadata_text(self) -> str:
        """The changed metadata as text, without the driver's if the scene's changed; "" if none."""
        omitted = DRIVER_KEYS if self.scene_changed else ()
        pairs = ((key, pair) for key, pair in self.metadata.items() if key not in omitted)
        changed = [f"{key} {' -> '.join(pair)}" for key, pair in pairs]
        if len(changed) > _MAX_CHANGES:
            changed[_MAX_CHANGES:] = [f"{len(changed) - _MAX_CHANGES} more"]
        return f" (metadata: {', '.join(changed)})" if changed else ""

    @property
    def limit_factor(self) -> float:
        """Factor on the limits of trend, grain and texture."""
        return FOREIGN if self.foreign else 1.0

    @property
    def sliver_limit(self) -> float:
        """Number of pixels that may be slivers."""
        width, height = self.size
        return _SLIGHT + _SLIGHT_FRACTION * width * height

    @property
    def changed_alike(self) -> bool:
        """Whether the trend exceeds its limit and is significant."""
        return self.trend > self.limit_factor * self.limits.trend and self.z_score > SURE

    def __bool__(self) -> bool:
        return self.same

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics, for JSON."""
        omitted = ("limits", "images")
        metrics = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in omitted}
        limits = {"limits": asdict(self.limits), "limit_factor": self.limit_factor}
        return {"same": self.same, "failed": self.failed, **metrics, **limits}

    def _repr_html_(self) -> str:
        """Return the verdict, and A, B and their difference, which notebooks display."""
        from facerender.comparison.pictures import MAX_PIXELS, side_by_side
        from facerender.page import image_source

        verdict = "" if self.same else "<b>differs</b>: "
        text = f"<p>{verdict}{escape(str(self))}</p>"
        if not self.images or self.size[0] * self.size[1] > MAX_PIXELS:
            return text
        image = image_source(side_by_side(*self.images).encoded(), "png")
        return f'{text}<img src="{image}" alt="A, B and their difference">'

    def __str__(self) -> str:
        foreign = ", with wider limits for another driver" * (self.foreign and self.largest > 0.0)
        unjudged = "" if self.blocks_judged else ", but no block has enough pixels to be checked"
        metadata = self.metadata_text * self.scene_changed
        return "; ".join(self.reasons) or f"same{foreign}{unjudged}{metadata}"
