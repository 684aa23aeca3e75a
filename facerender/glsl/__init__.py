"""The GLSL library as text: includes, files flat for a target, what its headers say."""
