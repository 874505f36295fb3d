"""Widgets: each is given the whole state and draws its own part of it."""
