"""Operating system and machine: Ctrl-C, threads, memory, atomic files, compiled kernels."""
