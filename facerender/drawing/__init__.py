"""Scene and shading to pixels: by OpenGL, and in float64."""
