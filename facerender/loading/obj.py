"""Faces of OBJ files, whose references trimesh takes as it finds them."""

from __future__ import annotations

import re
from collections.abc import Mapping

# A reference that counts backwards from its line, or is 0, which is none.
_RELATIVE = re.compile(rb"^[ \t]*f[^\n]*[ \t/][-0]", re.MULTILINE)
_LINE = re.compile(rb"^[ \t]*(v|vt|vn|f)[ \t]([^\n]*)", re.MULTILINE)
_KINDS = (b"v", b"vt", b"vn")  # in the order of a corner's references


def has_relative(data: bytes) -> bool:
    """Whether a face of an OBJ file has references that are not plain numbers from 1 on."""
    return _RELATIVE.search(data) is not None


def with_absolute(data: bytes) -> tuple[bytes, int]:
    """Return an OBJ file whose faces have plain numbers for what is there, and how many other faces
    were left out."""
    totals = {
        key: len(re.findall(rb"^[ \t]*" + key + rb"[ \t]", data, re.MULTILINE)) for key in _KINDS
    }
    counts = dict.fromkeys(_KINDS, 0)
    dropped = 0

    def mend(line: re.Match[bytes]) -> bytes:
        nonlocal dropped
        if line[1] != b"f":
            counts[line[1]] += 1
            return line[0]
        text, hash_, comment = line[2].partition(b"#")
        corners = [_absolute(corner, counts, totals) for corner in text.split()]
        if len(corners) < 3 or not all(corners):
            dropped += 1
            return b""
        return b" ".join([b"f", *corners]) + hash_ + comment

    return _LINE.sub(mend, data), dropped


def _absolute(corner: bytes, counts: Mapping[bytes, int], totals: Mapping[bytes, int]) -> bytes:
    """Return a corner's references as plain numbers; nothing where one is not there."""
    references: list[bytes] = []
    for reference, key in zip(corner.split(b"/"), _KINDS, strict=False):
        if not reference and key != b"v":
            references.append(reference)
            continue
        try:
            number = int(reference)
        except ValueError:
            return b""
        number += counts[key] + 1 if number < 0 else 0
        if not 1 <= number <= totals[key]:
            return b""
        references.append(b"%d" % number)
    return b"/".join(references)
