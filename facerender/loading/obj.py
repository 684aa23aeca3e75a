"""OBJ files before trimesh reads them: references of faces, which it takes as it finds them, and
parts, which it would join by their materials."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

from facerender.errors import warn

# A reference that counts backwards from its line, or is 0, which is none.
_RELATIVE = re.compile(rb"^[ \t]*f[^\n]*[ \t/][-0]", re.MULTILINE)
_LINE = re.compile(rb"^[ \t]*(v|vt|vn|f)[ \t]([^\n]*)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)
# An object, a group or a material, of the faces that follow.
_OWNER = re.compile(rb"^[ \t]*(o|g|usemtl)(?:[ \t]+([^\r\n]*?))?[ \t]*\r?$", re.MULTILINE)
_MOST_GROUPS = 256  # that are parts: each is drawn by itself
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

    def repaired(line: re.Match[bytes]) -> bytes:
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

    return _LINE.sub(repaired, data), dropped


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


Owners = tuple[bytes, ...]  # names of object, group and material


def with_parts(data: bytes, file: str) -> tuple[bytes, list[str]]:
    """Return an OBJ file in which every object, group and material with faces is an object called
    by a number, and the names of the parts that these number.

    A part has its group's name, or else the object's, or else the material's; where that tells it
    not apart from another, the material's with a dot before it as well; and where that does not
    either, the object's too.

    file : its name, to warn of groups that are too many to be parts
    """
    owners = {b"o": b"", b"g": b"", b"usemtl": b""}
    starts, ends, keys, heads = [0], [0], [tuple(owners.values())], [b""]
    for line in _OWNER.finditer(data):
        owners[line[1]] = line[2] or b""
        starts.append(line.start())
        ends.append(line.end())
        keys.append(tuple(owners.values()))
        heads.append(line[0] if line[1] == b"usemtl" else b"")
    starts.append(len(data))
    spans = [*zip(ends, starts[1:], strict=True)]
    has_faces = [_FACE.search(data, *span) is not None for span in spans]
    drawn = _drawn(keys, has_faces)
    if len(drawn) > _MOST_GROUPS:
        keys = [(b"", b"", key[2]) for key in keys]
        joined = _drawn(keys, has_faces)
        if len(joined) < len(drawn):
            warn(
                f"{file} has {len(drawn)} groups with faces, of which at most {_MOST_GROUPS} are "
                "parts: those of a material are joined"
            )
        drawn = joined
    if len(drawn) < 2:
        return data, _names(drawn)
    numbers = {key: number for number, key in enumerate(drawn)}
    lines = [
        b"o %d\n%b%b" % (numbers.get(key, len(drawn)), head, data[slice(*span)])
        for key, head, span in zip(keys, heads, spans, strict=True)
    ]
    return b"".join(lines), _names(drawn)


def _drawn(keys: Sequence[Owners], has_faces: Sequence[bool]) -> list[Owners]:
    return [*dict.fromkeys(key for key, own in zip(keys, has_faces, strict=True) if own)]


def _names(parts: Sequence[Owners]) -> list[str]:
    found = [group or owner or material for owner, group, material in parts]
    for which in (slice(1, 3), slice(0, 3)):
        counts = Counter(found)
        found = [
            name if counts[name] == 1 else b".".join(filter(None, key[which]))
            for name, key in zip(found, parts, strict=True)
        ]
    return [name.decode("utf-8", "replace") for name in found]
