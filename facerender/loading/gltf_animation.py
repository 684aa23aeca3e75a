"""Read the animations and morph targets of a glTF file for a rig. A damaged animation or target is
returned with a description of the damage, so that the stored pose can still be drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from facerender.errors import clipped
from facerender.loading.gltf_buffers import Buffers
from facerender.loading.gltf_document import TYPES, Doc, checked_animation
from facerender.scenes.repair import unique
from facerender.scenes.rig import Clip, Interpolation, Path, Shape, Track

if TYPE_CHECKING:
    from facerender.loading.gltf import Primitive

_T = TypeVar("_T")
_WIDTHS: dict[Path, int] = {"translation": 3, "rotation": 4, "scale": 3}
_Rows = tuple[NDArray[Any], NDArray[Any]]  # indices and values
_POINTER = "KHR_animation_pointer"
# Limit of the values read for a rig, because accessors may overlap: _TIMES the bytes of the file's
# buffers plus _FEW, and at most _MOST.
_TIMES, _FEW, _MOST = 8, 1 << 22, 1 << 28


class RigReader:
    """Reads the clips and shapes of a checked glTF document."""

    def __init__(self, buffers: Buffers) -> None:
        self.buffers, self.document = buffers, buffers.document
        size = sum(buffer["byteLength"] for buffer in self.document["buffers"])
        self.left = min(_TIMES * size + _FEW, _MOST)  # number of values that may still be read
        # Keyed by the accessor's index: checked values, checked times, rows that are not 0.
        self.arrays: dict[int, NDArray[Any]] = {}
        self.times: dict[int, NDArray[np.float64]] = {}
        self.rows: dict[int, _Rows] = {}

    def _read(self, index: int, read: Callable[[int], _T]) -> _T:
        """Return ``read(index)``; raise ValueError if the accessor's values exceed the limit."""
        accessor = self.document["accessors"][index]
        rows = accessor["count"] if "bufferView" in accessor else 0
        rows += accessor.get("sparse", {"count": 0})["count"]
        needed = rows * TYPES[accessor["type"]]
        if needed > self.left:
            raise ValueError("the file has too many animated values")
        result = read(index)
        self.left -= needed
        return result

    # --- clips -----------------------------------------------------------------------------------

    def clips(self) -> tuple[Clip, ...]:
        """Return the animations with unique names."""
        animations = self.document.get("animations")
        if not isinstance(animations, list):
            return ()
        stored_names = (clip.get("name") if isinstance(clip, dict) else None for clip in animations)
        return tuple(self._clip(i, name) for i, name in enumerate(_named(stored_names, "clip")))

    def _clip(self, index: int, name: str) -> Clip:
        try:
            animation = checked_animation(self.document, index)
            tracks: dict[tuple[int, str], Track] = {}
            ignored = ""
            for i, channel in enumerate(animation["channels"]):
                where = f"animations[{index}].channels[{i}]"
                node, path = channel["target"].get("node"), channel["target"]["path"]
                if path == "pointer":
                    ignored = _POINTER
                elif node is not None:
                    if (node, path) in tracks:
                        raise ValueError(f"{where} has the same target as another channel")
                    width = self._width(node, path, where)
                    if channel["sampler"] >= len(animation["samplers"]):
                        raise ValueError(f"{where}.sampler = {channel['sampler']} does not exist")
                    keys = animation["samplers"][channel["sampler"]]
                    tracks[node, path] = self._track(node, path, width, keys, where)
            return Clip(name, tuple(tracks.values()), ignored=ignored)
        except ValueError as error:
            return Clip(name, fault=clipped(str(error)))

    def _width(self, number: int, path: str, where: str) -> int:
        """Return the number of values per key."""
        node = self.document["nodes"][number]
        if path in _WIDTHS:
            if "matrix" in node:
                raise ValueError(f"{where} moves nodes[{number}], which has a matrix")
            return _WIDTHS[path]
        if path != "weights":
            raise ValueError(f"{where}.target.path = {clipped(path, 40)!r} is unknown")
        mesh = self.document["meshes"][node["mesh"]] if "mesh" in node else {"primitives": []}
        targets = max((len(part.get("targets", ())) for part in mesh["primitives"]), default=0)
        if not targets:
            raise ValueError(f"{where} has weights for nodes[{number}], which has no morph targets")
        return targets

    def _track(self, node: int, path: Any, width: int, keys: Doc, where: str) -> Track:
        interpolation = keys.get("interpolation", "LINEAR")
        if interpolation not in get_args(Interpolation):
            raise ValueError(f"{where}: interpolation {clipped(interpolation, 40)!r} is unknown")
        times = self._times(keys["input"], where)
        values = self._array(keys["output"])
        per_key = 3 if interpolation == "CUBICSPLINE" else 1
        rows = per_key * len(times) * (width if path == "weights" else 1)
        if values.shape != (rows, 1 if path == "weights" else width):
            raise ValueError(
                f"{where}: the values have the shape {values.shape} for {len(times)} keys"
            )
        shape = (len(times), 3, width) if per_key == 3 else (len(times), width)
        return Track(node, path, times, values.reshape(shape), interpolation)

    def _times(self, index: int, where: str) -> NDArray[np.float64]:
        if index not in self.times:
            times = self._array(index)
            if times.shape[1] != 1 or not len(times):
                raise ValueError(f"{where}: the times have the shape {times.shape}")
            if times[0, 0] < 0.0:
                raise ValueError(f"{where}: the first time is below 0")
            if (times[1:] < times[:-1]).any():
                raise ValueError(f"{where}: the times run backwards")
            self.times[index] = times[:, 0].astype(np.float64)
        return self.times[index]

    def _array(self, index: int) -> NDArray[Any]:
        """Return a copy of an accessor's values, which several channels may share."""
        if index not in self.arrays:
            values = np.array(self._read(index, self.buffers.accessor))
            if not np.isfinite(values).all():
                raise ValueError(f"accessors[{index}] has a value that is not finite")
            self.arrays[index] = values
        return self.arrays[index]

    # --- shapes ----------------------------------------------------------------------------------

    def shapes(self, primitive: Primitive, extras: Any, has_normals: bool) -> tuple[Shape, ...]:
        """Return the morph targets of a primitive. The first list targetNames in the extras of the
        mesh and of the primitive names them. Otherwise the accessors do, if their names differ.

        Parameters
        ----------
        extras : extras of the mesh, of any type
        has_normals : whether the primitive has normals, which targets may move
        """
        targets: Sequence[Doc] = primitive.properties["targets"]
        extras = extras, primitive.properties.get("extras")
        lists = [table.get("targetNames") for table in extras if isinstance(table, dict)]
        accessors = self.document["accessors"]
        of_accessors = [accessors[t["POSITION"]].get("name") for t in targets if "POSITION" in t]
        if len({*of_accessors, ""}) > len(targets):  # exporters without targetNames write these
            lists.append(of_accessors)
        stored_names = next((names for names in lists if isinstance(names, list)), [])
        padded = [*stored_names[: len(targets)], *[None] * (len(targets) - len(stored_names))]
        shapes = []
        for i, (target, name) in enumerate(zip(targets, _named(padded, "shape"), strict=True)):
            rows: dict[str, _Rows] = {}
            try:
                for key in ("POSITION", "NORMAL"):
                    if key in target and (has_normals or key == "POSITION"):
                        where = f"{primitive.where}.targets[{i}]: {key}"
                        rows[key] = self._moves(target[key], primitive, where)
            except ValueError as error:
                shapes.append(Shape(name, fault=clipped(str(error))))
                continue
            none = None, None
            shapes.append(Shape(name, *rows.get("POSITION", none), *rows.get("NORMAL", none)))
        return tuple(shapes)

    def _moves(self, index: int, primitive: Primitive, where: str) -> _Rows:
        """Return the rows of an accessor that are not 0, of the vertices that the part keeps."""
        accessor = self.document["accessors"][index]
        if (accessor["count"], TYPES[accessor["type"]]) != (len(primitive.positions), 3):
            raise ValueError(f"{where} has the wrong number of entries")
        if index not in self.rows:
            rows, moves = self._read(index, self.buffers.rows)
            self.rows[index] = rows.astype(np.uint32), moves.astype(np.float32)
        rows, moves = self.rows[index]
        if isinstance(primitive.vertices, slice):
            return rows, moves
        places = np.searchsorted(primitive.vertices, rows)
        mask = np.isin(rows, primitive.vertices)
        return places[mask].astype(np.uint32), moves[mask]


def _named(names: Iterable[Any], kind: str) -> list[str]:
    """Return a unique name of one line for each name. A name that is empty or no text becomes
    ``shape2`` for the second shape."""
    clipped_names = (clipped(name, 80) if isinstance(name, str) else "" for name in names)
    return [*unique(name or f"{kind}{i}" for i, name in enumerate(clipped_names, 1))]
