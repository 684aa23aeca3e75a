"""The explorer: one page that draws a mesh in a browser with the library's shaders and compares two
shadings. Its scripts and styles are in ``browser``. No OpenGL here."""
