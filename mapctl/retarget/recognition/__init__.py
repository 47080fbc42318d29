"""Recognising a rig: by the names of listed rigs, by the plan of its body, and what is doubtful about the result."""
