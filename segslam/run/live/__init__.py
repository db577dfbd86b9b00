"""Mapping while scans arrive: sources of scans, and odometry in a process that other work does not delay."""
