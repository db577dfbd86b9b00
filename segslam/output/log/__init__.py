"""The MCAP log of a run: writing steps to a file, and reading them."""

from segslam.output.log.reader import RunLog, read_log
from segslam.output.log.writer import LogWriter, Mirror, is_being_written

__all__ = ["LogWriter", "Mirror", "RunLog", "is_being_written", "read_log"]
