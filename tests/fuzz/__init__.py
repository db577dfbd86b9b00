"""Every reader gives what was written, or one error that names the file; whatever the bytes."""
