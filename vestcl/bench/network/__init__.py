"""`vestcl bench network` and `vestcl bench train-step`: what the network's parts and a training step cost."""
