"""The last two minutes of the live viewer: kept frames, a moment of the past that is shown, and slow motion."""
