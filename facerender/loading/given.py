"""What a mesh is read of: a file, content in memory, or an open file; and which kind it is of."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facerender.errors import InputError, clipped, reason, shown
from facerender.loading.kinds import FORMATS, kind_of
from facerender.system.data import data_dir
from facerender.system.files import MOST, read_file

GLTF = (".glb", ".gltf")


@dataclass(frozen=True)
class Given:
    """A mesh as somebody gave it.

    Attributes
    ----------
    path : of the file; of content a name for messages
    kind : .glb, .gltf, .obj, .ply or .stl
    content : None to read the file
    folder : where files lie that it refers to; None of content, of which nobody knows
    """

    path: Path
    kind: str
    content: bytes | None
    folder: Path | None

    @property
    def name(self) -> str:
        return clipped(self.path.name, 80)

    def read(self) -> bytes:
        """Return the content.

        Raises
        ------
        InputError : a file that cannot be read, or of no format that is
        """
        if self.content is not None:
            return self.content
        shown = clipped(str(self.path))
        if os.path.isdir(self.path):
            raise InputError(f"{shown} is a directory; give a mesh file in it")
        if self.kind not in FORMATS:
            known = ", ".join(FORMATS)
            kind = clipped(self.kind, 40)
            raise InputError(f"{shown}: unknown mesh format {kind!r}; give {known}")
        return read_file(self.path, "a mesh file")


def given(source: Any, kind: str | None = None) -> Given:
    """Return what a source is read of; parameters and errors as of :func:`facerender.load_mesh`."""
    suffix = None
    if kind is not None:
        suffix = f".{str(kind).lower().removeprefix('.')}"
        if suffix not in FORMATS:
            known = ", ".join(each[1:] for each in FORMATS)
            raise InputError(f"unknown kind {shown(kind)} of mesh; known: {known}")
    if source is None:
        source = data_dir("assets") / "head.glb"
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        return Given(path, suffix or path.suffix.lower(), None, path.parent)
    folder, path = None, Path("bytes")
    if hasattr(source, "read"):
        name = getattr(source, "name", None)
        path = Path(name if isinstance(name, str) and name else "file")
        folder = path.parent if os.path.isfile(path) else None
        source = _content(source, path.name)
    if not isinstance(source, bytes | bytearray | memoryview):
        raise InputError(
            f"mesh file = {shown(source)}: give a path, bytes, a file that is open, or a mesh or "
            "scene of trimesh"
        )
    content = bytes(source)
    if suffix is None:
        named = path.suffix.lower()
        suffix = named if named in FORMATS else kind_of(content, path.name)
    return Given(path, suffix, content, folder)


def _content(file: Any, name: str) -> bytes:
    try:
        content = file.read(MOST + 1)
    except (OSError, ValueError) as error:
        why = reason(error)
        raise InputError(f"cannot read {name}: {why}; give a file open for reading") from None
    if not isinstance(content, bytes):
        raise InputError(f"{name} is open as text: open it as bytes, with mode 'rb'")
    if len(content) > MOST:
        raise InputError(f"{name} has more than {MOST} bytes; give a mesh file")
    if not content:
        raise InputError(f"{name} has no more bytes to read: rewind it with seek(0), or fill it")
    return content
