"""What the process ends with, once for all commands; 0 where all is written."""

UNREAD = 1
"""Nobody read the output."""
INVALID = 2
"""The input or the command is wrong, or a disk is full."""
NOT_SATISFIED = 3
"""Done, but not all that was asked holds."""
SIGNALLED = 128
"""Ended by a signal, whose number is added."""
INTERRUPTED = 130
"""Ctrl-C; what was solved until then is written, films are not."""
