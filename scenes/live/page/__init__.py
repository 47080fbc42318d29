"""What mapctl adds to viser's page: keys that can be held, a gamepad, and where the panel lies."""
