"""OpenGL 3.3 contexts without a window: EGL, OSMesa, the window system's (WGL, CGL, GLX), or the
host's current context. This module also detects drivers that a fork has made unusable."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import glcontext
import moderngl

from facerender.drawing.gl_state import (
    HostContext,
    bind_osmesa,
    current_context,
    egl_in_use,
    save_state,
)
from facerender.errors import ContextError, check_known
from facerender.system import IMPORTER

Backend = Literal["auto", "egl", "osmesa", "native", "current"]

BACKENDS: tuple[Backend, ...] = ("auto", "egl", "osmesa", "native", "current")
# Backends that "auto" tries, in this order. Windows and macOS have only "native".
AUTO: tuple[Backend, ...] = (
    ("native",) if sys.platform in ("win32", "darwin") else ("egl", "osmesa")
)
_MESA = "libgl1 libgl1-mesa-dri"
REMEDIES = {
    "egl": f"on Debian or Ubuntu: {{sudo}}apt-get install libegl1 {_MESA}",
    "osmesa": "on Debian or Ubuntu: {sudo}apt-get install libosmesa6; Mesa 25.1 and later lack it: "
    "use egl",
    "native": "install a graphics driver that has OpenGL 3.3"
    if AUTO == ("native",)
    else f"on Debian or Ubuntu: {{sudo}}apt-get install {_MESA} libx11-6 xvfb",
    "current": "make a context current first, or use the backend auto",
}
SOFTWARE = ("llvmpipe", "softpipe", "swr", "swiftshader", "software rasterizer", "apple software")
_GL_VERSION = 330

# Names of the drivers that this process or its ancestors have opened. A fork does not copy a
# driver's threads, so _lost has the drivers opened before the last fork.
_opened: set[str] = set()
_lost: set[str] = set()


def _lose() -> None:
    if egl_in_use():  # also by other code
        _opened.add("egl")
    _lost.update(_opened)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose)
if os.getpid() != IMPORTER:
    _lose()


class ForeignContext:
    """Access to the OpenGL functions of the host's current context, which only the host frees."""

    def __init__(self, get_proc_address: Any) -> None:
        get_proc_address.restype = ctypes.c_void_p
        get_proc_address.argtypes = [ctypes.c_char_p]
        self._get_proc_address = get_proc_address

    def load(self, name: str) -> int:
        return self._get_proc_address(name.encode()) or 0

    load_opengl_function = load

    def release(self) -> None:
        pass

    def __enter__(self) -> ForeignContext:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


class _OSMesaContext(ForeignContext):
    """An off-screen Mesa context. Its default framebuffer is one pixel in memory; images are drawn
    into framebuffer objects."""

    _ATTRIBUTES = (
        (0x22, 0x1908),  # OSMESA_FORMAT: RGBA
        (0x30, 24),  # OSMESA_DEPTH_BITS
        (0x33, 0x34),  # OSMESA_PROFILE: core
        (0x36, _GL_VERSION // 100),  # OSMESA_CONTEXT_MAJOR_VERSION
        (0x37, _GL_VERSION % 100 // 10),  # OSMESA_CONTEXT_MINOR_VERSION
        (0, 0),
    )

    def __init__(self) -> None:
        self._library = _open_library("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
        super().__init__(self._library.OSMesaGetProcAddress)
        flat = [value for pair in self._ATTRIBUTES for value in pair]
        create = self._library.OSMesaCreateContextAttribs
        create.restype = ctypes.c_void_p
        create.argtypes = [ctypes.POINTER(ctypes.c_int), ctypes.c_void_p]
        self._context = create((ctypes.c_int * len(flat))(*flat), None)
        if not self._context:
            raise ContextError("libOSMesa refused an OpenGL 3.3 core context")
        self._pixel = (ctypes.c_ubyte * 4)()
        self._make_current(self._context)

    def _make_current(self, context: int | None) -> None:
        if not bind_osmesa(self._library, context, self._pixel if context else None, 1, 1):
            raise ContextError("libOSMesa could not make its context current")

    def __enter__(self) -> _OSMesaContext:
        self._make_current(self._context)
        return self

    def __exit__(self, *exception: object) -> None:
        self._make_current(None)

    def release(self) -> None:
        if self._context:
            self._library.OSMesaDestroyContext.argtypes = [ctypes.c_void_p]
            self._library.OSMesaDestroyContext(self._context)
            self._context = None


def check_process(process: int) -> None:
    """Raise ContextError if the process with this ID is not the current process, so that an object
    that it created was inherited by a fork."""
    if process != os.getpid():
        raise ContextError(
            "this renderer was created before a fork, in another process: create a new one in this "
            "process"
        )


def _open_library(*names: str) -> ctypes.CDLL:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise ContextError(f"{names[0]} is not installed")


def _standalone(backend: str, **libraries: str) -> Any:
    for library in libraries.values():
        _open_library(library)
    if "libx11" in libraries and not os.environ.get("DISPLAY"):
        raise ContextError("DISPLAY is not set: start an X server, such as Xvfb with xvfb-run")
    native = backend == "native"
    make = glcontext.default_backend() if native else glcontext.get_backend_by_name(backend)
    return make(mode="standalone", glversion=_GL_VERSION, **libraries)


def _current() -> ForeignContext:
    host = current_context()
    if host is None:
        raise ContextError("no EGL, GLX or OSMesa context is current in this thread")
    return ForeignContext(host.get_proc_address)


def is_software(renderer: str) -> bool:
    """Return whether a value of GL_RENDERER names a software driver."""
    return any(name in renderer.lower() for name in SOFTWARE)


@dataclass(frozen=True)
class Context:
    """An OpenGL context with its properties.

    backend : "egl", "osmesa", "native" or "current"
    gl : the moderngl context; it is current only within :meth:`drawing`
    loader : object that returns the addresses of OpenGL functions
    handle : address of a host's context, otherwise 0
    renderer, version : GL_RENDERER and GL_VERSION, which every result and golden must record
    process : ID of the process that created the context; no other process can use the context
    """

    backend: str
    gl: moderngl.Context
    loader: Any
    handle: int
    renderer: str
    version: str
    process: int = field(default_factory=os.getpid)
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)

    @property
    def most_samples(self) -> int:
        """Largest number of samples per pixel that the driver supports."""
        return max(int(self.gl.info["GL_MAX_SAMPLES"]), 1)

    @property
    def max_side(self) -> int:
        """Largest width and height of an image that the driver supports, in pixels."""
        info = self.gl.info
        return int(min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"]))

    @property
    def software(self) -> bool:
        """Whether the driver is a software driver, which draws on the CPU."""
        return is_software(self.renderer)

    def function(self, name: str, *argument_types: type, result: type | None = None) -> Any:
        """Return an OpenGL function that moderngl does not wrap."""
        return ctypes.CFUNCTYPE(result, *argument_types)(self.loader.load(name))

    @contextmanager
    def drawing(self) -> Iterator[moderngl.Context]:
        """Make the context current, for one thread at a time.

        Afterwards the previous context is current again. If this is the host's context, the state
        of the context is restored. Raises ContextError if the context was released, was created
        before a fork, or is a host's context that is not current in this thread.
        """
        check_process(self.process)
        with self._lock:
            if self.released:
                raise ContextError("this renderer was released: create a new one")
            host, guest = current_context(), self.backend == "current"
            if guest and (host is None or host.handle != self.handle):
                raise ContextError(
                    "the context in which this renderer was created is not current in this "
                    "thread: make it current first"
                )
            restore = save_state(self.loader.load) if guest else host and host.rebind
            try:
                with nullcontext() if guest else self.gl:
                    yield self.gl
            finally:
                if restore:
                    restore()

    @property
    def inherited(self) -> bool:
        """Whether another process created the context, before a fork. Only that process may free
        the context."""
        return self.process != os.getpid()

    @property
    def released(self) -> bool:
        """Whether :meth:`release` was called."""
        return isinstance(self.gl.mglo, moderngl.InvalidObject)

    def release(self) -> None:
        """Free the context, unless it is the host's or inherited. Further calls have no effect."""
        if not self.inherited:
            self.gl.release()


# With these names, glcontext does not start ldconfig or a compiler to find the libraries.
_LIBRARIES = {} if AUTO == ("native",) else {"libgl": "libGL.so.1", "libx11": "libX11.so.6"}
_OPENERS: dict[str, Callable[[], Any]] = {
    "egl": partial(_standalone, "egl", libegl="libEGL.so.1", libgl="libGL.so.1"),
    "osmesa": _OSMesaContext,
    "native": partial(_standalone, "native", **_LIBRARIES),
    "current": _current,
}


def create_context(backend: Backend = "auto") -> Context:
    """Open an OpenGL 3.3 context.

    Parameters
    ----------
    backend : "egl", "osmesa", "native" (WGL, CGL or GLX), "current" (the host's context), or "auto"
        (default) for the first backend of AUTO that works

    Raises
    ------
    InputError : an unknown backend
    ContextError : no backend works; the message lists each backend's error, and a remedy
    """
    check_known("backend", backend, BACKENDS)
    tried = AUTO if backend == "auto" else (backend,)
    host = current_context()
    errors = []
    for name in tried:
        try:
            return _open(name, host)
        except Exception as error:  # glcontext raises bare Exception
            errors.append(f"{name}: {error}")
        finally:
            if host is not None and name != "current":
                host.rebind()
    raise ContextError(f"no OpenGL context ({'; '.join(errors)}); {_remedy(tried)}")


def _open(name: str, host: HostContext | None) -> Context:
    if name in _lost:
        raise ContextError("this driver was in use before this process was forked")
    loader = _OPENERS[name]()
    guest = host if name == "current" else None
    restore = save_state(loader.load) if guest else None
    try:
        gl = moderngl.create_context(require=_GL_VERSION, standalone=not guest, context=loader)
        # If Python freed a GPU object while another context was current, OpenGL would delete that
        # context's object with the same number. context_gc delays deletions until gl.gc().
        gl.gc_mode = "context_gc"
        info = gl.info
    finally:
        if restore:
            restore()
    if not guest:
        with gl:
            pass  # leaving the block unbinds the new context
        _opened.add(name)
    handle = guest.handle if guest else 0
    return Context(name, gl, loader, handle, info["GL_RENDERER"], info["GL_VERSION"])


def _remedy(tried: tuple[str, ...]) -> str:
    if not _lost.isdisjoint(tried):
        return (
            'start the process by multiprocessing.get_context("spawn"), or a PyTorch loader with '
            'multiprocessing_context="spawn"'
        )
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    return REMEDIES[tried[0]].format(sudo="" if root else "sudo ")


@dataclass(frozen=True)
class Finding:
    """Result of :func:`probe` for one backend: properties of its context, or an error."""

    backend: str
    renderer: str = ""
    version: str = ""
    samples: int = 0
    size: int = 0
    error: str = ""


def probe() -> list[Finding]:
    """Try the backends "egl", "osmesa" and "native", and return the result of each."""
    findings = []
    for name in BACKENDS[1:-1]:
        try:
            context = create_context(name)
        except ContextError as error:
            findings.append(Finding(name, error=str(error)))
            continue
        limits = context.most_samples, context.max_side
        findings.append(Finding(name, context.renderer, context.version, *limits))
        context.release()
    return findings
