"""The MCAP log of a run: steps into a file, a file back into steps."""

from segslam.log.reader import RunLog, read_log
from segslam.log.writer import LogWriter

__all__ = ["LogWriter", "RunLog", "read_log"]
