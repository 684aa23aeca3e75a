"""Meshes. A mesh is a light value of three that change independently: the geometry, which is read
once and never changes; the materials, which options change; and the pose, which frames change.

``part`` has the triangles of one material, as read and as the GPU gets them.
``repair`` prepares them, ``framing`` finds the head, and ``geometry`` owns all that derives from
them, and poses. ``rig`` has the data that move vertices. ``mesh`` joins the three. ``simplify``,
``occlusion`` and ``hints`` work on meshes. OpenGL is not used."""
