"""What the scanner saw: points cleaned, views fused, the turntable's axis, local shape."""
