"""Benchmarks of registration methods: the experiments of the Segregator paper, and recognition of places."""
