"""The paper's experiments, and the methods they compare."""
