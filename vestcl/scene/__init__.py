"""From a frame to its layers: depth, masks, inpainting, and the point cloud (SPEC sections 3 and 8)."""
