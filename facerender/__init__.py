"""Headless rendering of face meshes with exact and approximated Cook-Torrance and Ward terms.

>>> import facerender as fr
>>> frame = fr.render("head.glb", model="cook-torrance", lobe="exact", m=0.3)
>>> frame.save("head.png")

render          one image in one call; Renderer keeps what it uploads, for several
load_mesh       a mesh file with its materials; Mesh.with_material changes them
simplified      a mesh with fewer triangles; with_occlusion: what it hides of the light around it
Scene           mesh, Camera, Light, ambient, background, environment
Environment     light from all around: load_environment reads an EnvironmentFile; of a Panorama
Shading         the specular Term of each light, what is left out
Job             what to render as plain data, for files and other machines
Frame, GBuffer  what a renderer returns
compare         whether two images are the same, and why not
plan            the cheapest Shading of a scene within an error budget; turntable: cameras for it
brdf, lobes     the same functions in float64
shader_source   one file of the GLSL library, flat, for a target; shader_dir: the include path;
                resolve_includes, moderngl_includes: for programs of your own
"""

from typing import TYPE_CHECKING, Any

from facerender import brdf, lobes
from facerender._version import __version__
from facerender.drawing.frame import Frame, GBuffer
from facerender.drawing.renderer import Renderer, render
from facerender.errors import ContextError, FacerenderError, FacerenderWarning, InputError
from facerender.glsl.library import moderngl_includes, resolve_includes, shader_dir, shader_source
from facerender.job import ImageSettings, Job, MeshFile, Output
from facerender.loading import load_mesh
from facerender.scenes.camera import Camera, turntable
from facerender.scenes.file import EnvironmentFile, load_scene
from facerender.scenes.levels import simplified
from facerender.scenes.light import Light
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Texture
from facerender.scenes.view import View, view_of
from facerender.shading import Shading, Term

if TYPE_CHECKING:
    from facerender.comparison.gates import compare
    from facerender.loading.environment import load_environment
    from facerender.planning.plan import Plan, plan
    from facerender.scenes.environment import Environment, Panorama
    from facerender.scenes.occlusion import with_occlusion

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
    "load_environment",
    "load_mesh",
    "load_scene",
    "lobes",
    "moderngl_includes",
    "plan",
    "render",
    "resolve_includes",
    "shader_dir",
    "shader_source",
    "simplified",
    "turntable",
    "view_of",
    "with_occlusion",
]


def __getattr__(name: str) -> Any:
    """Import what a render does not need when it is asked for, so that a cold start is short."""
    if name in ("Plan", "plan"):
        from facerender.planning import plan as planner

        return getattr(planner, name)
    if name in ("Environment", "Panorama"):
        from facerender.scenes import environment

        return getattr(environment, name)
    if name == "load_environment":
        from facerender.loading.environment import load_environment

        return load_environment
    if name == "with_occlusion":
        from facerender.scenes.occlusion import with_occlusion

        return with_occlusion
    if name == "compare":
        from facerender.comparison.gates import compare

        return compare
    raise AttributeError(f"module 'facerender' has no attribute {name!r}")
