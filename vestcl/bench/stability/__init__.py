"""`vestcl bench stability`: errors of every operator where numbers get large, small or close, and their bounds."""
