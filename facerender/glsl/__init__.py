"""The GLSL library as text.

The renderer, the explorer, plans and other programs draw with the same GLSL files, so that there is
one implementation of each term. ``includes`` resolves include lines. ``library`` returns files as
flat text for a GLSL version, the catalogue of functions, and the macros and calls of a specular
term. ``syntax`` and ``translate`` translate functions to HLSL, Metal and WGSL. Names of files and
terms flow in; texts flow out.

One rule holds inside: a text depends only on the arguments and the files, never on a driver, and no
step changes the value of an expression. Branches are removed only if no host can select them.
"""
