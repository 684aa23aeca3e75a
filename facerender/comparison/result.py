"""The result of comparing two images: every metric, the limits that it is checked against, and why
the images differ."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from facerender.comparison.blocks import MOVED
from facerender.errors import check_range
from facerender.images.image import Encoding

HIGHEST = 1e30  # of values, whose differences and sums are finite then
FOREIGN = 6.0  # factor of the limits of trend, grain and texture, where another driver drew B
SURE = 6.0  # standard errors of its own that a trend needs
BLUR = 1.5  # factor of the limits of grain and texture where the image has less than the reference
_SLIGHT = 50  # pixels that may be slivers, and
_SLIGHT_FRACTION = 1e-4  # of all pixels


@dataclass(frozen=True)
class Limits:
    """What two images that count as the same may differ by.

    Attributes
    ----------
    point : excess of a pixel beyond what its neighbourhood explains; radiance, or steps of 8 bits
    block : change of a block's mean, less what a shift explains; relative to that mean, 0.01 at
        least, or steps
    trend : mean product of neighbouring blocks' changes, each over its standard error; without a
        change it is 0. A looser limit for blocks makes it smaller, so that it passes likewise
    grain : RMS from one pixel to the next that the image may have more than the reference, and half
        of what it may have less; relative to the level, or steps
    texture : fraction of the variance from one pixel to the next that was added or lost, in [0, 1]
    coverage : fraction of all pixels whose coverage changed, in [0, 1]
    shift : pixels by which the whole image may be displaced
    """

    point: float
    block: float
    trend: float = 0.15
    grain: float = 9e-4
    texture: float = 0.01
    coverage: float = 0.005
    shift: float = MOVED

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(f"limit {name}", value, 0.0, HIGHEST)


LIMITS: dict[Encoding, Limits] = {
    "linear": Limits(0.005, 5e-3),
    "srgb8": Limits(3.0, 1.0, grain=0.35),
}


@dataclass(frozen=True)
class Comparison:
    """Every metric, and why the images differ. Positions are (x, y) from the top left.
    ``bool(comparison)`` is ``comparison.same``.

    Attributes
    ----------
    reasons : why the images differ, in words; empty where they are the same
    encoding : "linear" or "srgb8"; it gives the unit of point and block, as in :class:`Limits`
    limits : that the metrics are checked against
    foreign : whether another driver drew the image, by the files' metadata: it may filter 8-bit
        textures differently, so that trend and grain say less
    point, point_at : excess of the worst pixel, negative where the image is darker, and where;
        without pixels over the limit, less what may be a sliver
    points : pixels over the limit, by more than a sliver at an edge
    slight : pixels over the limit, all of them
    holes : pixels with less than a quarter of their neighbours' light in the other image
    block, block_at : change of the worst block's mean, and its top left pixel
    blocks, blocks_judged : blocks over the limit, and all that have enough pixels
    trend, z_score : of the blocks' changes, and the trend over its standard error
    grain : RMS from one pixel to the next that the image has more, or less, than the reference,
        where they are flat
    texture : the same of variances, where they need not be, as a fraction of both
    gain : by how much blocks that changed are brighter, mostly where they are smooth: relative, or
        steps
    shift : pixels by which the image lies to the right of the reference, and below it
    coverage : fraction of the pixels whose coverage changed; 0 without an alpha channel
    largest, mean : largest and mean absolute difference of any channel, for information
    """

    reasons: tuple[str, ...]
    encoding: Encoding
    size: tuple[int, int]
    limits: Limits
    foreign: bool
    point: float
    point_at: tuple[int, int]
    points: int
    slight: int
    holes: int
    block: float
    block_at: tuple[int, int]
    blocks: int
    blocks_judged: int
    trend: float
    z_score: float
    grain: float
    texture: float
    gain: float
    shift: tuple[float, float]
    coverage: float
    largest: float
    mean: float

    @property
    def same(self) -> bool:
        """Whether every check passed."""
        return not self.reasons

    @property
    def limit_factor(self) -> float:
        """By what the limits of trend, grain and texture are multiplied."""
        return FOREIGN if self.foreign else 1.0

    @property
    def sliver_limit(self) -> float:
        """How many pixels may be slivers."""
        width, height = self.size
        return _SLIGHT + _SLIGHT_FRACTION * width * height

    @property
    def changed_alike(self) -> bool:
        """Whether the trend is over its limit, and no chance."""
        return self.trend > self.limit_factor * self.limits.trend and self.z_score > SURE

    def __bool__(self) -> bool:
        return self.same

    def as_dict(self) -> dict[str, Any]:
        """Return every metric, for JSON."""
        return {"same": self.same, **asdict(self)}

    def __str__(self) -> str:
        foreign = ", as far as another driver tells" * self.foreign
        unjudged = "" if self.blocks_judged else ", but no block could be judged"
        return "; ".join(self.reasons) or f"same{foreign}{unjudged}"
