"""Odometry: the pose of each scan in the frame of the first, and how certain each motion is.

KISS-ICP or a given trajectory proposes motions; they are compared with the scans and replaced by more likely ones.
Nothing is imported here, so that a process that only aligns scans imports little.
"""
