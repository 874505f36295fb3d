"""File formats of points and meshes: bytes in, arrays out, and back."""
