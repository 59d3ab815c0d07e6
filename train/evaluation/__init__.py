"""What `python -m train.evaluate` is made of: protocols, inputs, windows, reports."""
