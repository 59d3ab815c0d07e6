"""What benches share: timing, results as JSON, comparison of two results, plots."""
