"""Simulated labelled street scenes and LiDAR sensors; writes sequences in KITTI format with exact ground truth."""
