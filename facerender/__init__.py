"""Headless rendering of face meshes with exact and approximated Cook-Torrance and Ward terms.

>>> import facerender as fr
>>> frame = fr.render("head.glb", model="cook-torrance", lobe="exact", m=0.3)
>>> frame.save("head.png")

render          one image in one call; Renderer keeps what it uploads, for several
load_mesh       a mesh file with its materials, or what another library has read of one
Mesh            from_arrays makes one; with_material changes its materials, select its parts
Material        reflectance of a part; Texture: its maps, of files, arrays and Pillow's images
simplified      a mesh with fewer triangles; with_occlusion: what it hides of the light around it
Scene           mesh, Camera, Light, ambient, background, environment
Environment     light from all around: load_environment reads an EnvironmentFile; of a Panorama
Shading         the specular Term of each light, what is left out
Job             what to render as plain data, for files and other machines
Frame, GBuffer  what a renderer returns
compare         whether two images are the same, and why not; shifted: a scene moved by a hair
plan            the cheapest Shading of a scene within an error budget; turntable: cameras for it
load_cameras    the cameras of a file; save_animation: images as .gif, .webp or .mp4
brdf, lobes     the same functions in float64
shader_source   one file of the GLSL library, flat, for a target; shader_dir: the include path;
                resolve_includes, moderngl_includes: for programs of your own
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from facerender.scenes import sources
from facerender.system import IMPORTER  # noqa: F401  # as early as possible

if TYPE_CHECKING:
    from facerender import brdf, lobes
    from facerender.comparison.compare import compare
    from facerender.drawing.frame import Frame, GBuffer
    from facerender.drawing.renderer import Renderer, render
    from facerender.errors import ContextError, FacerenderError, FacerenderWarning, InputError
    from facerender.glsl.library import (
        moderngl_includes,
        resolve_includes,
        shader_dir,
        shader_source,
    )
    from facerender.images.animation import save_animation
    from facerender.job import ImageSettings, Job, MeshFile, Output
    from facerender.loading import load_mesh
    from facerender.loading.cameras import load_cameras
    from facerender.loading.environment import load_environment
    from facerender.planning.plan import Plan, plan
    from facerender.scenes.camera import Camera, turntable
    from facerender.scenes.environment import Environment, Panorama
    from facerender.scenes.file import EnvironmentFile, load_scene
    from facerender.scenes.light import Light
    from facerender.scenes.lod import simplified
    from facerender.scenes.material import Material
    from facerender.scenes.mesh import Mesh
    from facerender.scenes.occlusion import with_occlusion
    from facerender.scenes.scene import Scene
    from facerender.scenes.texture import Texture
    from facerender.scenes.view import View, shifted, view_of
    from facerender.shading import Shading, Term

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "ContextError",
    "Environment",
    "EnvironmentFile",
    "FacerenderError",
    "FacerenderWarning",
    "Frame",
    "GBuffer",
    "ImageSettings",
    "InputError",
    "Job",
    "Light",
    "Material",
    "Mesh",
    "MeshFile",
    "Output",
    "Panorama",
    "Plan",
    "Renderer",
    "Scene",
    "Shading",
    "Term",
    "Texture",
    "View",
    "__version__",
    "brdf",
    "compare",
    "load_cameras",
    "load_environment",
    "load_mesh",
    "load_scene",
    "lobes",
    "moderngl_includes",
    "plan",
    "render",
    "resolve_includes",
    "save_animation",
    "shader_dir",
    "shader_source",
    "shifted",
    "simplified",
    "turntable",
    "view_of",
    "with_occlusion",
]


_HOMES = {
    "images.animation": ("save_animation",),
    "comparison.compare": ("compare",),
    "drawing.frame": ("Frame", "GBuffer"),
    "drawing.renderer": ("Renderer", "render"),
    "errors": ("ContextError", "FacerenderError", "FacerenderWarning", "InputError"),
    "glsl.library": ("moderngl_includes", "resolve_includes", "shader_dir", "shader_source"),
    "job": ("ImageSettings", "Job", "MeshFile", "Output"),
    "loading": ("load_mesh",),
    "loading.cameras": ("load_cameras",),
    "loading.environment": ("load_environment",),
    "planning.plan": ("Plan", "plan"),
    "scenes.camera": ("Camera", "turntable"),
    "scenes.environment": ("Environment", "Panorama"),
    "scenes.file": ("EnvironmentFile", "load_scene"),
    "scenes.lod": ("simplified",),
    "scenes.light": ("Light",),
    "scenes.material": ("Material",),
    "scenes.mesh": ("Mesh",),
    "scenes.occlusion": ("with_occlusion",),
    "scenes.scene": ("Scene",),
    "scenes.texture": ("Texture",),
    "scenes.view": ("View", "shifted", "view_of"),
    "shading": ("Shading", "Term"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import what is asked for, when it is: a cold start is short, and the command can heed signals
    before its imports."""
    if name in ("brdf", "lobes"):
        return import_module(f"facerender.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'facerender' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"facerender.{_HOME[name]}"), name)
    return value


def _load_mesh(source: Any) -> Any:
    return __getattr__("load_mesh")(source)


sources.reader = _load_mesh


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
