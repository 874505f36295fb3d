"""The pose of the scan on the nominal, how certain it is, and which points are damage."""
