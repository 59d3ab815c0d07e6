"""Where pixels of one frame are in another: correspondences, poses and parallax from them."""
