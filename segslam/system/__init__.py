"""The operating system and the machine: Ctrl-C, threads, memory, whole files, compiled kernels."""
