"""Views of glTF files that are compressed with meshoptimizer (EXT_meshopt_compression and
KHR_meshopt_compression). The arithmetic is its author's, as WebAssembly in
``scenes/meshoptimizer``, which wasmtime runs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerender.errors import InputError

if TYPE_CHECKING:
    import wasmtime

_CODE = Path(__file__).parents[1] / "scenes" / "meshoptimizer" / "decoder.wasm"
_MOST, _SMALL, _TIMES = 1 << 30, 1 << 26, 256  # bytes, and of what is small as many times as many
# By the mode: the function, the bytes that an element may have, of how many the count is a multiple
_MODES = {
    "ATTRIBUTES": ("meshopt_decodeVertexBuffer", range(4, 257, 4), 1),
    "TRIANGLES": ("meshopt_decodeIndexBuffer", (2, 4), 3),
    "INDICES": ("meshopt_decodeIndexSequence", (2, 4), 1),
}
_FILTERS = {
    "OCTAHEDRAL": ("meshopt_decodeFilterOct", (4, 8)),
    "QUATERNION": ("meshopt_decodeFilterQuat", (8,)),
    "EXPONENTIAL": ("meshopt_decodeFilterExp", range(4, 257, 4)),
    "COLOR": ("meshopt_decodeFilterColor", (4, 8)),
}


def decoded(content: bytes, view: Mapping[str, Any], name: str) -> memoryview:
    """Return the elements that are compressed in a view.

    view : the extension's object
    name : the file's

    Raises
    ------
    ValueError : it is damaged
    InputError : wasmtime is not installed

    References: Kapoulkine (2022), EXT_meshopt_compression; meshoptimizer 1.3.
    """
    count, size = view["count"], view["byteStride"]
    mode, filter_ = view["mode"], view.get("filter", "NONE")
    what = f"a view compressed with meshopt as {mode} of {count} x {size} bytes"
    function, sizes, multiple = _MODES.get(mode, ("", (), 1))
    own, filtered = _FILTERS.get(filter_, ("", (size,) if filter_ == "NONE" else ()))
    if size not in sizes or size not in filtered or count % multiple:
        raise ValueError(f"{what}, filter {filter_}, is none")
    if own and mode != "ATTRIBUTES":
        raise ValueError(f"{what} has a filter")
    if count * size > min(max(_TIMES * len(content), _SMALL), _MOST):
        raise ValueError(f"{what} in {len(content)} bytes")
    try:
        import wasmtime
    except ImportError:
        raise InputError(
            f"{name} is compressed with meshopt: pip install 'facerender[lod]'"
        ) from None
    engine, module = _compiled()
    store = wasmtime.Store(engine)
    library = wasmtime.Instance(store, module, []).exports(store)
    library["__wasm_call_ctors"](store)
    whole = -(-count // 4) * 4
    target, source = (library["sbrk"](store, each) for each in (whole * size, len(content)))
    library["memory"].write(store, content, source)
    try:
        failed = library[function](store, target, count, size, source, len(content))
        if own and not failed:
            library[own](store, target, whole, size)
    except wasmtime.Trap:
        failed = True
    if failed:
        raise ValueError(f"{what} is no such thing")
    return memoryview(bytes(library["memory"].read(store, target, target + count * size)))


@cache
def _compiled() -> tuple[wasmtime.Engine, wasmtime.Module]:
    import atexit

    import wasmtime

    atexit.register(_compiled.cache_clear)  # wasmtime's own objects go before it does
    engine = wasmtime.Engine()
    return engine, wasmtime.Module(engine, _CODE.read_bytes())
