"""`vestcl bench splat` and `vestcl bench operators`: operators against the fastest peers, device by device."""
