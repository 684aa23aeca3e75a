"""Render face meshes headlessly with exact and approximated Cook-Torrance and Ward terms.

>>> import facerender as fr
>>> frame = fr.render("head.glb", model="cook-torrance", lobe="exact", m=0.3)
>>> frame.save("head.png")

render          draws one image in one call; a Renderer keeps uploaded meshes and maps
load_mesh       loads a mesh file with its materials, or converts a trimesh object
Mesh            from_arrays creates a mesh; with_material changes materials, select picks parts
Material        reflectance of a part; a Texture is a map from a file, an array or a Pillow image
simplified      returns a mesh with fewer triangles; with_occlusion bakes ambient occlusion, and
                tracked makes cameras follow a moving head
find_face       finds the eyes and the direction of a face on a mesh in any orientation: a Face
register        moves a scan into the space of another scan of the same person: a Registration
Scene           mesh, Camera, Light, ambient light, background and environment; accepts names of the
                command line, such as "three-quarter", "key" and "studio"; load_scene reads a file
Environment     environment map from a Panorama; load_environment reads a file, an EnvironmentFile
Shading         the specular Term of each light, and the terms to omit
Job             a scene with its outputs as plain data, for files and other machines; a Pose
                moves its mesh
Frame, GBuffer  results of a renderer
compare         returns whether two images match, and why not; difference and sheet make pictures of
                several images; shifted moves the image of a scene
plan            finds the cheapest Shading within an error budget
Landmarks       points on a mesh; load_landmarks reads a file, Renderer.landmarks finds their pixels
load_cameras    reads cameras from a file; turntable returns cameras around a mesh, STANDARD_VIEWS
                has the cameras of clinical photography
save_animation  writes .gif, .webp or .mp4
brdf, lobes     the reference functions in float64
shader_source   returns a GLSL file for a target, with its includes inserted; shader_dir returns the
                include directory; resolve_includes inserts includes into your own GLSL text, and
                moderngl_includes registers them for your own moderngl programs
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from facerender.system import IMPORTER  # noqa: F401  # early, to store the process id

if TYPE_CHECKING:
    from facerender import brdf as brdf
    from facerender import lobes as lobes
    from facerender.comparison.compare import compare as compare
    from facerender.comparison.pictures import difference as difference
    from facerender.comparison.pictures import sheet as sheet
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
    from facerender.loading import MeshFile as MeshFile
    from facerender.loading import load_mesh as load_mesh
    from facerender.material import Material as Material
    from facerender.mesh.mesh import Mesh as Mesh
    from facerender.mesh.mesh import find_face as find_face
    from facerender.mesh.mesh import tracked as tracked
    from facerender.mesh.occlusion import with_occlusion as with_occlusion
    from facerender.mesh.part import Face as Face
    from facerender.mesh.registration import Registration as Registration
    from facerender.mesh.registration import register as register
    from facerender.mesh.simplify import simplified as simplified
    from facerender.planning.plan import Plan as Plan
    from facerender.planning.plan import plan as plan
    from facerender.scene.camera import STANDARD_VIEWS as STANDARD_VIEWS
    from facerender.scene.camera import Camera as Camera
    from facerender.scene.camera import turntable as turntable
    from facerender.scene.cameras import load_cameras as load_cameras
    from facerender.scene.environment import Environment as Environment
    from facerender.scene.environment import EnvironmentFile as EnvironmentFile
    from facerender.scene.environment import Panorama as Panorama
    from facerender.scene.environment import load_environment as load_environment
    from facerender.scene.job import ImageSettings as ImageSettings
    from facerender.scene.job import Job as Job
    from facerender.scene.job import Output as Output
    from facerender.scene.job import load_scene as load_scene
    from facerender.scene.landmarks import Landmarks as Landmarks
    from facerender.scene.landmarks import load_landmarks as load_landmarks
    from facerender.scene.light import Light as Light
    from facerender.scene.pose import Pose as Pose
    from facerender.scene.scene import Scene as Scene
    from facerender.scene.shading import Shading as Shading
    from facerender.scene.shading import Term as Term
    from facerender.scene.view import View as View
    from facerender.scene.view import shifted as shifted
    from facerender.scene.view import view_of as view_of
    from facerender.texture.texture import Texture as Texture

__version__ = "0.1.0"

_HOMES = {
    "comparison.compare": ("compare",),
    "comparison.pictures": ("difference", "sheet"),
    "drawing.frame": ("Frame", "GBuffer"),
    "drawing.renderer": ("Renderer", "render"),
    "errors": ("ContextError", "FacerenderError", "FacerenderWarning", "InputError"),
    "glsl.library": ("moderngl_includes", "resolve_includes", "shader_dir", "shader_source"),
    "images.animation": ("save_animation",),
    "loading": ("MeshFile", "load_mesh"),
    "material": ("Material",),
    "mesh.part": ("Face",),
    "mesh.mesh": ("Mesh", "find_face", "tracked"),
    "mesh.occlusion": ("with_occlusion",),
    "mesh.registration": ("Registration", "register"),
    "mesh.simplify": ("simplified",),
    "planning.plan": ("Plan", "plan"),
    "scene.camera": ("STANDARD_VIEWS", "Camera", "turntable"),
    "scene.cameras": ("load_cameras",),
    "scene.environment": ("Environment", "EnvironmentFile", "Panorama", "load_environment"),
    "scene.job": ("ImageSettings", "Job", "Output", "load_scene"),
    "scene.landmarks": ("Landmarks", "load_landmarks"),
    "scene.light": ("Light",),
    "scene.pose": ("Pose",),
    "scene.scene": ("Scene",),
    "scene.shading": ("Shading", "Term"),
    "scene.view": ("View", "shifted", "view_of"),
    "texture.texture": ("Texture",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = list(("__version__", "brdf", "lobes", *_HOME))  # noqa: C410  # mypy would check a literal list


def __getattr__(name: str) -> Any:
    """Import a public name on first access. This shortens a cold start, and the command can install
    its signal handlers before other imports."""
    if name in ("brdf", "lobes"):
        return import_module(f"facerender.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'facerender' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"facerender.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
