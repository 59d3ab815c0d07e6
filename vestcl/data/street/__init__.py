"""The procedural street: an endless town, its traffic and its sensors, rendered by ray casting in OpenCL."""
