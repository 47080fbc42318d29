"""Two versions of mapctl timed in alternation: what is done in each, and how they take turns."""
