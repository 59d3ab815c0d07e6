"""`vestcl bench pareto`: run time against error of every method, preset and size."""
