"""Sources of meshes (files, bytes and open files), their formats, and the files that a mesh file
refers to: found, checked, and read. Missing and unreadable images are reported."""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import re
import struct
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, number_of, quoted, reason, warn
from facerender.images.files import TooLarge, open_image
from facerender.loading.gltf_document import chunks
from facerender.system.files import MAX_FILE_BYTES, check_downloaded, data_dir, read_file, suffix_of
from facerender.texture.texture import DECODERS
from facerender.values.fields import PATH

GLTF = (".glb", ".gltf")
_BEGINNINGS = (
    (b"PK\x03\x04", "a ZIP archive (as USDZ is)", "unpack or export it"),
    (b"\x1f\x8b", "a gzip archive", "unpack it"),
    (b"BZh", "a bzip2 archive", "unpack it"),
    (b"\xfd7zXZ", "an xz archive", "unpack it"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard archive", "unpack it"),
    (b"Rar!", "a RAR archive", "unpack it"),
    (b"Kaydara FBX", "an FBX file", "export it as .glb"),
    (b"; FBX", "an FBX file", "export it as .glb"),
    (b"PXR-USDC", "a USD file", "export it as .glb"),
    (b"#usda", "a USD file", "export it as .glb"),
    (b"BLENDER", "a Blender file", "export it as .glb"),
    (b"DRACO", "a bare Draco file", "export it as .glb"),
    (b"\x89PNG", "a PNG image", "give a mesh, and the image as --albedo"),
    (b"\xff\xd8\xff", "a JPEG image", "give a mesh, and the image as --albedo"),
    (b"%PDF", "a PDF document", "give a mesh"),
    (b"\x89HDF", "an HDF5 file", "export it as .glb"),
    (b"\x93NUMPY", "a NumPy file", "export it as .glb"),
    (b"\x7fELF", "a program", "give a mesh"),
)
_MESHES = ((b"glTF", ".glb"), (b"ply\n", ".ply"), (b"ply\r\n", ".ply"))
BUILT_IN = data_dir("assets") / "head.glb"
FORMATS = {".glb": "glTF", ".gltf": "glTF", ".obj": "OBJ", ".ply": "PLY", ".stl": "STL"}
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".tga")
_COLORS = re.compile("albedo|colou?r|diff|(?<![a-z])col(?![a-z])", re.IGNORECASE)
_FOLDERS = ("tex", "texture", "textures", "map", "maps")  # ends of names of folders with maps
_OBJ = re.compile(rb"(?:^|\n)[ \t]*(?:v|vn|vt|f|o|g|usemtl|mtllib)[ \t]+\S")


@dataclass(frozen=True)
class Source:
    """A mesh file or a mesh in memory, which is read once."""

    path: Path  # for a mesh in memory, a name for messages
    suffix: str  # .glb, .gltf, .obj, .ply or .stl for the format; may differ from that of the path
    content: bytes
    folder: Path | None  # folder of the files that the mesh refers to; None if unknown

    @property
    def name(self) -> str:
        return clipped(self.path.name, 80)


def source_of(source: Any, kind: str | None = None) -> Source:
    """Return the Source of a mesh; parameters and errors as in :func:`facerender.load_mesh`."""
    suffix = None if kind is None else f".{str(kind).lower().removeprefix('.')}"
    if suffix not in (None, *FORMATS):
        kinds = ", ".join(key[1:] for key in FORMATS)
        raise InputError(f"unknown mesh kind {quoted(kind)}; known: {kinds}")
    if isinstance(source, Source):
        return source
    folder, path = None, Path("bytes")
    if source is None:
        source = BUILT_IN
    if from_path := isinstance(source, str | os.PathLike):
        path = Path(PATH.check("mesh file", source))
        try:
            folder, source = path.parent, read_file(path, "a mesh file")
        except InputError:
            suffix_of(path, (*FORMATS,), "mesh", "a mesh file")  # may suggest another name
            raise
    elif hasattr(source, "read"):
        name = getattr(source, "name", None)
        path = Path(name if isinstance(name, str) and name else "file")
        folder = path.parent if os.path.isfile(path) else None
        source = _content(source, path.name)
    if not isinstance(source, bytes | bytearray | memoryview):
        remedy = "give a path, bytes, an open file, or a trimesh mesh or scene"
        raise InputError(f"mesh file = {quoted(source)}: {remedy}")
    content = bytes(source)
    if suffix is None and (suffix := _suffix_of(content, path)) is None:
        if from_path:
            suffix_of(path, (*FORMATS,), "mesh", "a mesh file")
        raise InputError(f"{path.name}: unknown mesh format; specify it, such as kind='obj'")
    return Source(path, suffix, content, folder)


def _content(file: Any, name: str) -> bytes:
    try:
        content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        why = reason(error)
        raise InputError(f"cannot read {name}: {why}; give a file open for reading") from None
    if not isinstance(content, bytes):
        raise InputError(f"{name} is open as text: open it as bytes, with mode 'rb'")
    if len(content) > MAX_FILE_BYTES:
        raise InputError(f"{name} has more than {MAX_FILE_BYTES} bytes; give a mesh file")
    if not content:
        raise InputError(f"{name} has no more bytes to read: rewind it with seek(0), or fill it")
    return content


def _suffix_of(data: bytes, path: Path) -> str | None:
    """Return the suffix of the format of a mesh file's bytes, or None if the format is unknown. The
    first bytes identify glTF and PLY. For other formats the name decides, or else the content."""
    start = data[: 1 << 16].removeprefix(b"\xef\xbb\xbf").lstrip()
    for beginning, suffix in _MESHES:
        if start.startswith(beginning):
            return suffix
    if (named := path.suffix.lower()) in FORMATS:
        return named
    if start.startswith(b"{"):
        return ".gltf"
    binary = len(data) > 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]
    if binary or (start[:5].lower() == b"solid" and b"facet" in start):
        return ".stl"
    check_format(data, None, path.name)
    return ".obj" if b"\0" not in start and _OBJ.search(start) else None


def check_format(data: bytes, suffix: str | None, name: str) -> None:
    """Raise InputError if the content has a known format that differs from the suffix; None accepts
    all mesh formats."""
    start = data[:512].removeprefix(b"\xef\xbb\xbf").lstrip()
    format_name = suffix and FORMATS[suffix]
    subject = f"{name} is not {format_name} but" if format_name else f"{name} is"
    for beginning, content, remedy in _BEGINNINGS:
        if start.startswith(beginning):
            raise InputError(f"{subject} {content}; {remedy}")
    check_downloaded(start, subject)
    if start.startswith(b"<"):
        raise InputError(f"{subject} an XML file; download the file itself")
    if data[257:262] == b"ustar":
        raise InputError(f"{subject} a tar archive; unpack it")
    for beginning, actual_suffix in _MESHES:
        if start.startswith(beginning) and FORMATS[actual_suffix] != format_name:
            raise InputError(f"{subject} {FORMATS[actual_suffix]}; name it {actual_suffix}")
    if start.startswith(b"{") and format_name != "glTF":
        actual = f"JSON ({clipped(data[:200].decode('utf-8', 'replace'), 60)}); give a mesh"
        with suppress(ValueError, RecursionError):
            if len(data) < 1 << 20 and "asset" in json.loads(data):
                actual = "glTF; name it .gltf"
        raise InputError(f"{subject} {actual}")


_MAP = re.compile(r"^\s*(?:map_\w+|bump|norm|disp|decal|refl)\s+(.*\S)", re.M | re.I | re.A)
_LIBRARY = re.compile(r"^\s*mtllib\s+(.*\S)", re.M | re.A)
# The comment of a PLY header that names the texture.
TEXTURE_FILE = re.compile(r"^[ \t]*comment[ \t]+texturefile[ \t]+(.*\S)", re.M | re.I | re.A)
# Windows-1252, in which the five unused bytes are control characters.
_WINDOWS = {byte: bytes([byte]).decode("cp1252", "ignore") or chr(byte) for byte in range(256)}


@dataclass
class References:
    """The files that a mesh file refers to. Each referenced file is read once.
    Only paths below the mesh file's folder are opened. For other paths, a file of the same name in
    that folder is tried. Symbolic links are followed, because the user created the folder."""

    name: str
    folder: Path | None  # folder of the mesh file; None for a mesh in memory, which opens no files
    allow_outside: bool
    # Contents of the files, keyed by the name in the mesh file; None for a file that was not read.
    files: dict[str, bytes | None] = dataclasses.field(default_factory=dict, init=False)

    def read(self, name: str, what: str) -> bytes:
        """Return the content of a file. Raise FileNotFoundError if it is missing or its path is not
        allowed, InputError if it is not a regular file or all files together are too large. In
        messages, ``what`` describes the expected file."""
        if (cached := self.files.get(name)) is not None:
            return cached
        self.files[name] = None
        if not self.folder or (path := _find(self.folder, name, self.allow_outside)) is None:
            raise FileNotFoundError(self.why_not(name))
        if path not in (self.folder / spelling for spelling in _spellings(name)):
            used = os.path.relpath(path, self.folder)
            result = f"{clipped(used, 80)} is used, whose name differs in upper and lower case"
            warn(f"{clipped(name, 80)} (named by {self.name}) not found: {result}")
        remaining = MAX_FILE_BYTES - sum(map(len, filter(None, self.files.values())))
        content = self.files[name] = read_file(path, what, remaining)
        return content

    def image(self, name: str, map_name: str, fatal: bool, silent: bool = False) -> bytes | None:
        """Return the content of an image file. Return None if the file is missing or, with a report
        by :func:`is_image`, cannot be read."""
        try:
            content = self.read(name, "an image file")
        except FileNotFoundError:
            return None
        subject = f"{clipped(name, 80)} (named by {self.name})"
        return content if is_image(content, subject, map_name, fatal, silent) else None

    def why_not(self, name: str) -> str:
        """Return why a file was not found, as the end of a message."""
        if self.folder is None:
            return "cannot be opened, because a mesh given as bytes has no folder: give a path"
        folder = clipped(str(self.folder), 120)
        if not self.allow_outside and not _is_inside(self.folder, _spellings(name)[0]):
            remedy = "pass --allow-outside (allow_outside=True)"
            return f"lies outside {folder} and is not opened: {remedy}"
        return f"not found in {folder}"


def content_of(folder: Path, name: str, allow_outside: bool) -> bytes | None:
    """Return the content of a file ``name`` to which a mesh file in ``folder`` refers, or None."""
    path = _find(folder, name, allow_outside)
    with suppress(InputError):
        return None if path is None else read_file(path, "a file")
    return None


def inline(uri: str) -> bytes | None:
    """Return the content of a data: URI, or None for another URI. Raise ValueError if the data are
    damaged."""
    head, comma, content = uri.partition(",")
    if not head.lower().startswith("data:"):
        return None
    if not comma:
        raise ValueError("a data: URI without data")
    return (base64.b64decode if head.endswith(";base64") else unquote_to_bytes)(content)


def text_of(content: bytes) -> str:
    """Decode the text of a file: UTF-16 with a byte order mark, UTF-8, or else Windows-1252, which
    decodes all bytes. All line ends become LF."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = content.decode("utf-16", "replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1").translate(_WINDOWS)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _find(folder: Path, name: str, allow_outside: bool) -> Path | None:
    """Find a referenced file at its path relative to ``folder``, or else by its file name in
    ``folder``; if it does not exist, a file whose path differs in case only. Return its path, or
    None if it does not exist or is not allowed."""
    spellings = [s for s in _spellings(name) if allow_outside or _is_inside(folder, s)]
    for spelling in spellings:
        if os.path.exists(folder / spelling):
            return folder / spelling
    for spelling in spellings:
        with suppress(ValueError, OSError):  # no such entry, or an unreadable folder
            path = folder
            for part in PurePath(spelling).parts:
                if not os.path.exists(path / part):
                    part = min(e for e in os.listdir(path) if e.lower() == part.lower())
                path /= part
            if path.is_file():
                return path
    return None


def _spellings(name: str) -> tuple[str, ...]:
    """Return the possible paths of a referenced file, relative to the mesh file's folder."""
    path = name.replace("\\", "/").strip()
    plain = unquote(path)
    return path, plain, path.lstrip("/"), os.path.basename(path), os.path.basename(plain)


def _is_inside(folder: Path, name: str) -> bool:
    """Return whether a path lies below a folder, without resolving symbolic links."""
    return os.path.abspath(folder / name).startswith(os.path.join(os.path.abspath(folder), ""))


def named_files(source: Source) -> list[Path]:
    """Return the paths of the files to which a mesh file refers, whether they exist or not. The
    list is empty if the mesh file is damaged or in memory."""
    if source.folder is None:
        return []
    names: list[str] = []
    # Loading the file reports these errors.
    with suppress(AttributeError, ValueError, TypeError, RecursionError):
        if source.suffix in GLTF:
            document = json.loads(chunks(source.content, source.name)[0])
            entries = [entry for key in ("buffers", "images") for entry in document.get(key) or ()]
            uris = (entry.get("uri") for entry in entries if isinstance(entry, dict))
            names = [unquote(uri) for uri in uris if isinstance(uri, str) and uri[:5] != "data:"]
        elif source.suffix == ".ply":
            names = _matches(TEXTURE_FILE, source.content)
        elif source.suffix == ".obj":
            lines = _matches(_LIBRARY, source.content)
            names = [name for line in lines for name in (line, *line.split())]
    paths = _paths(source.folder, names)
    for library in [*paths] if source.suffix == ".obj" else ():
        with suppress(InputError):
            lines = _matches(_MAP, read_file(library, "an MTL file"))
            # Options may precede the name of a map: the last word may be the name.
            maps = {name.strip('"') for line in lines for name in (line, *line.split()[-1:])}
            paths += _paths(library.parent, sorted(maps))
    return paths


def _matches(pattern: re.Pattern[str], content: bytes) -> list[str]:
    return pattern.findall(text_of(content).replace("\\", "/"))


def _paths(folder: Path, names: Iterable[str]) -> list[Path]:
    """Return the paths of referenced files, and the paths of the files that are used instead."""
    paths = (path for name in names for path in (folder / name, _find(folder, name, False)))
    return [*dict.fromkeys(filter(None, paths))]


def color_bytes(colors: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours of a mesh file as 8 bits. Programs write floats up to 1 or 255, and integers
    of any type up to 255 or, in 16 bits, up to 65535."""
    finite = np.where(np.isfinite(colors), colors, 0)
    if colors.dtype.kind == "f":
        lit = finite[finite > 0.0]
        white = 255.0 if len(lit) and np.median(lit) > 1.0 else 1.0
    else:
        white = 65535.0 if colors.dtype.itemsize == 2 and finite.max(initial=0) > 255 else 255.0
    return np.asarray(np.clip(finite * (255.0 / white), 0.0, 255.0).round(), dtype=np.uint8)


def is_image(
    content: bytes, subject: str, map_name: str, fatal: bool, silent: bool = False
) -> bool:
    """Return whether an image can be opened. If it cannot be read or is too large, raise InputError
    if ``fatal``, else warn unless ``silent``."""
    try:
        return bool(open_image(content, subject, DECODERS, "PNG, JPEG, TIFF or WebP"))
    except TooLarge as error:
        message, _, advice = str(error).rpartition("; ")
    except InputError:
        message, advice = f"{subject} is not an image that can be read", "replace it"
    if not fatal:
        if not silent:
            warn(f"{message}: ignored")
        return False
    option = {"albedo": "--albedo", "normal": "--normal-map", "roughness": "--roughness-map"}
    remedy = f", or pass {option[map_name]} FILE" if map_name in option else ""
    raise InputError(f"{message}; {advice}{remedy}")


def missing_image(referred: References, name: str) -> None:
    """Warn of a missing image, and suggest the albedo map in the mesh file's folder."""
    hint = f"pass --albedo {_albedo_in(referred.folder)[1]}"
    result = f"rendering without it; {hint}"
    warn(f"{clipped(name, 80)} (named by {referred.name}) {referred.why_not(name)}: {result}")


def unused_maps(name: str, folder: Path) -> None:
    """Warn of an albedo map in the folder of a mesh file without one, or of images in a folder of
    maps there."""
    entries = sorted(islice(folder.glob("*"), 1000))
    for path in (folder, *(path for path in entries if path.name.lower().endswith(_FOLDERS))):
        count, image = _albedo_in(path)
        if count and (path is not folder or _COLORS.search(image)):
            where = "its folder" if path is folder else f"{clipped(path.name, 80)}/"
            remedy = f"{where} holds {number_of(count, 'image')}: give --albedo {path / image}"
            return warn(f"{name} has no albedo map, but {remedy}")


def _albedo_in(folder: Path | None) -> tuple[int, str]:
    """Return the number of images in a folder, and the name of the only one, or of the first one
    that is named as colours; FILE if there is none."""
    entries = sorted(islice(folder.glob("*"), 1000)) if folder else ()
    images = [path.name for path in entries if path.suffix.lower() in _IMAGES]
    colors = images if len(images) == 1 else [*filter(_COLORS.search, images)]
    return len(images), clipped(colors[0], 80) if colors else "FILE"


def no_faces(name: str, points: bool) -> InputError:
    """Return the error for a file without faces; ``points`` : whether it has vertices."""
    content = "only points and no faces" if points else "no geometry"
    return InputError(f"{name} has {content}; give a triangle mesh")
