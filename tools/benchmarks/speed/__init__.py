"""What tools/benchmarks/speed measures, a file a part: each gives figures that go into its JSON."""
