"""Scenes: a mesh with camera, lights, environment and background, as values and as files.

``camera``, ``light``, ``environment`` and ``shading`` are the parts of a scene, ``scene`` joins
them, and ``view`` is its projection. ``file`` and ``cameras`` read scene files and camera files.
``job`` is a scene with its outputs as plain data. OpenGL is not used."""
