"""`mapctl bench all`: every table of the documentation, made again and compared with what it was."""
