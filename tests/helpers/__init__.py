"""What several tests share: made-up drives, logs, networks and places; the run-time type check."""
