"""Scenes: a mesh with camera, lights, environment and background, as values and as plain data.

Two values describe one picture. A ``Job`` is what users write down: records of plain data, which
files, tables, options and other machines share. A ``Scene`` is what is drawn: its mesh is loaded,
posed and dressed. ``Job.scene`` is the way from one to the other, and the only place where the two
meet, so that neither the renderer knows files nor a file knows the renderer.

``camera``, ``light``, ``environment``, ``shading`` and ``pose`` are their common parts; ``view`` is
the projection of a scene, ``cameras`` reads cameras of other programs. Angles are degrees and
lengths are mesh units here; the renderer's space (radius 1) begins in ``view`` and ``light``.
OpenGL is not used."""
