"""Simulators: the far end of each wire, with one synthetic blade behind all three."""
