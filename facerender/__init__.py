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
    from facerender import brdf as brdf
    from facerender import lobes as lobes
    from facerender.comparison.compare import compare as compare
    from facerender.drawing.frame import Frame as Frame
    from facerender.drawing.frame import GBuffer as GBuffer
    from facerender.drawing.renderer import Renderer as Renderer
    from facerender.drawing.renderer import render as render
    from facerender.errors import ContextError as ContextError
    from facerender.errors import FacerenderError as FacerenderError
    from facerender.errors import FacerenderWarning as FacerenderWarning
    from facerender.errors import InputError as InputError
    from facerender.glsl.library import moderngl_includes as moderngl_includes
    from facerender.glsl.library import resolve_includes as resolve_includes
    from facerender.glsl.library import shader_dir as shader_dir
    from facerender.glsl.library import shader_source as shader_source
    from facerender.images.animation import save_animation as save_animation
    from facerender.job import ImageSettings as ImageSettings
    from facerender.job import Job as Job
    from facerender.job import MeshFile as MeshFile
    from facerender.job import Output as Output
    from facerender.loading import load_mesh as load_mesh
    from facerender.loading.cameras import load_cameras as load_cameras
    from facerender.loading.environment import load_environment as load_environment
    from facerender.planning.plan import Plan as Plan
    from facerender.planning.plan import plan as plan
    from facerender.scenes.camera import Camera as Camera
    from facerender.scenes.camera import turntable as turntable
    from facerender.scenes.environment import Environment as Environment
    from facerender.scenes.environment import Panorama as Panorama
    from facerender.scenes.file import EnvironmentFile as EnvironmentFile
    from facerender.scenes.file import load_scene as load_scene
    from facerender.scenes.light import Light as Light
    from facerender.scenes.lod import simplified as simplified
    from facerender.scenes.material import Material as Material
    from facerender.scenes.mesh import Mesh as Mesh
    from facerender.scenes.occlusion import with_occlusion as with_occlusion
    from facerender.scenes.scene import Scene as Scene
    from facerender.scenes.texture import Texture as Texture
    from facerender.scenes.view import View as View
    from facerender.scenes.view import shifted as shifted
    from facerender.scenes.view import view_of as view_of
    from facerender.shading import Shading as Shading
    from facerender.shading import Term as Term

__version__ = "0.1.0"

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

__all__ = list(("__version__", "brdf", "lobes", *_HOME))  # noqa: C410  # no list that mypy reads


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
