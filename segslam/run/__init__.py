"""Run folders: writing and reading them, accuracy, viewer and report."""
