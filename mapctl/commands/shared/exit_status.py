"""Exit statuses of all commands besides 0, which means that all is written."""

UNREAD = 1
"""The output was not read: a broken pipe."""
INVALID = 2
"""The input or the command is wrong, or a disk is full."""
NOT_SATISFIED = 3
"""Done, but not all that was requested holds."""
SIGNALLED = 128
"""Ended by a signal, whose number is added."""
INTERRUPTED = 130
"""Ctrl-C; what was solved until then is written, films are not."""
