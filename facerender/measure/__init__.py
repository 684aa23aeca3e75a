"""Measures cost and error of the specular terms and their approximations."""
