"""Geometry: arrays in, frozen results out. Measures; never decides."""
