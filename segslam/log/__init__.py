"""The MCAP log of a run: steps into a file, a file back into steps."""

from segslam.log.output import is_being_written
from segslam.log.reader import RunLog, read_log
from segslam.log.writer import LogWriter, Mirror

__all__ = ["LogWriter", "Mirror", "RunLog", "is_being_written", "read_log"]
