"""`python -m train.card`: a checkpoint's model card, with its tables and images."""
