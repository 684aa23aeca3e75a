"""What is rendered, as values: mesh, material, textures, camera, lights. No OpenGL."""
