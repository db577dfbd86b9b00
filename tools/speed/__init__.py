"""What tools/bench.py measures, a file a part: each gives figures that go into its JSON."""
