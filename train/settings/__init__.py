"""Configurations of training: what they may hold, and how YAML files are read."""
