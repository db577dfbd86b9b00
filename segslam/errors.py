"""What goes wrong, by whose fault. Apart from the records, so that the command line starts without NumPy."""


class SegslamError(Exception):
    """Bad input or misuse: the message names the file or key and the remedy."""


class WorkFailed(SegslamError):
    """What was asked for was right and could not be done, as with a full disk."""


class BadScan(SegslamError):
    """One scan that cannot be used, the others are unaffected: report it, skip it, count it."""
