"""What a run leaves: folder, log, map, report, figures; written, read and shown."""
