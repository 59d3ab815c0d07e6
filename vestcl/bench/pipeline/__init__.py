"""`vestcl bench pipeline`: the time from frames to forecasts, stage by stage, against a 2D network."""
