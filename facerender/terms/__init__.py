"""Lobes, Fresnel terms, masking terms and models, as the shaders compute them, in float64.

The package exists so that every image has a reference, and every term has one home. An entry of a
registry contains the GLSL call, float64 function, domain and error bounds of a term. The command
line, the documents, the prices, the planner and the tests enumerate the entries. Numbers and arrays
flow in and out; nothing here draws. A value outside its stated range raises InputError, because the
functions are public (``brdf.py``, ``lobes.py``)."""
