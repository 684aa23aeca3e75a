"""Random mutations of a file's bytes and, for some formats, of its structure."""

from __future__ import annotations

import copy
import json
import re
import struct
import zlib
from collections.abc import Callable, Iterator, MutableMapping, MutableSequence
from io import BytesIO
from random import Random
from typing import Any
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

Mutate = Callable[[bytes, Random], bytes]
Place = tuple[MutableMapping[str, Any] | MutableSequence[Any], Any]

_NUMBERS = (
    *("0", "-0.0", "1", "-1", "2", "7", "99", "255", "65535", "65536", "2147483647", "4294967295"),
    *("9007199254740993", "18446744073709551616", "9" * 400, "300000000", "1e30", "-1e30", "1e100"),
    *("1e300", "1e-150", "1e-300", "1e400", "nan", "inf", "-inf", "NaN", "Infinity", "0.5", "1e-7"),
)
_WORDS = (
    *("", "x", "true", "null", "none", "..", "../../a", "/dev/zero", "/etc/passwd", "http://a/b"),
    *("file:///etc/passwd", "data:,", "data:image/png;base64,AAAA", "data:;base64,!", "\u00e9"),
    *("a" * 5000, "\0", "[", "{", "VEC3", "MAT4", "0x10", "1_000", "%s", "image/png", "MASK"),
)
_HOSTILE: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 7, 99, 255, 5120, 5121, 5123, 5125, 5126, 2**31 - 1, 2**31),
    *(2**32, 2**53, 2**63, 10**400, 300_000_000, 0.5, -0.5, 1e-30, 1e30, 1e300, float("nan")),
    *(float("inf"), "", "x", [], {}, [7], {"a": 1}, [[]], [None], [0, 0, 0], [1e30, 0, 0]),
    *([0] * 16, {"index": 0}, {"index": 99}),
)
_DEEP = 5000  # nested brackets
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_KINDS = (
    *(b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"cHRM", b"sRGB", b"iCCP", b"pHYs"),
    *(b"tEXt", b"zTXt", b"iTXt", b"eXIf", b"acTL", b"fcTL", b"fdAT", b"bKGD", b"sBIT", b"tIME"),
)


def any_bytes(data: bytes, random: Random) -> bytes:
    """Change, insert, drop, repeat or cut off bytes."""
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4, 16))):
        at = random.randrange(len(changed) + 1)
        end = min(len(changed), at + random.choice((1, 2, 4, 8, 64)))
        match random.randrange(7):
            case 0:
                changed[at:end] = random.randbytes(end - at)
            case 1:
                changed[at:at] = random.randbytes(random.choice((1, 2, 4, 8)))
            case 2:
                del changed[at:end]
            case 3:
                changed[at:at] = changed[at:end] * random.choice((1, 2, 100))
            case 4:
                del changed[at:]
            case 5:
                value = random.choice((0, 1, 0x7F, 0x80, 0xFF))
                changed[at:end] = bytes([value]) * (end - at)
            case 6:
                number = random.choice((0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1))
                changed[at : at + 4] = struct.pack(random.choice("<>") + "I", number)
    return bytes(changed)


def text(data: bytes, random: Random) -> bytes:
    """Change words, numbers and lines."""
    lines = data.decode("latin-1").split("\n")
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(lines))
        match random.randrange(8):
            case 0:
                del lines[at : at + random.choice((1, 1, 4))]
                lines = lines or [""]
            case 1:
                lines[at:at] = [lines[at]] * random.choice((1, 2, 50))
            case 2:
                other = random.randrange(len(lines))
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at] = random.choice(_WORDS)
            case _:
                words = re.split(r"([\s,=/\[\]{}\":]+)", lines[at])
                word = random.randrange(len(words))
                words[word] = random.choice(random.choice((_NUMBERS, _NUMBERS, _WORDS)))
                lines[at] = "".join(words)
    return "\n".join(lines).encode("latin-1", "replace")


def json_text(data: bytes, random: Random) -> bytes:
    """Change values, keys and the nesting of JSON; change the bytes if it is not valid JSON."""
    if random.random() < 0.02:
        return random.choice((b"[" * _DEEP, b'{"a":' * _DEEP, data[:-1] + b',"x":' + b"[" * _DEEP))
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return any_bytes(data, random)
    for _ in range(random.choice((1, 1, 2, 3))):
        _change(value, random)
    return json.dumps(value).encode()


def json_lines(data: bytes, random: Random) -> bytes:
    """Change one line of JSON Lines."""
    lines = data.split(b"\n")
    at = random.randrange(len(lines))
    lines[at] = json_text(lines[at], random)
    return b"\n".join(lines)


def _change(value: Any, random: Random) -> None:
    places = list(_places(value))
    if not places:
        return
    holder, key = random.choice(places)
    match random.randrange(8):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, MutableSequence):
            holder.insert(key, copy.deepcopy(holder[key]))
        case 2:
            other, its = random.choice(places)
            holder[key] = copy.deepcopy(other[its])
        case 3 if isinstance(holder[key], int | float):
            holder[key] += random.choice((-1, 1, 4, -4, 1000))
        case 4 if isinstance(holder, MutableMapping):
            holder[random.choice(_WORDS)] = holder.pop(key)
        case 5 if isinstance(holder[key], str):
            holder[key] = random.choice(_WORDS)
        case _:
            holder[key] = copy.deepcopy(random.choice(_HOSTILE))


def _places(value: Any) -> Iterator[Place]:
    if isinstance(value, MutableMapping | MutableSequence):
        for key in value if isinstance(value, MutableMapping) else range(len(value)):
            yield value, key
            yield from _places(value[key])


def glb(data: bytes, random: Random) -> bytes:
    """Change the JSON of a GLB, its buffer, or its declared lengths."""
    if data[:4] != b"glTF" or len(data) < 20:
        return any_bytes(data, random)
    (length,) = struct.unpack_from("<I", data, 12)
    content, rest = data[20 : 20 + length], data[28 + length :]
    match random.randrange(10):
        case 0:
            return any_bytes(data, random)
        case 1:
            return data[:8] + any_bytes(data[8:20], random) + data[20:]
        case 2 | 3:
            rest = any_bytes(rest, random)
        case _:
            content = json_text(content, random)
    content += b" " * (-len(content) % 4)
    chunks = struct.pack("<I4s", len(content), b"JSON") + content
    chunks += struct.pack("<I4s", len(rest), b"BIN\0") + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def png(data: bytes, random: Random) -> bytes:
    """Change, remove, rename or add a chunk of a PNG; the checksums stay valid."""
    if not data.startswith(_PNG) or random.random() < 0.1:
        return any_bytes(data, random)
    chunks, at = [], len(_PNG)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    chunk = random.randrange(len(chunks)) if chunks else 0
    match random.randrange(6):
        case 0 if chunks:
            del chunks[chunk]
        case 1:
            content = random.randbytes(random.choice((0, 1, 3, 4, 8, 26, 32)))
            chunks.insert(chunk, (random.choice(_PNG_KINDS), content))
        case 2 if chunks:
            chunks[chunk] = random.choice(_PNG_KINDS), chunks[chunk][1]
        case _ if chunks:
            kind, content = chunks[chunk]
            chunks[chunk] = kind, any_bytes(content, random)
    return _PNG + b"".join(
        struct.pack(">I", len(content)) + kind + content
        + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    )  # fmt: skip


def npy(data: bytes, random: Random) -> bytes:
    """Change the header of a .npy file; its declared length stays valid."""
    if not data.startswith(b"\x93NUMPY\x01\x00") or len(data) < 10 or random.random() < 0.2:
        return any_bytes(data, random)
    (length,) = struct.unpack_from("<H", data, 8)
    header = text(data[10 : 10 + length].rstrip(b"\n"), random)[:60_000] + b"\n"
    return data[:8] + struct.pack("<H", len(header)) + header + data[10 + length :]


def npz(data: bytes, random: Random) -> bytes:
    """Change the arrays in a .npz file, or its bytes."""
    if random.random() < 0.3:
        return any_bytes(data, random)
    try:
        with ZipFile(BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (BadZipFile, OSError, ValueError, NotImplementedError, RuntimeError, zlib.error):
        return any_bytes(data, random)
    buffer = BytesIO()
    with ZipFile(buffer, "w", ZIP_DEFLATED) as archive:
        for name, content in members.items():
            if random.random() < 0.1:
                continue
            archive.writestr(name or "x", npy(content, random))
    return buffer.getvalue()


def header(data: bytes, random: Random) -> bytes:
    """Change the header of a PLY file, or bytes anywhere in the file."""
    end = data.find(b"end_header")
    if end < 0 or random.random() < 0.4:
        return any_bytes(data, random)
    return text(data[:end], random) + data[end:]


BY_SUFFIX: dict[str, Mutate] = {
    **dict.fromkeys((".gltf", ".json"), json_text),
    **dict.fromkeys((".obj", ".mtl", ".toml", ".csv", ".txt"), text),
    **{".jsonl": json_lines, ".glb": glb, ".ply": header, ".png": png, ".npy": npy, ".npz": npz},
}


def mutate(data: bytes, suffix: str, random: Random) -> bytes:
    """Return a mutation of a file's content; the suffix chooses the kind of mutation."""
    change = BY_SUFFIX.get(suffix, any_bytes)
    if random.random() < 0.1:
        change = random.choice((any_bytes, text))
    return change(data, random)
