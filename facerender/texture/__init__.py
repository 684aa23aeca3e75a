"""Textures: images that threads decode when they are first needed, and their mip chains.

The package exists so that an image is decoded once, however many materials, renderers and channels
use it, and without a second full copy of a large image. Image files, arrays and Pillow images flow
in, mip levels flow out. Rule: textures of one image share its texels and its chains. OpenGL is not
used."""
