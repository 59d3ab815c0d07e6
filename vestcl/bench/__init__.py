"""Benchmarks, one a stem: `vestcl bench splat` is vestcl.bench.splat.bench."""
