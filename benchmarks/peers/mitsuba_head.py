"""Render the head with Mitsuba 3: scalar variant, direct light, Beckmann plastic, 1 sample.

    mitsuba_head.py MESH.glb OUT.png

Mitsuba does not read GLB, so trimesh loads geometry and albedo.
"""

import sys

import mitsuba as mi
import numpy as np
import trimesh

mi.set_variant("scalar_rgb")
source = next(iter(trimesh.load_scene(sys.argv[1], process=False).geometry.values()))
albedo = np.asarray(source.visual.material.baseColorTexture.convert("RGB"), dtype=np.float32) / 255
bsdf = mi.load_dict(
    {
        "type": "roughplastic",
        "distribution": "beckmann",
        "alpha": 0.3,
        "diffuse_reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(albedo)},
    }
)
properties = mi.Properties()
properties["bsdf"] = bsdf
mesh = mi.Mesh(
    "head", len(source.vertices), len(source.faces), properties, has_vertex_texcoords=True
)
parameters = mi.traverse(mesh)
parameters["vertex_positions"] = np.asarray(source.vertices, np.float32).ravel()
parameters["vertex_texcoords"] = np.asarray(source.visual.uv, np.float32).ravel()
parameters["faces"] = np.asarray(source.faces, np.uint32).ravel()
parameters.update()
center = source.bounds.mean(axis=0)
scene = {"type": "scene", "integrator": {"type": "direct"}, "head": mesh}
for number, azimuth in enumerate(np.radians((-50, 125, 50))):
    scene[f"light{number}"] = {
        "type": "directional",
        "direction": [-np.sin(azimuth), -0.6, -np.cos(azimuth)],
        "irradiance": {"type": "rgb", "value": 3.0},
    }
scene["camera"] = {
    "type": "perspective",
    "fov": 25,
    "to_world": mi.ScalarTransform4f().look_at(
        origin=list(center + (0, 0, 0.8)), target=list(center), up=[0, 1, 0]
    ),
    "film": {"type": "hdrfilm", "width": 1024, "height": 1024},
    "sampler": {"type": "independent", "sample_count": 1},
}
image = mi.render(mi.load_dict(scene))
mi.util.write_bitmap(sys.argv[2], image)
