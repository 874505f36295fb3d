"""The nominal blade: a closed solid, its span, its sections' ends, its closest points."""
