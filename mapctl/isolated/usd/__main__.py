"""Answers what a USD file holds, and writes a character's with a motion; see `mapctl.isolated.process`."""

from mapctl.isolated.child import serve
from mapctl.isolated.usd.answer import answer

serve(answer)
