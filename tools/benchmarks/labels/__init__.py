"""Labels by shape: the parts of the benchmark."""
