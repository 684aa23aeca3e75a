"""Headless rendering of face meshes with exact and approximated Cook-Torrance and Ward terms.

>>> import facerender as fr
>>> frame = fr.render("head.glb", model="cook-torrance", lobe="exact", m=0.3)
>>> frame.save("head.png")
"""

from facerender import brdf as brdf
from facerender import lobes as lobes

__version__ = "0.1.0"

from facerender.errors import ContextError as ContextError
from facerender.errors import FacerenderError as FacerenderError
from facerender.errors import FacerenderWarning as FacerenderWarning
from facerender.errors import InputError as InputError
from facerender.frame import Frame as Frame
from facerender.frame import GBuffer as GBuffer
from facerender.glsl import shader_dir as shader_dir
from facerender.glsl import shader_source as shader_source
from facerender.mesh import Mesh as Mesh
from facerender.mesh import load_mesh as load_mesh
from facerender.renderer import Renderer as Renderer
from facerender.renderer import render as render
from facerender.scene import Camera as Camera
from facerender.scene import Light as Light
from facerender.scene import Material as Material
from facerender.scene import Scene as Scene
from facerender.shading import Shading as Shading
