"""Answers what an FBX file holds; see `mapctl.isolated.process`."""

from mapctl.isolated.child import serve
from mapctl.isolated.fbx.answer import answer

serve(answer)
