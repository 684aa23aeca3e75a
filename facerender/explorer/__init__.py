"""The explorer: an HTML page that draws a mesh and compares two shadings on the reader's GPU.

A job and its mesh flow in, and one HTML file flows out, which needs no server and no network.
``page`` writes the data of the page; ``browser`` has its scripts, shaders and styles, which draw.

One rule holds inside: the page has no shading of its own. It draws with the library's GLSL, and its
controls follow the registry of terms and the ranges of the fields; only cameras and lights are
computed again, in ``drawing.js``. A note on the page lists each feature that it cannot draw.
"""
