"""The explorer: an HTML page that draws a mesh with the library's GLSL and compares two shadings.
The scripts, shaders and styles of the page are in ``browser``.
"""
