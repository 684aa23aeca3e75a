"""Procedural generator of the built-in head: an adult face with closed eyes.

    python -m tools.head -o OUT.glb

The modules, in the order of the data flow:

    fields     building blocks of implicit surfaces (smooth unions, ellipsoids, capsules)
    landmarks  lines of the face that shape and texture share (mouth, lids, hairline)
    shape      the head as one implicit surface
    surface    the implicit surface as a triangle mesh
    unwrap     texture coordinates, and the surface point of every texel
    noise      random patterns in space and random points on the mesh
    regions    weights of the skin regions
    hairs      single hairs of brows and lashes
    texture    albedo, normal and occlusion-roughness maps
    glb        writer of the GLB file

Internal lengths are in centimetres: x to the head's left, y up from the eye line, z forward from
the ear canals. The file is in metres.
"""
