"""What bench_labels.py is made of."""
