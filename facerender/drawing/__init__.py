"""Rendering of a scene: with OpenGL, and in float64 with NumPy as the reference."""
