"""What is computed once per clip and kept in files: `vestcl prepare`."""
