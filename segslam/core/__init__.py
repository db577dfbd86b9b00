"""Records, SE(3), points, trajectories, settings, errors, and the machine: threads, memory, files, compiled kernels."""
