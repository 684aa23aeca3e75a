"""Procedural generator of the built-in head: an adult face with open eyes.

    python -m tools.head -o OUT.glb
    python -m tools.head --eyes closed -o OUT.glb

The modules, in the order of the data flow:

    fields     building blocks of implicit surfaces (smooth unions, ellipsoids, capsules)
    landmarks  lines of the face that shape and texture share (mouth, lids, hairline)
    shape      the head as one implicit surface
    surface    the implicit surface as a triangle mesh
    eyes       eyeballs and corneas
    lids       open eyelids, cut into the mesh
    lashes     lashes, and the tear line of the lower lids
    mouth      cut between the lips, and the cavity with teeth and tongue
    shapes     blend shapes of all parts
    unwrap     texture coordinates, and the surface point of every texel
    noise      random patterns in space and random points on the mesh
    regions    weights of the skin regions
    hairs      single hairs of brows, and of the lashes of closed eyes
    texture    albedo, normal and occlusion-roughness maps
    eye_texture  the maps of the eyeballs
    glb        writer of the GLB file

Internal lengths are in centimetres: x to the head's left, y up from the eye line, z forward from
the ear canals. The file is in metres.
"""
