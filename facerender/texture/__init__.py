"""Textures: images that are decoded when they are first needed, and their mip chains."""
