"""The damage-free twin: the nominal deformed onto what is sound."""
