"""The GLSL library as text: includes, flat files for a target, translations, and the catalogue."""
