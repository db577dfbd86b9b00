"""Around a run: its folder, its files, the finished run read back, accuracy, viewer and report."""
