"""Sections of the airfoil: the profile near a plane and everything measured on it."""
