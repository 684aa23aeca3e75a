"""The GLSL library as text.

The renderer, the explorer, plans and other programs draw with the same GLSL files, so that there is
one implementation of each term. ``includes`` resolves include lines. ``library`` returns files as
flat text for a GLSL version, and the macros and calls of a specular term. ``translate`` calls other
programs to translate functions to HLSL, Metal and WGSL. Names of files and terms flow in; texts
flow out.

One rule holds inside: a GLSL text depends only on the arguments and the files, never on a driver.
No step changes the value of an expression, and no step removes a branch that a host can select.
"""
