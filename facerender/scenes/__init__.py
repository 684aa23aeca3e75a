"""Scene descriptions as values: mesh, material, textures, camera, lights. No OpenGL."""
