"""The metal to put back, as closed solids."""
