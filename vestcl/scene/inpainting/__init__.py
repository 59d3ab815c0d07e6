"""The background behind the foreground: structure, holes, filling, and the sides of the view."""
