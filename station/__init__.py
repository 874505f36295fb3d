"""Station: decides, records and shows."""
