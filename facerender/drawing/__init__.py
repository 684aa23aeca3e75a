"""Draws a scene: with OpenGL, and in float64 with NumPy as the reference.

A scene and a shading come in; images and G-buffers of float32 go out. ``prepare`` resolves both to
an appearance. ``frame_passes`` turns it into passes, which ``program`` defines as values.
``compiled`` draws the passes with the GPU objects that ``resources`` caches, and ``frame`` holds
the result. ``renderer`` joins these steps.

Two rules hold inside. Passes depend on the appearance, never on the camera, so that a frame is
compiled once for all cameras and poses. The value from which a result derives owns the result: a
renderer keeps no mesh alive. Records and public functions check the values that users give, but not
their Python types; the rest trusts them."""
