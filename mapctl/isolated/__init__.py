"""What reads files by libraries written in C, in a process of its own: it may crash there, take long, or fill memory.

Nothing here imports torch or the rest of mapctl, so that such a process starts in a fraction of a second. What it finds
comes back as plain arrays and text, from which `mapctl.formats` builds motions.
"""
