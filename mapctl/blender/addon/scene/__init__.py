"""What the add-on reads of a scene and writes into it: armatures, actions and curves."""
