"""Sans-IO codecs, read by the drivers and by the simulators."""
