"""`vestcl bench forecast` and `vestcl bench inpaint`: forecasts of real clips and streets against what followed."""
