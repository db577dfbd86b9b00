"""A drive of faults: live runs and mapped folders with faults injected at random."""
