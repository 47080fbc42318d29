"""Generative tweening (Zhou et al. 2020): motion from sparse keys, and the hips' trajectory from the body's motion."""
