"""The version of vestcl, as setup.py has it."""

__version__ = "0.1.0"
