"""Generator of the built-in head: a closed-eyed adult face made by code alone.

The modules, in the order in which data flows through them:

    fields     building blocks of implicit surfaces (smooth unions, ellipsoids, capsules)
    landmarks  the lines of the face that shape and paint share (mouth, lids, hairline)
    shape      the head as one implicit surface
    surface    that surface as a triangle mesh
    unwrap     texture coordinates, and the surface point under every texel
    noise      random patterns in space and random points on the mesh
    regions    where on the skin each kind of skin lies
    hairs      single hairs of brows and lashes
    texture    albedo, normal, occlusion-roughness maps
    glb        the file

Inside, lengths are centimetres: x to the head's left, y up from the eye line, z forward from the
ear canals.  The file is in metres.  Run it with ``python -m tools.head -o OUT.glb``.
"""
