"""Parts of the benchmark of geometric labels."""
