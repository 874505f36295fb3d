"""Drivers: bytes and registers to small values in physical units."""
