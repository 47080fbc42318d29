"""Bodies in the browser, sent once and then posed: the mannequin, and a character's own mesh."""
