"""Videos by PyAV: frames by index, and writing."""
