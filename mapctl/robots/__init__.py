"""Motion of a person on a robot: its kinematic model, joint angles by a MAP problem, and files for controllers."""
