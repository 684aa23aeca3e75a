"""Scene descriptions as values: mesh, material, textures, camera, lights. OpenGL is not used."""
