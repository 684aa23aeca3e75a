"""Measures what specular terms cost and what approximations lose."""
