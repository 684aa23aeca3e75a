"""Headless rendering of face meshes with exact and approximated Cook-Torrance and Ward terms.

>>> import facerender as fr
>>> frame = fr.render("head.glb", model="cook-torrance", lobe="exact", m=0.3)
>>> frame.save("head.png")

render          one image in one call; Renderer keeps what it uploads, for several
load_mesh       a mesh file with its materials; Mesh.with_material changes them
Scene           mesh, Camera, Light, ambient, background
Shading         model, lobe, Fresnel and masking terms, what is left out
Frame, GBuffer  what a renderer returns
compare         whether two images are the same, and why not
plan            the cheapest Shading of a scene within an error budget; turntable: cameras for it
brdf, lobes     the same functions in float64
shader_source   one file of the GLSL library, flat, for a target; shader_dir: the include path;
                resolve_includes, moderngl_includes: for programs of your own
"""

from facerender import brdf, lobes

__version__ = "0.1.0"

from facerender.compare import compare
from facerender.errors import ContextError, FacerenderError, FacerenderWarning, InputError
from facerender.frame import Frame, GBuffer
from facerender.glsl import moderngl_includes, resolve_includes, shader_dir, shader_source
from facerender.mesh import Mesh, load_mesh
from facerender.plan import Plan, plan
from facerender.renderer import Renderer, render
from facerender.scene import (
    Camera,
    Light,
    Material,
    Scene,
    View,
    load_scene,
    turntable,
    view_of,
)
from facerender.shading import Shading
from facerender.texture import Texture

__all__ = [
    "Camera",
    "ContextError",
    "FacerenderError",
    "FacerenderWarning",
    "Frame",
    "GBuffer",
    "InputError",
    "Light",
    "Material",
    "Mesh",
    "Plan",
    "Renderer",
    "Scene",
    "Shading",
    "Texture",
    "View",
    "brdf",
    "compare",
    "load_mesh",
    "load_scene",
    "lobes",
    "moderngl_includes",
    "plan",
    "render",
    "resolve_includes",
    "shader_dir",
    "shader_source",
    "turntable",
    "view_of",
]
