"""Convolutional networks whose features perceptual distances compare."""
