"""Where metal is missing or in excess against the twin, and how much."""
