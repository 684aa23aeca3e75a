"""Goldens (reference images of tests): the fixture ``facerender_snapshot`` compares an image with
its golden, and writes the golden if the options of facerender/pytest_plugin.py allow it."""

from __future__ import annotations

import json
import os
import re
import shlex
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from numpy.typing import NDArray

from facerender import __version__
from facerender.comparison.compare import Driver, Pair, compare
from facerender.comparison.result import NAMES
from facerender.comparison.sources import Comparable, as_image
from facerender.errors import InputError, reason
from facerender.images.files import save_exr
from facerender.images.image import ImageData

_ROUNDED = 0.2  # largest rounding error of a golden, as a part of the point limit
LONGEST = 180  # characters of a file name; most systems allow 255 bytes
UNKNOWN = "an unknown renderer"

_WRITTEN = pytest.StashKey[set[Path]]()  # goldens written in this session
_OWNERS = pytest.StashKey[dict[str, str]]()  # ids of the tests that own goldens, keyed by path


@dataclass(eq=False, repr=False)
class Snapshot:
    """Value of the fixture ``facerender_snapshot``; it compares images with their goldens."""

    _request: pytest.FixtureRequest
    _settings: Mapping[str, Any]  # options update, update_missing, force, report and driver
    _limits: Mapping[str, float | None]  # of the ini file; None if it does not set a limit
    _record: Callable[[dict[str, str]], None]  # receives golden, entry and image of each check
    _names: set[str] = field(default_factory=set)

    def check(
        self,
        image: Comparable,
        name: str | None = None,
        *,
        mask: NDArray[Any] | None = None,
        metadata: Mapping[str, str] | None = None,
        driver: Driver | None = None,
        **limits: float | None,
    ) -> None:
        """Compare an image with its golden; fail if they differ or the golden is missing.

        The golden is goldens/MODULE/TEST-PARAMETERS-NAME.exr in the directory of the test file.

        Parameters
        ----------
        image : a Frame, an array (H, W, 3 or 4) of linear float, or the path of an EXR file
        name : name of this image; a test needs it for each image but one
        mask : see :func:`facerender.compare`
        limits : see :func:`facerender.compare`; default: the values in the ini file
        metadata : metadata for the golden in addition to the frame's, for example GL_RENDERER for
            an array
        driver : see :func:`facerender.compare`; default: the ini file's
        """
        __tracebackhide__ = True
        node, settings = self._request.node, self._settings
        if unknown := sorted(limits.keys() - {*NAMES}):
            raise TypeError(f"{unknown[0]} is not a limit: give {', '.join(NAMES)}")
        golden = self._golden_of(name)
        options: dict[str, Any] = {"mask": mask, "driver": driver or settings["driver"]}
        options |= self._limits
        options |= {key: limit for key, limit in limits.items() if limit is not None}
        data = _linear_rgb(image, metadata or {})
        exists = os.path.isfile(golden)  # checked before reading: another process may write it
        pair = Pair.of(f"{node.nodeid} {name}" if name else node.nodeid, golden, data, **options)
        exists = exists or pair.reference is not None
        if not exists:
            pair = replace(pair, error="no golden yet")
        failure = self._refusal(pair, data, golden, exists, options) if pair.status else ""
        record = {"golden": str(golden), "written": "", "entry": ""}
        if pair.status and not failure:
            write(golden, data, options)
            self._request.config.stash.setdefault(_WRITTEN, set()).add(golden)
            record["written"] = str(golden)
        self._record(record)
        if settings["report"]:
            from facerender.comparison.report import entry

            # Text: pytest-xdist sends it from the workers to the process that writes the report.
            record["entry"] = json.dumps(entry(pair))
        if failure:
            record["actual"] = actual = self._save_actual(data, golden)
            remedy = "" if settings["update"] else _remedy(node.nodeid, pair)
            raise AssertionError(f"{failure}\n  golden {golden}\n  actual {actual}{remedy}")

    def _golden_of(self, name: str | None) -> Path:
        """Return the path of the golden of an image, which no other image may have."""
        __tracebackhide__ = True
        node = self._request.node
        safe = _file_name(f"{_name_of(node)}-{name}" if name else _name_of(node))
        if safe in self._names:
            raise InputError(f"{safe} was checked before in this test: give each image a new name")
        self._names.add(safe)
        golden = goldens_of(self._request.path) / f"{safe}.exr"
        owner = _owners(self._request.session).setdefault(str(golden).casefold(), node.nodeid)
        if owner != node.nodeid:
            problem = f"{safe}.exr is also the golden of {owner}"
            remedy = "rename a parameter or an image"
            raise InputError(f"{problem}, at least on disks that ignore case: {remedy}")
        return golden

    def _refusal(
        self, pair: Pair, image: ImageData, golden: Path, exists: bool, options: Mapping[str, Any]
    ) -> str:
        """Return the reason why a golden is not written, with the remedy; "" if it may be."""
        settings = self._settings
        if exists and not settings["update"]:
            return pair.error or f"{golden.stem} differs from its golden: {pair.comparison}"
        if not (settings["update_missing"] or settings["update"]):
            return f"{golden.stem} has no golden: --facerender-update-missing writes it"
        try:
            compare(image, image, **options)  # the image itself or its limits may be invalid
        except InputError as error:
            return str(error)
        if exists and not settings["force"]:
            if pair.reference is None:
                return pair.error
            recorded, this = (
                data.metadata.get("GL_RENDERER") or UNKNOWN for data in (pair.reference, image)
            )
            if recorded != this:
                text = f"{golden.name} was recorded on {recorded}, this is {this}"
                return f"{text}: --facerender-force overwrites it"
        if golden in self._request.config.stash.get(_WRITTEN, set()):
            text = f"{golden.name} was just written for another image"
            return f"{text}: give each image a new name"
        return ""

    def _save_actual(self, image: ImageData, golden: Path) -> str:
        """Write an image that failed; return its path, or the reason why it was not written. The
        path in the folder is the golden's path in pytest's root directory."""
        root = self._request.config.rootpath
        if report := self._settings["report"]:
            folder = Path(report) / "actual"
        else:
            folder = self._request.getfixturevalue("tmp_path_factory").mktemp("facerender")
        actual = folder / (golden.relative_to(root) if golden.is_relative_to(root) else golden.name)
        try:
            actual.parent.mkdir(parents=True, exist_ok=True)
            save_exr(actual, image.pixels, image.metadata)
        except (OSError, InputError) as error:
            return f"not written: {error}"
        return str(actual)


def _linear_rgb(source: Comparable, metadata: Mapping[str, str]) -> ImageData:
    image = as_image(source, "the image")
    if image.encoding != "linear":
        problem = f"{image.name} is 8-bit, which is too coarse for a golden"
        remedy = "compare folders of PNG files with facerender compare"
        raise InputError(f"{problem}: give a Frame, floats or an EXR file, or {remedy}")
    if image.pixels.shape[2] < 3:
        raise InputError(f"{image.name} is grey: give RGB")
    return replace(image, metadata={"facerender": __version__, **image.metadata, **metadata})


def write(path: Path, image: ImageData, options: Mapping[str, Any]) -> None:
    """Write a golden as 24-bit floats, or as float32 if errors are large by the limits."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {reason(error)}") from None
    pixels = image.pixels.astype(np.float32, copy=False)
    for rounded in (True, False):
        save_exr(path, pixels, image.metadata, rounded)
        comparison = Pair.of(path.name, path, image, **options).comparison
        if comparison and comparison.largest <= _ROUNDED * comparison.limits.point:
            return


def _remedy(test: str, pair: Pair) -> str:
    """Return a line with the options that accept a changed image; "" if there is no golden."""
    if pair.reference is None:
        return ""
    failed = pair.comparison.failed if pair.comparison is not None else ()
    names = dict.fromkeys("point" if name == "slivers" else name for name in failed)
    wider = ", ".join(f"{name}=..." for name in names if name in NAMES)
    text = f"\n  if intended: pytest {shlex.quote(test)} --facerender-update"
    return f"{text}, or a wider limit: check(image, {wider})" if wider else text


def goldens_of(module: Path) -> Path:
    """Return the folder of the goldens of a test file."""
    return module.parent / "goldens" / module.stem


def _name_of(node: pytest.Item) -> str:
    """Return the name of a test as CLASS.test-PARAMETERS."""
    names = [part.name for part in node.listchain() if isinstance(part, pytest.Class | pytest.Item)]
    return re.sub(r"\[(.*)\]$", r"-\1", ".".join(names))


def _owners(session: pytest.Session) -> dict[str, str]:
    """Return the ids of the tests that own goldens, keyed by the goldens' paths in lower case. Each
    xdist worker collects all tests, so all workers find the same owners of unnamed images."""
    if _OWNERS not in session.stash:
        owners = session.stash[_OWNERS] = {}
        for item in session.items:
            golden = goldens_of(item.path) / f"{_file_name(_name_of(item))}.exr"
            owners.setdefault(str(golden).casefold(), item.nodeid)
    return session.stash[_OWNERS]


def _file_name(name: str) -> str:
    """Return a unique file name that is valid on every file system."""
    safe = quote(name, safe="=,+")
    if len(safe) <= LONGEST:
        return safe
    return f"{safe[:LONGEST]}~{zlib.crc32(name.encode(errors='surrogateescape')):08x}"
